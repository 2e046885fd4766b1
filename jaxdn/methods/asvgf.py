"""Adaptive spatiotemporal variance-guided filtering (``asvgf``): svgf that forgets where light has changed.

The tests of svgf's history compare surfaces, so they cannot see that a lamp was switched on or that a shadow has moved:
old light fades over many frames. Here the renderer shades a few points of the previous frame again with the random
numbers they had then. Without a change of light both results are equal, noise included; their difference tells by what
share the light has changed, and by this share the history is outdated.

Without such samples (files of other renderers) the luminance of the frame is compared with that of the history, over
large areas; changes that are small or faint against the noise stay unseen.

Christoph Schied et al., "Gradient Estimation for Real-Time Adaptive Temporal Filtering", 2018.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.frame import Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.accumulation import luminance, with_texture
from jaxdn.filters.gradients import (
    Change,
    Enlarging,
    compare_replayed,
    compare_with_history,
    measure_light,
    reconstruct,
    stratum_centers,
    to_pixels,
)
from jaxdn.filters.surface_test import surface_mask
from jaxdn.methods import svgf
from jaxdn.methods.learnable_options import FITTING, LEARNABLE, apply_offsets, zero_offsets
from jaxdn.methods.registry import method


@dataclass(frozen=True)
class Options(svgf.Options):
    """The options of ``svgf``, and those of the gradients."""

    alpha: Annotated[float, Range(0, 1, without_low=True), LEARNABLE] = 0.1
    """Minimum weight of the new frame in colour, where light has not changed."""
    gradient_levels: Annotated[int, Range(0, 5)] = 3
    """Levels of the filter over strata of 3x3 pixels: with s = ``gradient_spacing`` it averages over squares of
    ``3 + 6 (s^levels - 1) / (s - 1)`` pixels along a side, which is ``3^(levels + 1)`` for s = 3."""
    gradient_spacing: Annotated[int, Range(2, 3)] = 3
    """Taps of level i of that filter are ``gradient_spacing^i`` strata apart."""
    gradient_stops: Literal["surface", "light"] = "surface"
    """What stops that filter: differences of depth and normals, or of depth and of the frame's luminance (three
    deviations): then it does not average over the edges of shadows."""
    gradient_enlarging: Enlarging = "bilinear"
    """How strata become pixels."""
    significance: Annotated[float, Range(0)] = 2.0
    """Standard deviations up to which a change is taken for noise; from twice as many on it counts in full. With 0, as
    in the paper, every path that differs by chance shortens the history."""
    antilag: Annotated[float, Range(1)] = 4.0
    """The history keeps the share ``(1 - lambda)^antilag``, where lambda is the share by which light has changed. With
    the paper's 1 light that doubles leaves half of the history."""


PAPER = Options(
    **svgf.AS_PUBLISHED | {"ramp": True, "spatial": "image"},
    apart=True,
    antialiasing=True,
    alpha_moments=0.6,
    history_max=64,
    gradient_levels=5,
    gradient_spacing=2,
    gradient_stops="light",
    gradient_enlarging="nearest",
    significance=0.0,
    antilag=1.0,
)
"""The settings of Schied et al. 2018: lambda is taken as it is, and alpha is 0.1. What the paper leaves open is that of
the code its author released (KIT, 2018): 1 / N in short histories, whose colour comes from neighbours (7x7 and 4 / N as
in ``svgf``), at least 0.6 of the new frame in the moments, 64 frames, gradients averaged by five levels of 3x3 taps 2^i
strata apart, stopped by depth and by three deviations of luminance, and each stratum's value for all of its pixels. The
rest is SVGF's preset."""


@method(
    Options,
    title="SVGF that adapts to changes of light (Schied et al. 2018)",
    presets={"paper": PAPER},
    recipes={"usual": FITTING},
    filter=True,
)
def asvgf(options: Options) -> Denoiser:
    """A-SVGF, a filter that needs no weights: ``params`` are ``{}``, or move the options that ``svgf``'s move.

    Reads what ``svgf`` reads, and luminance_gradient. A frame in which no sample was replayed (the buffer is absent, or
    0 everywhere) is compared with the history instead.
    Raises ValueError for options out of range and radiance that is not [H, W, 3].
    """

    def step(
        params: Params, state: svgf.SvgfState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[svgf.SvgfState, jax.Array, jax.Array]:
        fitted = apply_offsets(options, params)
        texture = svgf.planar_texture(frame, fitted.demodulate, statistics)
        history, invalid = accumulate(fitted, state, frame, texture, first)
        return (*svgf.filter_history(fitted, history, frame, texture, statistics), invalid)

    reads = svgf.READS | {"luminance_gradient"}
    return svgf.complete(options, recurrent(Core(svgf.start, step, reads, lambda key, frame: zero_offsets(options))))


def accumulate(
    options: Options, state: svgf.SvgfState, frame: Frame, texture: jax.Array, first: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The history [9, H, W] with the frame blended in, faster where light has changed; the number of invalid pixels.

    ``texture`` [3, H, W] is what the division left in the frame.
    """
    past, invalid = svgf.reproject_history(options, state, frame, first)
    today = with_texture(past[:6], past[6:], texture)
    change = 1.0 - (1.0 - measure_change(options, today, frame)) ** options.antilag
    return svgf.blend(options, past, frame.radiance.transpose(2, 0, 1), texture, change), invalid


def measure_change(options: Options, past: jax.Array, frame: Frame) -> jax.Array:
    """lambda [H, W] in [0, 1]: the share by which light has changed since the previous frame.

    ``past`` is the fetched history [6, H, W], with the texture of the frame.
    """
    now = frame.radiance.transpose(2, 0, 1)
    hit = surface_mask(frame.depth, frame.ids)
    depth, normal, ids = (stratum_centers(buffer) for buffer in (frame.depth, frame.normal, frame.ids))
    strata = depth if depth is not None else frame.radiance  # without depth there is no weight of it
    by_light = options.gradient_stops == "light"
    light = measure_light(luminance(now), frame.ids) if by_light else None
    weights = svgf.surface_weights(options, depth, None if by_light else normal, ids, strata.shape[0])

    def filtered(change: Change) -> jax.Array:
        return reconstruct(
            change,
            surface_mask(depth, ids),
            weights,
            levels=options.gradient_levels,
            significance=options.significance,
            spacing=options.gradient_spacing,
            light=light,
        )

    if frame.luminance_gradient is None:
        share = filtered(compare_with_history(luminance(now), past, hit))
    else:
        change = compare_replayed(frame.luminance_gradient)
        share = lax.cond(
            jnp.any(change.size > 0),
            filtered,
            lambda _: filtered(compare_with_history(luminance(now), past, hit)),
            change,
        )
    return to_pixels(share, *now.shape[1:], enlarging=options.gradient_enlarging)
