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

from jaxdn.core.frame import RADIANCE_MAX, Array, Frame
from jaxdn.denoiser import Core, Denoiser, Params, Prepared, State, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters import albedo_history, kalman
from jaxdn.filters.albedo_history import follow_albedo, measure_share
from jaxdn.filters.kalman import kalman_blend
from jaxdn.filters.resampling import find_whole, measure_fetch_error
from jaxdn.filters.sharp_history import TAPS, fetch_sharply
from jaxdn.filters.surface_test import Guides, guides_of
from jaxdn.ops.scales import join_pixels, to_planes

_READS = frozenset({"albedo", "normal", "depth", "previous_depth", "motion", "ids", "sample_count"})
RECEPTIVE_FIELD = kalman.RECEPTIVE_FIELD + albedo_history.RECEPTIVE_FIELD + TAPS
"""Radius in pixels of all that decides about one, besides the denoiser's."""


class StableHistory(NamedTuple):
    """What is kept of the images."""

    values: jax.Array
    """[H, W, 7 or 10] colour; its albedo, if a frame had one; 3 as of :func:`jaxdn.filters.kalman.kalman_blend`;
    1 where all 3x3 pixels showed one surface, else 0."""
    guides: Guides
    """Of the previous frame, as far as present."""


class StabilisedState(NamedTuple):
    """What is carried from one frame to the next."""

    inner: State
    """Of the denoiser that is stabilised."""
    history: StableHistory


def stabilised(denoiser: Denoiser, *, history_max: int = 16) -> Denoiser:
    """The denoiser with a history, so that its images flicker less.

    Each image is blended into the last result, as :func:`jaxdn.filters.kalman.kalman_blend` says. That is fetched along
    motion: by Catmull-Rom interpolation where all taps show one surface, elsewhere by bilinear interpolation with a
    test of every tap (:func:`jaxdn.reproject`). The first image, and what was hidden before, is the denoiser's own.
    Frames without noise keep their images.

    Any denoiser can be wrapped; it is of use for those without a history. The parameters are those of the denoiser.
    Reads albedo, motion, depth, previous_depth, normal, ids and sample_count in addition; without motion the image is
    taken to stand still, without an albedo there is no texture to follow. Pixels that have no samples, or whose
    radiance is not finite, do not count for what the noisy frame shows.

    Args:
      denoiser: of all light that ``radiance`` has.
      history_max: frames of which the result is a mean at most.

    Raises ValueError for another ``history_max`` than a whole number >= 1.
    """
    if not isinstance(history_max, int) or isinstance(history_max, bool) or history_max < 1:
        raise ValueError(f"history_max: expected a whole number >= 1, got {history_max!r}.")
    core = core_of(denoiser)

    def start(params: Params, frame: Frame) -> StabilisedState:
        return StabilisedState(core.start(params, frame), start_history(frame))

    counts_samples = "sample_count" in core.reads or core.requires_validity_mask

    def prepare(frame: Frame) -> tuple[FrameStatistics, tuple[Prepared, Frame]]:
        # Alone, a denoiser that does not read sample_count is given none either.
        statistics, prepared = core.prepare(frame if counts_samples else frame._replace(sample_count=None))
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
        history, image, invalid = blend_image(
            state.history, frame, image, first, statistics.exposure, history_max=history_max
        )
        return StabilisedState(inner, history), image, inner_invalid + invalid

    samples = None
    if core.samples is not None:
        request = core.samples

        def samples(params: Params, state: StabilisedState, frame: Frame, first: jax.Array, most: int) -> jax.Array:
            return request(params, state.inner, frame, first, most)

    field = None if core.receptive_field is None else core.receptive_field + RECEPTIVE_FIELD
    sees = core.sees_sample
    reads = core.reads | _READS
    return recurrent(Core(start, step, reads, core.init, samples, prepare, field, True, sees, core.pattern))


def start_history(frame: Frame) -> StableHistory:
    """The history before the first frame."""
    planes = 7 if frame.albedo is None else 10
    nothing = jnp.zeros((*frame.radiance.shape[:2], planes), frame.radiance.dtype)
    return StableHistory(nothing, jax.tree.map(jnp.zeros_like, guides_of(frame)))


def _meet(values: jax.Array, albedo: Array) -> tuple[jax.Array, Array]:
    """The planes of a history and the new frame's albedo, both with an albedo or both without.

    Where one of them has none, because it comes or goes within a stream, its albedo is 1.
    """
    followed = values.shape[-1] == 10
    if albedo is None:
        return values, jnp.ones_like(values[..., :3]) if followed else None
    if not followed:
        values = jnp.concatenate([values[..., :3], jnp.ones_like(values[..., :3]), values[..., 3:]], axis=-1)
    return values, albedo


def blend_image(
    before: StableHistory, frame: Frame, image: jax.Array, first: jax.Array, exposure: jax.Array, *, history_max: int
) -> tuple[StableHistory, jax.Array, jax.Array]:
    """The next history, the blended image [H, W, 3], and how many pixels of the last history were invalid."""
    values, texture = _meet(before.values, frame.albedo)
    colors = 3 if texture is None else 6
    found = fetch_sharply(values, before.guides, frame, first, colors=colors)
    fetched, valid = to_planes(found.values), found.valid
    past, tracked = fetched[:colors], fetched[colors:-1]
    whole = find_whole(frame)
    planes, share, albedo, then = image.transpose(2, 0, 1), jnp.zeros_like(fetched[0]), None, None
    color = past[:3]
    if texture is not None:
        albedo, then = texture.transpose(2, 0, 1), past[3:]
        share = jax.lax.stop_gradient(measure_share(color, then, albedo, planes, exposure)) * valid
        color = follow_albedo(color, then, albedo, share)
        then = then + share[None] * (albedo - then)
    error = None
    if frame.motion is not None:
        error = measure_fetch_error(planes, albedo, share, frame.motion, found.cubic, whole & found.whole)
    blended = kalman_blend(
        jnp.concatenate([color, tracked]),
        valid,
        planes,
        frame.radiance.transpose(2, 0, 1),
        exposure,
        error,
        None if frame.sample_count is None else frame.sample_count[..., 0] > 0,
        history_max=history_max,
    )
    parts = [blended[:3], blended[3:], whole[None].astype(image.dtype)]
    if albedo is not None and then is not None:
        parts.insert(1, albedo + (1.0 - blended[3:4]) * jnp.where(valid[None], then - albedo, 0.0))
    values = join_pixels([("planes", part) for part in parts])
    return StableHistory(values, guides_of(frame)), values[..., :3], found.invalid
