"""Spatiotemporal variance-guided filtering (``svgf``), the common baseline of real-time denoising.

For each frame: divide by what surfaces reflect, fetch the history with a test of every tap, blend colour and the
moments of luminance into it, estimate the variance per pixel (temporally, or from a 7x7 neighbourhood while the history
is short), apply five a-trous levels whose luminance edge-stopping depends on that variance, and multiply again.

The colour history is the demodulated image after the first level (``feedback_level``), not the output image: feeding
the whole cascade back would blur more with every frame. The paper prescribes this; the learned denoisers here keep
their output image instead.

Christoph Schied et al., "Spatiotemporal Variance-Guided Filtering: Real-Time Reconstruction for Path-Traced Global
Illumination", 2017.
"""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Array, Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.accumulation import accumulate, with_texture
from jaxdn.filters.atrous import B3_SPLINE, stencil
from jaxdn.filters.cascade import cascade
from jaxdn.filters.edge_stopping import Weight, depth_weight, normal_weight
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, guides_of, surface_mask
from jaxdn.filters.variance import Spatial, estimate_variance
from jaxdn.methods.demodulation import Demodulation, demodulated, find_texture_left
from jaxdn.methods.learnable_options import (
    FITTING,
    LEARNABLE,
    LEARNABLE_PER_LEVEL,
    apply_offsets,
    at_level,
    zero_offsets,
)
from jaxdn.methods.light_apart import light_apart
from jaxdn.methods.registry import method
from jaxdn.methods.taa import taa

READS = frozenset({"normal", "depth", "previous_depth", "motion", "ids"})
PLANES = 9
"""Of a history, as of :func:`jaxdn.filters.accumulation.accumulate`."""
_TAPS = stencil(2, kernel=B3_SPLINE)
_POSITIVE = Range(0, without_low=True)
_SHARE = Range(0, 1, without_low=True)


@dataclass(frozen=True)
class SharedOptions:
    """The parameters of ``svgf`` that all filters made of its parts have."""

    alpha: Annotated[float, _SHARE, LEARNABLE] = 0.2
    """Minimum weight of the new frame in colour; the weight is ``max(alpha, 1 / N)`` at history length N."""
    ramp: bool = True
    """The new frame weighs at least 1 / N. Without, it is alpha from the second frame on, as in the paper (sec. 4.1):
    more noise in short histories, and the first frame weighs more than any other."""
    alpha_moments: Annotated[float, _SHARE, LEARNABLE] = 0.2
    """The same for the moments of luminance."""
    sigma_depth: Annotated[float, _POSITIVE, LEARNABLE_PER_LEVEL] = 1.0
    """Edge-stopping parameter for differences in depth."""
    sigma_normal: Annotated[float, Range(0), LEARNABLE_PER_LEVEL] = 16.0
    """Exponent of the cosine of normals. The paper's 128 keeps light of one curved or bumpy surface apart: at 1 sample
    per pixel 16 has 1.6 dB more on held-out clips."""
    sigma_luminance: Annotated[float, _POSITIVE, LEARNABLE_PER_LEVEL] = 4.0
    """Edge-stopping parameter for differences in luminance, in standard deviations."""
    levels: Annotated[int, Range(0, 10)] = 5
    """Levels of the a-trous filter."""
    feedback_level: Annotated[int, Range(0, 10)] = 1
    """The level whose image becomes the colour history; 0 is the temporally blended image."""
    history_max: Annotated[int, Range(1)] = 32
    """Maximum history length N in frames."""
    short_history: Annotated[int, Range(0)] = 4
    """For N below this the variance is estimated from the 7x7 neighbourhood."""
    spatial: Spatial = "image"
    """What such a short history takes from there: colour and variance, the latter times ``short_history / N``, with
    light for isolated pixels; or the ``"variance"`` alone, as in the paper (sec. 4.2)."""
    depth_tolerance: Annotated[float, Range(0)] = 0.02
    """Allowed relative difference of a history tap from the expected depth, in addition to the slope term."""
    normal_threshold: float = 0.9
    """A history tap is accepted above this cosine of normals."""
    demodulate: Demodulation = "brdf"
    """What radiance is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`."""

    def __post_init__(self) -> None:
        if self.feedback_level > self.levels:
            raise ValueError(
                f"feedback_level: expected a whole number from 0 to levels ({self.levels}), "
                f"got {self.feedback_level!r}."
            )


@dataclass(frozen=True)
class Options(SharedOptions):
    """All parameters; :data:`PAPER` says where the defaults are not those of the paper."""

    apart: bool = False
    """Direct light (``shadowed``) and all other light are two signals with histories and variances of their own, as in
    the paper (sec. 3), where the frames have it; twice the time."""
    antialiasing: bool = False
    """The image goes through ``taa(preset="paper")``: in tone-mapped light, as the paper's last stage."""


AS_PUBLISHED: dict[str, Any] = {
    "ramp": False,
    "spatial": "variance",
    "sigma_normal": 128.0,
    "demodulate": "albedo",
}
"""What the paper does and the defaults do not: a constant weight (sec. 4.1), the variance alone from neighbours (sec.
4.2), the exponent of normals (sec. 4.4), and light divided by the albedo (sec. 3). Its other numbers are the defaults:
alpha 0.2 for colour and moments, sigmas 1 and 4, five levels, the image of the first as history."""
PAPER = Options(apart=True, antialiasing=True, **AS_PUBLISHED)
"""The settings of Schied et al. 2017."""


class SvgfState(NamedTuple):
    """What is carried from one frame to the next."""

    history: jax.Array
    """[H, W, 9] demodulated colour, first and second moment of its luminance, history length in frames; the texture
    (3) that the division left in this light."""
    guides: Guides
    """Depth, normal and ids of the previous frame, as far as present."""


