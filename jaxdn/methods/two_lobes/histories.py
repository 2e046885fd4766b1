"""What filters of diffuse and specular light apart have in common: their options, weights, and how histories respond.

Each kind of light has a slow and a fast running mean; the fast one tells where the slow one is outdated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Frame
from jaxdn.core.options import Range
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.accumulation import luminance
from jaxdn.filters.clamping import clamp_to_fast, detect_lag
from jaxdn.filters.edge_stopping import (
    Weight,
    depth_weight,
    lobe_weight,
    normal_weight,
    plane_weight,
    roughness_weight,
)
from jaxdn.filters.history_fix import fix_history
from jaxdn.filters.surface_test import Guides, guides_of, surface_mask
from jaxdn.filters.virtual_motion import diffuseness
from jaxdn.methods.demodulation import Demodulation
from jaxdn.methods.learnable_options import LEARNABLE
from jaxdn.methods.lobes import DemodulatedLight, kept_closeness, previous_guides, reproject_signals, split_signals

_POSITIVE = Range(0, without_low=True)
_AROUND = 3
"""Radius of the squares in which both histories are compared."""


@dataclass(frozen=True)
class Options:
    """The options that these filters share."""

    history_max: Annotated[int, Range(1), LEARNABLE] = 30
    """Maximum length of the slow history in frames: the new frame's weight is 1 / N."""
    fast_max: Annotated[int, Range(1), LEARNABLE] = 6
    """The same of the fast history."""
    fix_frames: Annotated[int, Range(0, 8)] = 4
    """Histories up to this length are filled from sparse taps around."""
    fix_widest: Annotated[int, Range(1)] = 4
    """These taps are ``fix_widest / (1 + N)`` pixels apart for a history of N frames."""
    clamp_sigma: Annotated[float, _POSITIVE, LEARNABLE] = 4.0
    """The slow history may be this many standard deviations from the fast one's mean over 5x5 pixels."""
    lag_sigma: Annotated[float, _POSITIVE, LEARNABLE] = 3.0
    """Where the means of both histories over 7x7 pixels differ by more than this many standard errors, the slow one
    takes over colour and length of the fast one."""
    anti_firefly: bool = False
    """Clamp each pixel to the range of its eight neighbours before the spatial filter. It steadies the image and
    darkens it: noise of few samples is mostly such peaks."""
    sigma_depth: Annotated[float, _POSITIVE, LEARNABLE] = 1.0
    """Edge-stopping parameter for differences in depth."""
    plane_tolerance: Annotated[float, Range(0)] = 0.0
    """Instead of that weight, taps count that are within this share of the depth of the plane of the pixel's surface;
    0: no such test."""
    sigma_normal: Annotated[float, Range(0), LEARNABLE] = 16.0
    """Exponent of the cosine of normals, for diffuse light."""
    lobe_fraction: Annotated[float, _POSITIVE, LEARNABLE] = 2.0
    """For specular light, normals may differ by this fraction of the lobe's angle."""
    roughness_fraction: Annotated[float, _POSITIVE, LEARNABLE] = 1.0
    """For specular light, roughness may differ by this fraction."""
    depth_tolerance: Annotated[float, Range(0)] = 0.02
    """Allowed relative difference of a history tap from the expected depth, in addition to the slope term."""
    normal_threshold: float = 0.9
    """A history tap is accepted above this cosine of normals."""
    demodulate: Demodulation = "brdf"
    """What light is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`; diffuse and specular
    light each by its own part."""


AS_PUBLISHED: dict[str, Any] = {
    "history_max": 30,
    "fast_max": 6,
    "fix_widest": 14,
    "clamp_sigma": 2.0,
    "roughness_fraction": 0.15,
}
"""Constants of NRD 4.14 (2025) that ReLAX and ReBLUR share, from its public settings: lengths of both histories, the
width of the taps that fill, the clamp, and the tolerance of roughness."""


class LobeState(NamedTuple):
    """What is carried from one frame to the next."""

    diffuse: jax.Array
    """[H, W, C] the planes of a history."""
    specular: jax.Array | None
    """[H, W, C + 2] the same, closeness of the reflected thing, roughness; None without specular light."""
    guides: Guides
    """Depth, normal and ids of the previous frame, as far as present."""


class Signal(NamedTuple):
    """One kind of light in one frame."""

    past: jax.Array
    """[C, H, W] its history."""
    now: DemodulatedLight
    weights: list[Weight]
    """Edge-stopping weights."""
    hit: jax.Array | None
    """[H, W] bool, a surface is seen; None: everywhere."""
    surface_planes: jax.Array | None
    """[n, H, W] planes that are equal on one surface; None: all is one."""
    diffuseness: jax.Array | None
    """[H, W] in [0, 1], how much of a reflection may be taken from around; None: diffuse light, 1."""
    closeness: jax.Array | None
    """[H, W] of what is reflected; 0 where it is unknown; None: everywhere."""


Filter = Callable[[Signal], tuple[jax.Array, jax.Array]]
"""What a method does with one kind of light: its new history [C, H, W] and its image [3, H, W], still divided."""


def start(frame: Frame, planes: int) -> LobeState:
    """No history, of so many planes."""
    nothing = jnp.zeros((*frame.radiance.shape[:2], planes + 2), frame.radiance.dtype)
    specular = None if frame.specular is None else nothing
    return LobeState(nothing[..., :planes], specular, previous_guides(frame))


