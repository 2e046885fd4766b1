"""``reblur``: a recurrent blur of diffuse and specular light, wide where little is known and narrow where much is.

For each frame and for both kinds of light, divided by what their lobes reflect: average four taps around each pixel;
fetch the history, for reflections along the motion of their virtual image, and blend into a slow and into a fast
running mean; let the slow one follow the fast one (:func:`jaxdn.methods.two_lobes.histories.correct_lag`); blur by two
discs of eight taps, the second twice as wide as the first, whose radius shrinks with the number of frames accumulated
and with the distance to what the light comes from; and steady the luminance.

The history is the blurred image: unlike in ``svgf`` and ``relax``, there are no levels and no variance, and what one
frame's few taps miss those of the next frames find.

After descriptions of ReBLUR, a denoiser of NVIDIA's library NRD (2020 to 2025), and derived anew; simpler, as the
documentation says.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.accumulation import texture_ratio
from jaxdn.filters.clamping import clamp_fireflies
from jaxdn.filters.disc import TAPS, disc_average, rotations
from jaxdn.filters.edge_stopping import closeness_weight
from jaxdn.filters.stabilisation import stabilise
from jaxdn.filters.virtual_motion import closeness_of
from jaxdn.methods.learnable_options import FITTING, LEARNABLE, apply_offsets, zero_offsets
from jaxdn.methods.lobes import READS
from jaxdn.methods.registry import method
from jaxdn.methods.two_lobes import histories
from jaxdn.methods.two_lobes.histories import LobeState, Signal

_PLANES = 12
"""Planes of a history: colour (3), length in frames, fast colour (3), steady luminance, closeness of diffuse hits, and
the texture (3) of both colours and of the luminance.
"""
_LENGTH = 3
_ALIKE, _LEAST = 0.2, 0.1
"""How much closeness may differ between taps of a reflection, and the weight of a tap that differs more."""


@dataclass(frozen=True)
class Options(histories.Options):
    """The options that filters of light by lobes share, and those of the discs."""

    pre_radius: Annotated[float, Range(0)] = 4.0
    """Radius in pixels of four taps that are averaged before the accumulation; 0: none."""
    radius: Annotated[float, Range(0)] = 8.0
    """Radius in pixels of the first disc after it, for a history of one frame; of N frames: ``radius / sqrt(N)``."""
    radius_min: Annotated[float, Range(0)] = 1.0
    """It is at least this."""
    stable_sigma: Annotated[float, Range(0), LEARNABLE] = 1.0
    """Steady luminance may be this many standard deviations from the mean of 3x3 pixels."""
    stable_max: Annotated[int, Range(1)] = 30
    """Maximum length of the mean of luminance in frames; 1: it is not steadied. It is no longer than the history: more
    than ``history_max`` is the same as that."""


PAPER = Options(
    fix_frames=3,
    lobe_fraction=0.15,
    plane_tolerance=0.02,
    pre_radius=30.0,
    radius=30.0,
    radius_min=1.0,
    stable_max=63,
    **histories.AS_PUBLISHED,
)
"""The constants of ReBLUR in NRD 4.14, which no paper describes: three frames are filled, discs of 30 pixels before the
accumulation (of diffuse light; NRD has 50 for specular light) and after it, at least 1, a luminance of 63 frames, of
which only the 30 of the history count here, 0.15 of the lobe's angle, and planes within 0.02 of the depth."""


class ReblurState(NamedTuple):
    """What is carried from one frame to the next."""

    light: LobeState
    """Planes as they are numbered in this module."""
    frame: jax.Array
    """int32, how many frames there were: it turns the discs."""