@method(
    Options,
    title="Spatiotemporal variance-guided filtering (Schied et al. 2017)",
    presets={"paper": PAPER},
    recipes={"usual": FITTING},
    variants={"svgf-fitted": {}},
    filter=True,
)
def svgf(options: Options) -> Denoiser:
    """SVGF, a filter that needs no weights: ``params`` are ``{}``, or move alpha, alpha_moments and the sigmas.

    Reads normal, depth, previous_depth, motion and ids; without a buffer, its test or weight is left out. With
    ``demodulate="brdf"`` it reads reflectance and albedo, with ``"albedo"`` albedo, with ``apart`` shadowed, too.
    Pixels without a surface (depth at ``FAR`` or id -1) pass through.
    Raises ValueError for options out of range and radiance that is not [H, W, 3].
    """

    def step(
        params: Params, state: SvgfState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[SvgfState, jax.Array, jax.Array]:
        fitted = apply_offsets(options, params)
        past, invalid = reproject_history(fitted, state, frame, first)
        texture = planar_texture(frame, fitted.demodulate, statistics)
        history = blend(fitted, past, frame.radiance.transpose(2, 0, 1), texture)
        return (*filter_history(fitted, history, frame, texture, statistics), invalid)

    def init(key: jax.Array, frame: Frame) -> Params:
        return zero_offsets(options)

    core = Core(start, step, READS, init, receptive_field=_receptive_field(options))
    return complete(options, recurrent(core))


def complete(options: Options, denoiser: Denoiser) -> Denoiser:
    """A filter of divided light with what surrounds it: the division, signals apart, antialiasing."""
    whole = demodulated(denoiser, by=options.demodulate)
    if options.apart:
        whole = light_apart(whole)
    return taa(preset="paper", after=whole) if options.antialiasing else whole


def _receptive_field(options: Options) -> int:
    """That of the levels, each with its blur of the variance, of 7x7 pixels and those beside them, and of slopes."""
    return 2 * (2**options.levels - 1) + options.levels + 6


def start(params: Params, frame: Frame) -> SvgfState:
    """No history."""
    nothing = jnp.zeros((*frame.radiance.shape[:2], PLANES), frame.radiance.dtype)
    return SvgfState(nothing, jax.tree.map(jnp.zeros_like, guides_of(frame)))


def reproject_history(
    options: SharedOptions, state: SvgfState, frame: Frame, first: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The fetched history [9, H, W], 0 where missing; the number of invalid history pixels."""
    found = reproject(
        state.history,
        state.guides,
        frame,
        first,
        depth_tolerance=options.depth_tolerance,
        normal_threshold=options.normal_threshold,
        search_neighbours=True,
    )
    return found.history.transpose(2, 0, 1), found.invalid


def planar_texture(frame: Frame, by: Demodulation, statistics: FrameStatistics) -> jax.Array:
    """The texture [3, H, W] that the division leaves in a frame inside ``demodulated``; 1 if it leaves none."""
    texture = find_texture_left(frame, by, statistics)
    return jnp.ones_like(frame.radiance).transpose(2, 0, 1) if texture is None else texture.transpose(2, 0, 1)


def blend(
    options: SharedOptions, past: jax.Array, now: jax.Array, texture: jax.Array, change: jax.Array | None = None
) -> jax.Array:
    """The history [9, H, W] with light [3, H, W] blended in; ``texture`` and ``change`` as in ``accumulate``."""
    return accumulate(
        past,
        now,
        alpha=options.alpha,
        alpha_moments=options.alpha_moments,
        history_max=options.history_max,
        ramp=options.ramp,
        texture=texture,
        change=change,
    )


def surface_weights(
    options: SharedOptions, depth: Array, normal: Array, ids: Array, height: jax.Array | float, level: Any = 0
) -> list[Weight]:
    """The edge-stopping weights of depth [H, W, 1] and normals [H, W, 3] at one level, as far as present.

    ``height`` is H of the whole frame, of which they may be a tile.
    """
    weights: list[Weight] = []
    if depth is not None:
        weights.append(depth_weight(depth, ids, sigma=at_level(options.sigma_depth, level), height=height))
    if normal is not None:
        weights.append(normal_weight(normal, sigma=at_level(options.sigma_normal, level)))
    return weights


def filter_history(
    options: SharedOptions, history: jax.Array, frame: Frame, texture: jax.Array, statistics: FrameStatistics
) -> tuple[SvgfState, jax.Array]:
    """The state after a frame and its image [H, W, 3], from the blended history [9, H, W].

    Light is filtered with the ``texture`` [3, H, W] of the frame, and kept with that of its history.
    """
    hit = surface_mask(frame.depth, frame.ids)
    mean_texture = history[6:]
    today = with_texture(history[:6], mean_texture, texture)

    def weights(level: Any) -> list[Weight]:
        return surface_weights(options, frame.depth, frame.normal, frame.ids, statistics.height, level)

    short: dict[str, Any] = {"short_history": options.short_history, "spatial": options.spatial}
    color, variance = estimate_variance(today, hit, weights(0), texture=texture, **short)
    image, feedback = cascade(
        color,
        variance,
        hit,
        weights,
        _TAPS,
        levels=options.levels,
        sigma_luminance=options.sigma_luminance,
        texture=texture,
        feedback=color if options.feedback_level else today[:3],
        feedback_level=options.feedback_level,
    )
    image = image.transpose(1, 2, 0)
    if hit is not None:
        image = jnp.where(hit[..., None], image, frame.radiance)
    kept = jnp.concatenate([brdf.restore(feedback, mean_texture, texture), history[3:]]).transpose(1, 2, 0)
    return SvgfState(kept, guides_of(frame)), image
