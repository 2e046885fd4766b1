"""Light filtered by affinities at several levels: at full resolution, at half, and enlarged again along the guides.

Every level is an :mod:`jaxdn.ops.affinity_filter` whose taps lie twice as far apart as those of the level before. How
alike two pixels are is told by albedo, gloss, normal, depth and features that somebody has learned; how far each can be
trusted and how much of each level it takes is decided for every pixel as well: by a network, in
:mod:`jaxdn.methods.steady`.

A mean over neighbours is wrong where light is not the same on both sides: it flattens what is curved, and at the edge
of a surface it takes from inside alone. So what the levels at half resolution took away from the light is filtered in
its turn, by two of them, and a share of it is given back: for linear filters S and T, ``S x + s T (x - S x)`` (S = T
and s = 1: twicing, Tukey 1977), whose bias is of a higher order and whose noise is larger.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.filters import lag
from jaxdn.filters.enlarge import enlarge
from jaxdn.filters.guides import depth_slopes, hit_mask
from jaxdn.frame import FAR, Frame
from jaxdn.networks import pad
from jaxdn.ops.affinity_filter import Guide, affinity_filter
from jaxdn.scales import downsample, fill
from jaxdn.whole import Whole

LEVELS = 4
"""Levels at half resolution, taps 2, 4, 8 and 16 pixels apart."""
_AGAIN = (1, 2)
"""Those that what was taken away goes through again: with all four, nothing changes but the time and the reach."""
BLOCKS = 4
"""Height and width that the filters work on are multiples of this: blocks of 4x4 pixels are filled."""
_LIKENESS = 0.02
"""Weight of coarse pixels at which half of the enlarged image is taken."""
_LEAST_TRUST = 1e-3
"""So that a pixel is filtered even where none is trusted."""


class Surfaces(NamedTuple):
    """A frame's guides, padded; 0 is the neutral value."""

    albedo: jax.Array
    """[H, W, 3] what is reflected at all, less 1."""
    gloss: jax.Array
    """[H, W, 1] how much of that is not diffuse: a metal frame on a wall as bright as it shows other light."""
    normal: jax.Array
    roughness: jax.Array
    depth: jax.Array | None
    hit: jax.Array
    """[H, W, 1] bool, there is a surface."""


class Filtered(NamedTuple):
    """Light [H, W, 3] after the levels."""

    fine: jax.Array
    """After those at full resolution."""
    image: jax.Array
    """After all of them, with the change."""
    change: jax.Array
    """What the mean lacked (:mod:`jaxdn.filters.lag`)."""


class Decisions(NamedTuple):
    """What is decided about the pixels of a frame."""

    features: jax.Array
    """[F, H, W]."""
    mean_features: jax.Array
    """[F, H/2, W/2] their means over blocks."""
    trust: jax.Array
    """[H, W, 1] in [0, 1]."""
    coarse: jax.Array
    """[H, W, 1] in [0, 1], how much of the image of the levels at half resolution is taken."""
    half_features: jax.Array
    """[G, H/2, W/2]."""
    half_trust: jax.Array
    """[H/2, W/2, 1] in [0, 1]."""
    take: list[jax.Array]
    """Level at half resolution -> [H/2, W/2, 1] in [0, 1]."""
    back: jax.Array | None
    """[H/2, W/2, 1] in [0, 1], how much is given back of what these levels took away; None for nothing."""


def surfaces_of(frame: Frame) -> Surfaces:
    """The guides of a frame, its size padded to a multiple of :data:`BLOCKS`."""
    nothing = jnp.zeros_like(frame.radiance)
    height, width = nothing.shape[:2]
    reflectance = frame.albedo if frame.reflectance is None else frame.reflectance
    both = frame.albedo is not None and frame.reflectance is not None
    gloss = jnp.mean(frame.reflectance - frame.albedo, axis=-1, keepdims=True) if both else nothing[..., :1]
    hit = hit_mask(frame.depth, frame.ids)
    hit = jnp.ones((height, width), bool) if hit is None else hit
    return Surfaces(
        pad(nothing if reflectance is None else reflectance - 1.0, BLOCKS),
        pad(gloss, BLOCKS),
        pad(nothing if frame.normal is None else frame.normal, BLOCKS),
        pad(nothing[..., :1] if frame.roughness is None else frame.roughness - 1.0, BLOCKS),
        None if frame.depth is None else pad(frame.depth, BLOCKS),
        # What is padded is no surface: noise of the last row would count as often as it is repeated.
        jnp.pad(hit, ((0, -height % BLOCKS), (0, -width % BLOCKS)))[..., None],
    )


def slanted(surfaces: Surfaces, whole: Whole) -> jax.Array:
    """[3, H, W] inverse depth relative to its mean, which is affine on planes, and its slopes; 0 without a surface."""
    depth = surfaces.depth
    if depth is None:
        return jnp.zeros_like(planar(surfaces.normal))
    known = (depth > 0) & (depth < FAR)
    inverse = jnp.where(known, 1.0 / jnp.where(known, depth, 1.0), 0.0) / whole.middle_inverse
    return jnp.stack([inverse[..., 0], *depth_slopes(inverse, None)])