@method(
    Options,
    title="Diffuse and specular light apart, a recurrent blur by rotated discs (after ReBLUR)",
    presets={"paper": PAPER},
    recipes={"usual": FITTING},
    filter=True,
)
def reblur(options: Options) -> Denoiser:
    """The filter; ``params`` are ``{}``, or move its sigmas, its fractions, ``history_max`` and ``fast_max``; its
    radii have no gradient.

    Reads what ``relax`` reads, and hit_distance. Without ``hit_distance`` and ``specular_hit_distance`` the radius of
    the discs depends on the history alone. Without ``specular`` all light is filtered as diffuse; without
    ``specular_hit_distance`` or ``far_motion`` reflections are fetched where their surface was; without ``roughness``
    they are as wide as diffuse light; without any other buffer its test or weight is left out. Pixels without a surface
    (depth at ``FAR`` or id -1) pass through. Raises ValueError for options out of range and radiance that is not
    [H, W, 3].
    """

    def start(params: Params, frame: Frame) -> ReblurState:
        return ReblurState(histories.start(frame, _PLANES), jnp.zeros((), jnp.int32))

    def step(
        params: Params, state: ReblurState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[ReblurState, jax.Array, jax.Array]:
        fitted = apply_offsets(options, params)
        number = jnp.where(first, 0, state.frame)
        near = closeness_of(frame.hit_distance, frame)

        def filter_signal(signal: Signal) -> tuple[jax.Array, jax.Array]:
            return _filter_signal(fitted, signal, near, number)

        light, image, invalid = histories.step(
            fitted, filter_signal, state.light, frame, first, statistics, length_plane=_LENGTH
        )
        return ReblurState(light, number + 1), image, invalid

    return recurrent(Core(start, step, READS | {"hit_distance"}, lambda key, frame: zero_offsets(options)))


def _filter_signal(
    options: Options, signal: Signal, diffuse_closeness: jax.Array | None, number: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The new history [12, H, W] of one kind of light, and its image [3, H, W]."""
    now, texture, past = signal.now.light, signal.now.known_texture(), signal.past
    shape = now.shape[1:]
    length = jnp.minimum(past[_LENGTH] + 1.0, options.history_max)
    share = 1.0 / length
    near = diffuse_closeness if signal.diffuseness is None else signal.closeness
    kept = jnp.zeros(shape, now.dtype)
    if signal.diffuseness is None and near is not None:
        kept = near = _blend_closeness(past[8], near, share)
    wide = jnp.ones(shape, now.dtype) if signal.diffuseness is None else signal.diffuseness
    far = wide if near is None else wide * jnp.sqrt(_hit_factor(near))
    weights = list(signal.weights)
    if signal.diffuseness is not None and near is not None:
        weights.append(closeness_weight(near, tolerance=_ALIKE, least=_LEAST))

    def blur(light: jax.Array, radius: jax.Array, turn: int) -> jax.Array:
        angle = rotations(shape, 6 * number + (3 if signal.diffuseness is None else 0) + turn, now.dtype)
        planes = jnp.concatenate([light, texture])
        mean = disc_average(planes, signal.hit, weights, radius, angle, taps=TAPS if turn else TAPS[:4])
        return brdf.restore(mean[:3], texture, mean[3:])

    if options.pre_radius:
        now = blur(now, options.pre_radius * far, 0)
    past_texture = past[9:12]
    mean_texture = past_texture + share[None] * (texture - past_texture)
    slow = brdf.restore(past[:3] + share[None] * (now - past[:3]), texture, mean_texture)
    fast = histories.update_fast_mean(options, past[4:7], past_texture, now, texture, length)
    held, length, _ = histories.correct_lag(options, signal._replace(weights=weights), slow, fast, length)
    if options.anti_firefly:
        held = clamp_fireflies(held, signal.surface_planes)
    if options.radius:
        radius = jnp.maximum(options.radius * far / jnp.sqrt(length), options.radius_min * wide)
        held = blur(blur(held, radius, 1), 2.0 * radius, 2)
    stable_length = jnp.minimum(length, options.stable_max)
    past_steady = past[7] * texture_ratio(past_texture, texture)
    image, steady = stabilise(held, past_steady, 1.0 - 1.0 / stable_length, signal.hit, sigma=options.stable_sigma)
    steady = steady * texture_ratio(texture, mean_texture)
    colours = [brdf.restore(light, mean_texture, texture) for light in (held, fast)]
    return jnp.concatenate([colours[0], length[None], colours[1], steady[None], kept[None], mean_texture]), image


def _blend_closeness(past: jax.Array, now: jax.Array, share: jax.Array) -> jax.Array:
    """Closeness [H, W] with less noise; 0 means unknown in both."""
    mixed = jnp.where(past > 0, past + share * (now - past), now)
    return jnp.where(now > 0, mixed, past)


def _hit_factor(closeness: jax.Array) -> jax.Array:
    """``min(h / t, 1)`` [H, W], with the hit distance h and the camera ray's length t; 1 where it is not known.

    The distance to what the light comes from, in parts of about what the image shows at the surface's distance.
    """
    known = closeness > 0
    return jnp.where(known, jnp.clip(1.0 / jnp.where(known, closeness, 1.0) - 1.0, 0.0, 1.0), 1.0)
