"""Direct and indirect light apart: a wrapper that makes a filter take them for two signals, and adds the images.

Direct light is noisy at the edges of shadows, indirect light everywhere. One signal would have one variance for both,
and the noise of the one would blur the other (Schied et al. 2017, sec. 3, filter them apart).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import Frame
from jaxdn.denoiser import Denoiser, Params, Prepared, State, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics


class ApartState(NamedTuple):
    """What is carried from one frame to the next."""

    rest: State
    """Of the filter of all but direct light."""
    direct: State
    """Of the filter of direct light; None where the frames do not have it apart."""


def light_apart(denoiser: Denoiser) -> Denoiser:
    """The filter applied to direct and to all other light, each with its own state; the image is the sum.

    Direct light is ``frame.shadowed``: diffuse light straight from the sampled points of lights. Frames without that
    buffer are filtered as a whole. The parameters are those of the filter, the same for both, and so are the frame's
    statistics, which are those of all light. So is ``luminance_gradient``: where direct light alone changes, both
    histories are shortened by its share of all light. Reads ``shadowed`` in addition.
    """
    core = core_of(denoiser)

    def start(params: Params, frame: Frame) -> ApartState:
        rest, direct = _split(frame)
        return ApartState(core.start(params, rest), None if direct is None else core.start(params, direct))

    def prepare(frame: Frame) -> tuple[FrameStatistics, tuple[Prepared, Prepared | None, Frame]]:
        rest, direct = _split(frame)
        statistics, _ = core.prepare(frame._replace(shadowed=None))
        return statistics, (core.prepare(rest)[1], None if direct is None else core.prepare(direct)[1], frame)

    def step(
        params: Params,
        state: ApartState,
        prepared: tuple[Prepared, Prepared | None, Frame],
        first: jax.Array,
        statistics: FrameStatistics,
    ) -> tuple[ApartState, jax.Array, jax.Array | int]:
        rest, direct, frame = prepared
        of_rest, image, invalid = core.step(params, state.rest, rest, first, statistics)
        if direct is None:
            return ApartState(of_rest, None), image, invalid
        before = state.direct
        if before is None:  # it has come within the clip
            before, first = core.start(params, _split(frame)[0]), jnp.ones_like(first)
        of_direct, lit, more = core.step(params, before, direct, first, statistics)
        return ApartState(of_rest, of_direct), image + lit, invalid + more

    reads = core.reads | {"shadowed"}
    return recurrent(core._replace(start=start, step=step, reads=reads, prepare=prepare, samples=None))


def _split(frame: Frame) -> tuple[Frame, Frame | None]:
    """The frame with all but direct light, and with direct light alone; None where it is not known."""
    if frame.shadowed is None:
        return frame, None
    direct = jnp.minimum(frame.shadowed, frame.radiance)
    bare = frame._replace(shadowed=None)
    return bare._replace(radiance=frame.radiance - direct), bare._replace(radiance=direct)