def step(
    options: Options,
    filter_signal: Filter,
    state: LobeState,
    frame: Frame,
    first: jax.Array,
    statistics: FrameStatistics,
    *,
    length_plane: int,
) -> tuple[LobeState, jax.Array, jax.Array]:
    """The state after a frame, its image [H, W, 3], and how many pixels of the histories were not valid.

    ``filter_signal`` is called for diffuse light and, where the frame has it, for specular light. Pixels without a
    surface keep their radiance. ``length_plane`` is the plane of a history that holds its length.
    """
    diffuse, specular = split_signals(frame, options.demodulate, statistics)
    before = None if specular is None else state.specular
    if specular is not None and before is None:  # it has come within the clip
        before = jnp.pad(jnp.zeros_like(state.diffuse), ((0, 0), (0, 0), (0, 2)))
    past = reproject_signals(
        state.diffuse,
        before,
        state.guides,
        frame,
        first,
        length_plane=length_plane,
        depth_tolerance=options.depth_tolerance,
        normal_threshold=options.normal_threshold,
    )
    hit = surface_mask(frame.depth, frame.ids)
    equal = [] if hit is None else [hit]
    if frame.ids is not None:
        equal.append(frame.ids[..., 0])
    same = jnp.stack([each.astype(frame.radiance.dtype) for each in equal]) if equal else None
    weights = _weights(options, frame, statistics.height)
    history, image = filter_signal(Signal(past.diffuse, diffuse, weights[0], hit, same, None, None))
    image = diffuse.remodulate(image)
    kept = LobeState(history.transpose(1, 2, 0), None, guides_of(frame))
    if specular is not None and past.specular is not None:
        stays = diffuseness(_roughness(frame)[..., 0])
        history, reflected = filter_signal(
            Signal(past.specular, specular, weights[1], hit, same, stays, past.closeness)
        )
        image = image + specular.remodulate(reflected)
        planes = jnp.concatenate([history, jnp.stack(kept_closeness(past.closeness, frame))])
        kept = kept._replace(specular=planes.transpose(1, 2, 0))
    if hit is not None:
        image = jnp.where(hit[..., None], image, frame.radiance)
    return kept, image, past.invalid


def _roughness(frame: Frame) -> jax.Array:
    shape = (*frame.radiance.shape[:2], 1)
    return jnp.ones(shape, frame.radiance.dtype) if frame.roughness is None else frame.roughness


def _weights(options: Options, frame: Frame, height: jax.Array) -> tuple[list[Weight], list[Weight]]:
    """Edge-stopping weights of diffuse and of specular light."""
    diffuse: list[Weight] = []
    if frame.depth is not None and options.plane_tolerance:
        diffuse.append(plane_weight(frame.depth, frame.ids, tolerance=options.plane_tolerance))
    elif frame.depth is not None:
        diffuse.append(depth_weight(frame.depth, frame.ids, sigma=options.sigma_depth, height=height))
    specular = list(diffuse)
    if frame.normal is not None:
        diffuse.append(normal_weight(frame.normal, sigma=options.sigma_normal))
        specular.append(lobe_weight(frame.normal, _roughness(frame), fraction=options.lobe_fraction))
    if frame.roughness is not None:
        specular.append(roughness_weight(frame.roughness, fraction=options.roughness_fraction))
    return diffuse, specular


def update_fast_mean(
    options: Options, past: jax.Array, past_texture: jax.Array, now: jax.Array, texture: jax.Array, length: jax.Array
) -> jax.Array:
    """The fast history [3, H, W] with colour ``now`` blended in, with the ``texture`` [3, H, W] of the frame.

    ``past_texture`` [3, H, W] is that of the past, ``length`` [H, W] that of the slow history.
    """
    share = jnp.maximum(1.0 / options.fast_max, 1.0 / length)[None]
    return brdf.restore(past + share * (now - past), texture, past_texture + share * (texture - past_texture))


class CorrectedHistory(NamedTuple):
    """A slow history that the fast one has held."""

    color: jax.Array
    """[3, H, W]."""
    length: jax.Array
    """[H, W] in frames."""
    luminance_shift: jax.Array
    """[H, W] by how much the luminance was changed because it was outdated."""


def correct_lag(
    options: Options, signal: Signal, slow: jax.Array, fast: jax.Array, length: jax.Array
) -> CorrectedHistory:
    """The slow history [3, H, W] after what contradicts it and what it lacks.

    Where the fast one shows another brightness around a pixel, it takes over colour and length
    (:func:`jaxdn.filters.clamping.detect_lag`); where it has just begun it is filled from around
    (:func:`jaxdn.filters.history_fix.fix_history`); then it is clamped to what the fast one shows near by
    (:func:`jaxdn.filters.clamping.clamp_to_fast`).
    """
    level = luminance(slow)
    lag = detect_lag(level, luminance(fast), signal.hit, sigma=options.lag_sigma, radius=_AROUND)
    length = length + lag * (jnp.minimum(length, options.fast_max) - length)
    new = slow + lag[None] * (fast - slow)
    fixed = fix_history(
        new,
        length,
        signal.hit,
        signal.weights,
        frames=options.fix_frames,
        widest=options.fix_widest,
        texture=signal.now.texture,
        isolated=signal.diffuseness is None,
    )
    if signal.diffuseness is not None:
        fixed = new + signal.diffuseness[None] * (fixed - new)
    held = clamp_to_fast(fixed, fast, signal.hit, sigma=options.clamp_sigma)
    return CorrectedHistory(held, length, luminance(held) - luminance(fixed) + luminance(new) - level)
