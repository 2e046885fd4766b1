"""Temporal stabilisation: a wrapper that gives any denoiser a history, whose trust the new frame's light decides.

A denoiser of single frames makes other errors in every frame, and its clips flicker. A plain mean of its images along
motion vectors trails: shading, highlights and shadows of what moves stay behind. Here the weight of the history is that
of a Kalman filter (:mod:`jaxdn.filters.kalman`), and falls where the noisy frame shows that light has changed, and
where fetching the history between pixels would blur it (:mod:`jaxdn.filters.resampling`). Textures come from the new
frame's albedo where the image follows it (:mod:`jaxdn.filters.albedo_history`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Core, Denoiser, Params, Prepared, State, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters import albedo_history, kalman
from jaxdn.filters.albedo_history import follow_albedo, measure_share
from jaxdn.filters.catmull_rom import warp_cubic
from jaxdn.filters.kalman import kalman_blend
from jaxdn.filters.reproject import reproject
from jaxdn.filters.resampling import find_beyond, find_whole, measure_fetch_error
from jaxdn.filters.surface_test import Guides, guides_of

_READS = frozenset({"albedo", "normal", "depth", "previous_depth", "motion", "ids"})
_TAPS = 2
"""Radius in pixels of a cubic fetch."""
RECEPTIVE_FIELD = kalman.RECEPTIVE_FIELD + albedo_history.RECEPTIVE_FIELD + _TAPS
"""Radius in pixels of all that decides about one, besides the denoiser's."""
_WHOLE = 0.999
"""The mean of all accepted taps that are whole, rounded."""


class StabilisedState(NamedTuple):
    """What is carried from one frame to the next."""

    inner: State
    """Of the denoiser that is stabilised."""
    history: jax.Array
    """[H, W, 7 or 10] colour; its albedo, if the frames have one; 3 as of :func:`jaxdn.filters.kalman.kalman_blend`;
    1 where all 3x3 pixels showed one surface, else 0."""
    guides: Guides
    """Of the previous frame, as far as present."""


def stabilised(denoiser: Denoiser, *, history_max: int = 16) -> Denoiser:
    """The denoiser with a history: its images, less what differs in them from frame to frame for no reason.

    Each image is blended into the last result, as :func:`jaxdn.filters.kalman.kalman_blend` says. That is fetched along
    motion: by Catmull-Rom interpolation where all taps show one surface, elsewhere by bilinear interpolation with a
    test of every tap (:func:`jaxdn.reproject`). The first image, and what was hidden before, is the denoiser's own.
    Frames without noise keep their images.

    Any denoiser can be wrapped; it is of use for those without a history. The parameters are those of the denoiser.
    Reads albedo, motion, depth, previous_depth, normal and ids in addition; without motion the image is taken to stand
    still, without an albedo there is no texture to follow.

    Args:
      denoiser: of all light that ``radiance`` has.
      history_max: frames of which the result is a mean at most.

    Raises ValueError for another ``history_max`` than a whole number >= 1.
    """
    if not isinstance(history_max, int) or isinstance(history_max, bool) or history_max < 1:
        raise ValueError(f"history_max: expected a whole number >= 1, got {history_max!r}.")
    core = core_of(denoiser)

    def start(params: Params, frame: Frame) -> StabilisedState:
        nothing = jnp.zeros((*frame.radiance.shape[:2], 4 + _count_colors(frame)), frame.radiance.dtype)
        return StabilisedState(core.start(params, frame), nothing, jax.tree.map(jnp.zeros_like, guides_of(frame)))

    def prepare(frame: Frame) -> tuple[FrameStatistics, tuple[Prepared, Frame]]:
        statistics, prepared = core.prepare(frame)
        return statistics, (prepared, frame)

    def step(
        params: Params,
        state: StabilisedState,
        prepared: tuple[Prepared, Frame],
        first: jax.Array,
        statistics: FrameStatistics,
    ) -> tuple[StabilisedState, jax.Array, jax.Array | int]:
        given, frame = prepared
        inner, image, inner_invalid = core.step(params, state.inner, given, first, statistics)
        image = jnp.clip(image, 0.0, RADIANCE_MAX)
        history, invalid = _blend(state, frame, image, first, statistics.exposure, history_max)
        return StabilisedState(inner, history, guides_of(frame)), history[..., :3], inner_invalid + invalid

    samples = None
    if core.samples is not None:
        request = core.samples

        def samples(params: Params, state: StabilisedState, frame: Frame, first: jax.Array, most: int) -> jax.Array:
            return request(params, state.inner, frame, first, most)

    field = None if core.receptive_field is None else core.receptive_field + RECEPTIVE_FIELD
    mask = core.requires_validity_mask
    return recurrent(Core(start, step, core.reads | _READS, core.init, samples, prepare, field, mask))


def _count_colors(frame: Frame) -> int:
    """Planes of the history that are colours: light and, if there is one, its albedo."""
    return 3 if frame.albedo is None else 6


def _blend(
    state: StabilisedState, frame: Frame, image: jax.Array, first: jax.Array, exposure: jax.Array, history_max: int
) -> tuple[jax.Array, jax.Array]:
    """The next history, and how many pixels of the last one were invalid."""
    fetched, valid, cubic, invalid = _fetch(state, frame, first)
    colors = _count_colors(frame)
    past, tracked, whole_before = fetched[:colors], fetched[colors:-1], fetched[-1] > _WHOLE
    whole = find_whole(frame)
    planes, share, albedo, before = image.transpose(2, 0, 1), jnp.zeros_like(fetched[0]), None, None
    color = past[:3]
    if frame.albedo is not None:
        albedo, before = frame.albedo.transpose(2, 0, 1), past[3:]
        share = jax.lax.stop_gradient(measure_share(color, before, albedo, planes, exposure)) * valid
        color = follow_albedo(color, before, albedo, share)
        before = before + share[None] * (albedo - before)
    error = None
    if frame.motion is not None:
        error = measure_fetch_error(planes, albedo, share, frame.motion, cubic, whole & whole_before)
    blended = kalman_blend(
        jnp.concatenate([color, tracked]),
        valid,
        planes,
        frame.radiance.transpose(2, 0, 1),
        exposure,
        error,
        history_max=history_max,
    )
    parts = [blended[:3], blended[3:], whole[None].astype(image.dtype)]
    if albedo is not None and before is not None:
        parts.insert(1, albedo + (1.0 - blended[3:4]) * jnp.where(valid[None], before - albedo, 0.0))
    return jnp.concatenate(parts).transpose(1, 2, 0), invalid


def _fetch(state: StabilisedState, frame: Frame, first: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The history where it is now [C, H, W], where there is one, where it was fetched by cubics, [H, W] each; and how
    many pixels of it were invalid.

    Where the nearest four pixels are whole, all sixteen show one surface, and cubics need no test.
    """
    found = reproject(state.history, state.guides, frame, first)
    history, valid = found.history, found.valid[..., 0]
    cubic = jnp.zeros_like(valid)
    if frame.motion is not None:
        colors = _count_colors(frame)
        sharp = warp_cubic(state.history[..., :colors], frame.motion)
        inside = find_beyond(jnp.where(jnp.isfinite(frame.motion), frame.motion, 0.0)) == 0
        cubic = valid & inside & (history[..., -1] > _WHOLE) & jnp.all(jnp.isfinite(sharp), axis=-1)
        light = jnp.where(cubic[..., None], sharp, history[..., :colors])
        history = jnp.concatenate([light, history[..., colors:]], axis=-1)
    return history.transpose(2, 0, 1), valid, cubic, found.invalid
