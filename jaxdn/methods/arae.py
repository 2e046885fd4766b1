"""``arae``: the recurrent autoencoder behind an adaptive temporal accumulation.

``rae`` remembers, but does not follow motion: what moves is as noisy for it as in the first frame. Here each frame is
first blended into a history that is fetched along motion vectors and shortened where light has changed, exactly as
``asvgf`` does it; the autoencoder sees this mean in place of the noisy frame.

A lecture names the combination (of Chaitanya et al. 2017 and Schied et al. 2018) without its wiring; that the mean goes
into the network, and not its image into the mean, is our reading.
"""

import dataclasses
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.surface_test import guides_of, surface_mask
from jaxdn.methods import asvgf, rae, svgf
from jaxdn.methods.demodulation import demodulated
from jaxdn.methods.registry import method

_ACCUMULATIONS = {"tested": asvgf.Options(), "published": asvgf.Options(significance=0.0, antilag=1.0)}
"""How the history is fetched, tested and blended."""


@dataclass(frozen=True)
class Options(rae.Options):
    """Those of ``rae``, and that of the accumulation."""

    accumulation: Literal["tested", "published"] = "tested"
    """By what share light has changed: beyond two deviations of its noise and to the fourth power, as by default in
    ``asvgf``; or lambda as it is."""


def _with_accumulation(options: rae.Options, accumulation: Literal["tested", "published"]) -> Options:
    own = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    return Options(**own, accumulation=accumulation)


PRESETS = {
    "paper": _with_accumulation(rae.PRESETS["paper"], "published"),
    "hasselgren": _with_accumulation(rae.PRESETS["hasselgren"], "tested"),
}


class AraeState(NamedTuple):
    """What is carried from one frame to the next."""

    light: svgf.SvgfState
    """The mean of the frames so far."""
    hidden: rae.Hidden


@method(
    Options,
    title="Recurrent denoising autoencoder behind an adaptive temporal accumulation",
    presets=PRESETS,
    recipes=rae.RECIPES,
    variants={"arae-large": {"size": "large"}, "arae-small": {"size": "small"}},
    backends=("onednn",),
)
def arae(options: Options) -> Denoiser:
    """The recurrent autoencoder on accumulated light; ``params`` are those of ``rae``.

    Reads what ``rae`` and ``asvgf`` read. Raises ValueError as ``rae`` does.
    """
    inner, accumulation = rae.core_of(options), _ACCUMULATIONS[options.accumulation]

    def start(params: Params, frame: Frame) -> AraeState:
        return AraeState(svgf.start(params, frame), inner.start(params, frame))

    def step(
        params: Params, state: AraeState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[AraeState, jax.Array, jax.Array]:
        texture = svgf.planar_texture(frame, options.demodulate, statistics)
        history, invalid = asvgf.accumulate(accumulation, state.light, frame, texture, first)
        light = svgf.SvgfState(history.transpose(1, 2, 0), guides_of(frame))
        mean = brdf.restore(history[:3], texture, history[6:]).transpose(1, 2, 0)
        hit = surface_mask(frame.depth, None) if options.background == "pass" else None
        if hit is not None:  # the network passes through what it is given
            mean = jnp.where(hit[..., None], mean, frame.radiance)
        measured, prepared = inner.prepare(frame._replace(radiance=mean))
        hidden, image, hidden_invalid = inner.step(params, state.hidden, prepared, first, measured)
        return AraeState(light, hidden), image, invalid + hidden_invalid

    reads = inner.reads | svgf.READS | {"luminance_gradient"}
    return demodulated(recurrent(Core(start, step, reads, inner.init)), by=options.demodulate)
