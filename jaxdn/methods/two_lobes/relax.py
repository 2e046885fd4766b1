"""``relax``: a variance-guided filter for diffuse and specular light apart, whose fast history holds the slow one.

For each frame and for both kinds of light, divided by what their lobes reflect: fetch the history, for reflections
along the motion of their virtual image; blend the frame into a slow and into a fast running mean; where the fast mean
contradicts the slow one, go on from the fast one; fill what has hardly any history from far around; clamp the slow mean
to what the fast one shows near by, so that light that changed does not linger; on request, remove fireflies; estimate
the variance, and apply a-trous levels guided by it, for reflections as narrow in normals and roughness as their lobe
is.

The history is the clamped mean, before the spatial filter: unlike in ``svgf``, nothing filtered is fed back.

After descriptions of ReLAX, a denoiser of NVIDIA's library NRD (2021 to 2025), and derived anew; simpler, as the
documentation says.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.accumulation import accumulate, after_shift, with_texture
from jaxdn.filters.atrous import GAUSSIAN, stencil
from jaxdn.filters.cascade import cascade
from jaxdn.filters.clamping import clamp_fireflies
from jaxdn.filters.variance import estimate_variance
from jaxdn.methods.learnable_options import FITTING, LEARNABLE_PER_LEVEL, apply_offsets, zero_offsets
from jaxdn.methods.lobes import READS
from jaxdn.methods.registry import method
from jaxdn.methods.two_lobes import histories
from jaxdn.methods.two_lobes.histories import LobeState, Signal

_PLANES = 12
"""Planes of a history: colour (3), two moments of its luminance, length in frames, texture (3), fast colour (3).

The texture is that of both colours and of the moments.
"""
_LENGTH = 5
_TAPS = stencil(1, kernel=GAUSSIAN)
_POSITIVE = Range(0, without_low=True)


@dataclass(frozen=True)
class Options(histories.Options):
    """The options that filters of light by lobes share, and those of the a-trous filter."""

    short_history: Annotated[int, Range(0)] = 4
    """For N below this the variance is estimated from the 7x7 neighbourhood."""
    levels: Annotated[int, Range(0, 10)] = 5
    """Levels of the a-trous filter."""
    sigma_diffuse: Annotated[float, _POSITIVE, LEARNABLE_PER_LEVEL] = 2.0
    """Edge-stopping parameter for differences in luminance, in standard deviations, of diffuse light."""
    sigma_specular: Annotated[float, _POSITIVE, LEARNABLE_PER_LEVEL] = 2.0
    """The same of specular light."""


PAPER = Options(
    fix_frames=4,
    short_history=3,
    sigma_specular=1.0,
    lobe_fraction=0.5,
    plane_tolerance=0.003,
    **histories.AS_PUBLISHED,
)
"""The constants of ReLAX in NRD 4.14, which no paper describes: four frames are filled, neighbours give the variance of
fewer than three, sigmas 2 of diffuse (the default) and 1 of specular light, half of the lobe's angle, and planes within
0.003 of the depth."""


@method(
    Options,
    title="Diffuse and specular light apart, a slow history clamped to a fast one (after ReLAX)",
    presets={"paper": PAPER},
    recipes={"usual": FITTING},
    variants={"relax-fitted": {}},
    filter=True,
)
def relax(options: Options) -> Denoiser:
    """The filter; ``params`` are ``{}``, or move its sigmas, its fractions, ``history_max`` and ``fast_max``.

    Reads specular, reflectance, specular_reflectance, albedo, normal, depth, previous_depth, roughness, motion, ids,
    specular_hit_distance, ray_length and far_motion. Without ``specular`` all light is filtered as diffuse; without
    ``specular_hit_distance`` or ``far_motion`` reflections are fetched where their surface was; without ``roughness``
    they are as wide as diffuse light; without any other buffer its test or weight is left out. Pixels without a surface
    (depth at ``FAR`` or id -1) pass through. Raises ValueError for options out of range and radiance that is not
    [H, W, 3].
    """

    def start(params: Params, frame: Frame) -> LobeState:
        return histories.start(frame, _PLANES)

    def step(
        params: Params, state: LobeState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[LobeState, jax.Array, jax.Array]:
        fitted = apply_offsets(options, params)
        given = state, frame, first, statistics
        return histories.step(fitted, lambda signal: _filter_signal(fitted, signal), *given, length_plane=_LENGTH)

    return recurrent(Core(start, step, READS, lambda key, frame: zero_offsets(options)))


def _filter_signal(options: Options, signal: Signal) -> tuple[jax.Array, jax.Array]:
    """The new history [12, H, W] of one kind of light, and its image [3, H, W]."""
    now, texture, past = signal.now.light, signal.now.known_texture(), signal.past
    means: dict[str, Any] = {"alpha": 0.0, "alpha_moments": 0.0, "history_max": options.history_max}
    blended = accumulate(past[:9], now, texture=texture, **means)
    mean_texture = blended[6:]
    slow = with_texture(blended[:6], mean_texture, texture)
    fast = histories.update_fast_mean(options, past[9:12], past[6:9], now, texture, slow[_LENGTH])
    held, length, shift = histories.correct_lag(options, signal, slow[:3], fast, slow[_LENGTH])
    moments = after_shift(slow[3:5], shift)
    today = jnp.concatenate([held, moments, length[None]])
    kept = with_texture(today, texture, mean_texture), mean_texture, brdf.restore(fast, mean_texture, texture)
    calm = clamp_fireflies(held, signal.surface_planes) if options.anti_firefly else held
    calm_history = jnp.concatenate([calm, moments, length[None]])
    own: dict[str, Any] = {"texture": signal.now.texture}
    short: dict[str, Any] = {"short_history": options.short_history, "isolated": signal.diffuseness is None}
    calm, variance = estimate_variance(calm_history, signal.hit, signal.weights, **short, **own)
    sigma = options.sigma_diffuse if signal.diffuseness is None else options.sigma_specular
    own |= {"levels": options.levels, "sigma_luminance": sigma}
    image, _ = cascade(calm, variance, signal.hit, lambda level: signal.weights, _TAPS, **own)
    return jnp.concatenate(kept), image