def filtered(
    precisions: Mapping[str, Any],
    mean: jax.Array,
    missed: jax.Array | None,
    texture: jax.Array | None,
    surfaces: Surfaces,
    slanted: jax.Array,
    decided: Decisions,
    full_levels: int,
) -> Filtered:
    """The light [H, W, 3] ``mean`` after the levels, and with a change of light.

    ``missed`` is how much more the newest frame shows than the mean; None leaves a change out. ``precisions`` are
    logarithms, one for full resolution and one for each level at half, of what the squares of differences in
    ``albedo``, ``gloss``, ``normal``, ``depth`` and ``learned`` features are multiplied by. The image of the levels at
    half resolution is enlarged along the guides, and takes a share of every pixel. The ``texture`` that a division of
    the light left is filtered likewise, and given back (:func:`jaxdn.brdf.restore`).
    """
    factors = {name: jnp.exp(0.5 * logarithm) for name, logarithm in precisions.items()}
    at_full = _at_level(_guide(surfaces, slanted, decided.features, decided.trust), factors, 0)
    fine = planar(mean if texture is None else jnp.concatenate([mean, texture], axis=-1))
    for index in range(full_levels):
        fine = affinity_filter(fine, at_full, step=2**index)
    fine = fine.transpose(1, 2, 0)
    half = _halved(surfaces)
    slanted_half = slanted[:, ::2, ::2] * jnp.asarray([1.0, 2.0, 2.0])[:, None, None]
    at_half = _guide(half, slanted_half, decided.half_features, decided.half_trust)
    levels = [_at_level(at_half, factors, 1 + index) for index in range(LEVELS)]
    coarse = _coarse(downsample(fill(fine, surfaces.hit)), levels, decided)
    both = coarse
    if missed is not None:
        # By surfaces alone: what is learned knows a pixel's noise, and lets a bright sample count for less.
        plain = _guide(half, slanted_half, decided.half_features[:0], jnp.ones_like(decided.half_trust))
        levels = [_at_level(plain, factors, 1 + index) for index in range(LEVELS)]
        change = _change(downsample(missed), levels, coarse[..., :3], half.hit)
        both = jnp.concatenate([coarse, change], axis=-1)
    there = _guide(half, slanted[:, ::2, ::2], decided.mean_features, decided.half_trust)
    enlarged, weight = enlarge(planar(both), there, at_full)
    alike = (weight / (weight + _LIKENESS))[..., None]
    coarse, change = jnp.split(enlarged.transpose(1, 2, 0), (coarse.shape[-1],), axis=-1)
    image = fine + decided.coarse * alike * (coarse - fine)
    change = jnp.zeros_like(mean) if missed is None else alike * change
    now = jnp.maximum(image[..., :3] + change, 0.0)
    if texture is None:
        return Filtered(fine, now, change)
    fine = brdf.restore(fine[..., :3], texture, fine[..., 3:])
    return Filtered(fine, brdf.restore(now, texture, image[..., 3:]), change)


def _halved(surfaces: Surfaces) -> Surfaces:
    """The surfaces at half resolution, but roughness and depth, which no level reads."""
    return surfaces._replace(
        albedo=downsample(surfaces.albedo),
        gloss=downsample(surfaces.gloss),
        normal=downsample(surfaces.normal),
        hit=downsample(surfaces.hit.astype(surfaces.albedo.dtype)) > 0,
    )


def _guide(surfaces: Surfaces, slanted: jax.Array, own: jax.Array, trust: jax.Array) -> Guide:
    """Surfaces and ``own`` features [F, H, W], not yet scaled; what is no surface gives nothing."""
    given = jnp.concatenate([surfaces.albedo, surfaces.gloss, surfaces.normal], axis=-1)
    confidence = ((trust + _LEAST_TRUST) * surfaces.hit)[..., 0]
    return Guide(jnp.concatenate([planar(given), own]), slanted, confidence)


def _at_level(guide: Guide, factors: Mapping[str, jax.Array], index: int) -> Guide:
    """The guide with the factors of one level."""
    count = {"albedo": 3, "gloss": 1, "normal": 3, "learned": guide.features.shape[0] - 7, "depth": 1}
    return guide._replace(scales=jnp.concatenate([jnp.full(n, factors[name][index]) for name, n in count.items()]))


def _coarse(light: jax.Array, guides: list[Guide], decided: Decisions) -> jax.Array:
    """The light (and texture) at half resolution after its levels, with what is given back of the light."""

    def smoothed(light: jax.Array, levels: Iterable[int]) -> jax.Array:
        for index in levels:
            smoother = affinity_filter(planar(light), guides[index], step=2**index).transpose(1, 2, 0)
            light = light + decided.take[index] * (smoother - light)
        return light

    found = smoothed(light, range(LEVELS))
    if decided.back is None:
        return found
    lost = smoothed(light[..., :3] - found[..., :3], _AGAIN)
    # A difference may be negative, light may not.
    return jnp.concatenate([jnp.maximum(found[..., :3] + decided.back * lost, 0.0), found[..., 3:]], axis=-1)


def _change(missed: jax.Array, guides: list[Guide], light: jax.Array, hit: jax.Array) -> jax.Array:
    """The change of light [H/2, W/2, 3], told from what the mean lacks of the newest frame.

    Every level is taken whole: a single frame needs all of them, where a mean of many needs few.
    """
    planes = planar(lag.halves(missed))
    for index, guide in enumerate(guides):
        planes = affinity_filter(planes, guide, step=2**index)
    return lag.change(planes.transpose(1, 2, 0), light, hit)


def reach(full_levels: int, *, twice: bool, at_once: bool) -> int:
    """How far, in pixels, :func:`filtered` sees; 16 of them for blocks, slopes and what is enlarged."""
    half = sum(4 * 2**index for index in range(LEVELS))
    again = sum(4 * 2**index for index in _AGAIN) if twice else 0
    return 2 * (2**full_levels - 1) + half + max(again, 2 * lag.reach() if at_once else 0) + 16


def planar(image: jax.Array) -> jax.Array:
    """[H, W, C] as [C, H, W]."""
    return image.transpose(2, 0, 1)
