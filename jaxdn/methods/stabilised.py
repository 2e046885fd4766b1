"""Temporal stabilisation: a wrapper that gives any denoiser a history, whose trust the new frame's light decides.

A denoiser of single frames makes other errors in every frame, and its clips flicker. A plain mean of its images along
motion vectors trails: shading, highlights and shadows of what moves stay behind. Here the weight of the history is that
of a Kalman filter (:mod:`jaxdn.filters.kalman`), and falls where the noisy frame shows that light has changed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Core, Denoiser, Params, Prepared, State, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.kalman import PLANES, RECEPTIVE_FIELD, kalman_blend
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, guides_of

_READS = frozenset({"normal", "depth", "previous_depth", "motion", "ids"})
_SLOPES = 2
"""Pixels around a tap that the surface test looks at."""


class StabilisedState(NamedTuple):
    """What is carried from one frame to the next."""

    inner: State
    """Of the denoiser that is stabilised."""
    history: jax.Array
    """[H, W, 6] as of :func:`jaxdn.filters.kalman.kalman_blend`."""
    guides: Guides
    """Of the previous frame, as far as present."""


def stabilised(denoiser: Denoiser, *, history_max: int = 16) -> Denoiser:
    """The denoiser with a history: its images, less what differs in them from frame to frame for no reason.

    Each image is blended into the last result, fetched along motion with a test of every tap
    (:func:`jaxdn.reproject`), as :func:`jaxdn.filters.kalman.kalman_blend` says. The first image, and what was hidden
    before, is the denoiser's own. Frames without noise keep their images.

    Any denoiser can be wrapped; it is of use for those without a history. The parameters are those of the denoiser.
    Reads motion, depth, previous_depth, normal and ids in addition; without motion the image is taken to stand still.

    Args:
      denoiser: of all light that ``radiance`` has.
      history_max: frames of which the result is a mean at most.

    Raises ValueError for another ``history_max`` than a whole number >= 1.
    """
    if not isinstance(history_max, int) or isinstance(history_max, bool) or history_max < 1:
        raise ValueError(f"history_max: expected a whole number >= 1, got {history_max!r}.")
    core = core_of(denoiser)

    def start(params: Params, frame: Frame) -> StabilisedState:
        nothing = jnp.zeros((*frame.radiance.shape[:2], PLANES), frame.radiance.dtype)
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
        past = reproject(state.history, state.guides, frame, first)
        history = kalman_blend(
            past.history.transpose(2, 0, 1),
            past.valid[..., 0],
            jnp.clip(image, 0.0, RADIANCE_MAX).transpose(2, 0, 1),
            frame.radiance.transpose(2, 0, 1),
            statistics.exposure,
            history_max=history_max,
        ).transpose(1, 2, 0)
        return StabilisedState(inner, history, guides_of(frame)), history[..., :3], inner_invalid + past.invalid

    samples = None
    if core.samples is not None:
        request = core.samples

        def samples(params: Params, state: StabilisedState, frame: Frame, first: jax.Array, most: int) -> jax.Array:
            return request(params, state.inner, frame, first, most)

    field = None if core.receptive_field is None else core.receptive_field + RECEPTIVE_FIELD + _SLOPES
    mask = core.requires_validity_mask
    return recurrent(Core(start, step, core.reads | _READS, core.init, samples, prepare, field, mask))
