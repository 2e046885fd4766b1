"""A filter pyramid: light filtered by affinities at full resolution, at half, and upsampled again along the guides.

Every level is an :mod:`jaxdn.ops.affinity.filter` whose taps lie twice as far apart as those of the level before. How
alike two pixels are is told by albedo, gloss, normal, depth and features that somebody has learned; how far each can be
trusted and how much of each level it takes is parameters for every pixel as well: by a network, in
:mod:`jaxdn.methods.steady.method`.

What all levels together take away where light follows the guides is found by regression, and a share of it is given
back (:mod:`jaxdn.methods.steady.regression`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Frame
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters import affinity_levels
from jaxdn.filters.affinity_levels import LEAST_TRUST, scale_guide
from jaxdn.filters.surface_test import surface_mask
from jaxdn.methods.steady import lighting_change, regression
from jaxdn.methods.steady.accumulation import FilteredLight
from jaxdn.ops.affinity.filter import Guide, affinity_filter
from jaxdn.ops.affinity.joint_upsample import joint_bilateral_upsample
from jaxdn.ops.scales import Channels, join_planes, pad, upsample

LEVELS = 4
"""Levels at half resolution, taps 2, 4, 8 and 16 pixels apart."""
BLOCKS = 4
"""Height and width that the filters work on are multiples of this: blocks of 4x4 pixels are filled."""
_LIKENESS = 0.02
"""Weight of pixels at half resolution at which half of the enlarged image is taken."""
_CHANNELS = {"albedo": 3, "gloss": 1, "normal": 3}
"""What likeness is told by, besides learned features and depth, and its channels."""


class Surfaces(NamedTuple):
    """A frame's guides [H, W, C], padded; 0 is the neutral value."""

    albedo: jax.Array
    """[H, W, 3] what is reflected at all, less 1."""
    gloss: jax.Array
    """[H, W, 1] the specular share of the albedo: metal on a wall as bright as itself reflects other light."""
    normal: jax.Array
    roughness: jax.Array
    depth: jax.Array | None
    hit: jax.Array
    """[H, W] bool, there is a surface."""

    def guides(self, layout: str = "pixels") -> list[Channels]:
        """Albedo, gloss and normal, parts of planes (:mod:`jaxdn.ops.scales`)."""
        return [(layout, self.albedo), (layout, self.gloss), (layout, self.normal)]


class PredictedParameters(NamedTuple):
    """What is parameters about the pixels of a frame."""

    features: jax.Array
    """[H/2, W/2, 4F] of all four pixels of a block (:func:`jaxdn.ops.scales.space_to_depth`)."""
    trust: jax.Array
    """[H, W] in [0, 1]."""
    coarse_weight: jax.Array
    """[H, W] in [0, 1], the weight of the image of the levels at half resolution."""
    half_features: jax.Array
    """[H/2, W/2, G]."""
    half_trust: jax.Array
    """[H/2, W/2] in [0, 1]."""
    level_weights: list[jax.Array]
    """Level at half resolution -> its weight [H/2, W/2] in [0, 1]."""
    regression_weight: jax.Array | None
    """[H/2, W/2] in [0, 1], how much of the regression's correction is added; None: no regression."""


def surfaces_of(frame: Frame) -> Surfaces:
    """The guides of a frame, its size padded to a multiple of :data:`BLOCKS`."""
    nothing = jnp.zeros_like(frame.radiance)
    height, width = nothing.shape[:2]
    reflectance = frame.albedo if frame.reflectance is None else frame.reflectance
    both = frame.albedo is not None and frame.reflectance is not None
    gloss = jnp.mean(frame.reflectance - frame.albedo, axis=-1, keepdims=True) if both else nothing[..., :1]
    hit = surface_mask(frame.depth, frame.ids)
    hit = jnp.ones((height, width), bool) if hit is None else hit
    return Surfaces(
        pad(nothing if reflectance is None else reflectance - 1.0, BLOCKS),
        pad(gloss, BLOCKS),
        pad(nothing if frame.normal is None else frame.normal, BLOCKS),
        pad(nothing[..., :1] if frame.roughness is None else frame.roughness - 1.0, BLOCKS),
        None if frame.depth is None else pad(frame.depth, BLOCKS),
        # What is padded is no surface: noise of the last row would count as often as it is repeated.
        jnp.pad(hit, ((0, -height % BLOCKS), (0, -width % BLOCKS))),
    )


def compute_inverse_depth(surfaces: Surfaces, statistics: FrameStatistics) -> jax.Array:
    """[3, H, W] as :func:`jaxdn.filters.affinity_levels.compute_inverse_depth`; 0 without depth."""
    if surfaces.depth is None:
        return jnp.zeros((3, *surfaces.hit.shape), surfaces.normal.dtype)
    return affinity_levels.compute_inverse_depth(surfaces.depth, statistics)


def filter_light(
    precisions: Mapping[str, Any],
    mean: jax.Array,
    residual: jax.Array | None,
    texture: jax.Array | None,
    surfaces: Surfaces,
    inverse_depth: jax.Array,
    parameters: PredictedParameters,
    full_levels: int,
    floor: jax.Array,
) -> FilteredLight:
    """The light [3, H, W] ``mean`` after the levels at full resolution, and after all with a change, and the change.

    ``residual`` [3, H/2, W/2] is how much more the newest frame shows than the mean; None leaves a change out.
    ``precisions`` are logarithms, one for full resolution and one for each level at half, of what the squares of
    differences in ``albedo``, ``gloss``, ``normal``, ``depth`` and ``learned`` features are multiplied by; and, as
    ``regression``, the scales of :func:`jaxdn.methods.steady.regression.regress_residual`, whose ``floor`` is that
    here. The image of the levels at half resolution is upsampled along the guides, and takes a share of every pixel.
    The ``texture`` [H, W, 3] that a division of the light left is filtered likewise, and restored
    (:func:`jaxdn.brdf.restore`).
    """
    factors = {name: jnp.exp(0.5 * logarithm) for name, logarithm in precisions.items() if name != "regression"}
    at_full = _guide(
        [*surfaces.guides(), ("blocks", parameters.features)], inverse_depth, parameters.trust, surfaces.hit
    )
    at_full = scale_guide(at_full, factors, 0, _CHANNELS)
    parts = [("planes", mean)]
    if parameters.regression_weight is not None:
        # Guides that light may follow go through the same filters as light, and so does texture.
        parts.append(("planes", regression.regressors_of(surfaces.normal, surfaces.gloss, inverse_depth[0])))
    if texture is not None:
        parts.append(("pixels", texture))
    before = fine = join_planes(parts)
    for index in range(full_levels):
        fine = affinity_filter(fine, at_full, step=2**index)
    found, alike = _filter_at_half(fine, residual, surfaces, inverse_depth, parameters, factors, at_full)
    image = fine + (parameters.coarse_weight * alike)[None] * (found[: fine.shape[0]] - fine)
    change = None if residual is None else alike[None] * found[fine.shape[0] :]
    light = image[:3]
    if parameters.regression_weight is not None:
        correction = regression.regress_residual(precisions["regression"], before, image, surfaces.hit, floor)
        light = light + upsample(parameters.regression_weight[..., None])[None, ..., 0] * correction
    now = jnp.maximum(light if change is None else light + change, 0.0)
    if texture is None:
        return FilteredLight(fine[:3], now, change)
    texture_planes = before[-3:]
    fine_light = brdf.restore(fine[:3], texture_planes, fine[-3:])
    return FilteredLight(fine_light, brdf.restore(now, texture_planes, image[-3:]), change)


def _filter_at_half(
    fine: jax.Array,
    residual: jax.Array | None,
    surfaces: Surfaces,
    inverse_depth: jax.Array,
    parameters: PredictedParameters,
    factors: Mapping[str, jax.Array],
    at_full: Guide,
) -> tuple[jax.Array, jax.Array]:
    """Planes [C, H, W] after the levels at half resolution, enlarged again, and [H, W] how alike what they show is.

    They are followed by the three of the change, if there may be one.
    """
    # Of every other pixel, with the slopes of pixels twice as large.
    inverse_depth_half = inverse_depth[:, ::2, ::2] * jnp.asarray([1.0, 2.0, 2.0])[:, None, None]
    hit, own = _any_of_four(surfaces.hit), parameters.half_features
    halved = join_planes(surfaces.guides("means"))
    at_half = _guide([("planes", halved), ("pixels", own)], inverse_depth_half, parameters.half_trust, hit)
    found = _filter_half(_downsample(fine, surfaces.hit), _at_levels(at_half, factors), parameters.level_weights)
    if residual is not None:
        # By surfaces alone: what is learned knows a pixel's noise, and lets a bright sample count for less.
        plain = _guide([("planes", halved)], inverse_depth_half, jnp.ones_like(parameters.half_trust), hit)
        change = _filter_change(residual, _at_levels(plain, factors), found[:3], hit)
        found = jnp.concatenate([found, change])
    features = [("planes", halved), ("corners", parameters.features)]
    there = _guide(features, inverse_depth[:, ::2, ::2], parameters.half_trust, hit)
    enlarged, weight = joint_bilateral_upsample(found, there, at_full)
    return enlarged, weight / (weight + _LIKENESS)


def _any_of_four(hit: jax.Array) -> jax.Array:
    """[H/2, W/2] bool, whether any of four pixels is set."""
    return hit[::2, ::2] | hit[::2, 1::2] | hit[1::2, ::2] | hit[1::2, 1::2]


def _guide(features: Sequence[Channels], inverse_depth: jax.Array, trust: jax.Array, hit: jax.Array) -> Guide:
    """Surfaces and what else is learned, not yet scaled; what is no surface gives nothing."""
    return Guide(join_planes(features), inverse_depth, (trust + LEAST_TRUST) * hit)


def _at_levels(guide: Guide, factors: Mapping[str, jax.Array]) -> list[Guide]:
    """The guide of every level at half resolution."""
    return [scale_guide(guide, factors, 1 + index, _CHANNELS) for index in range(LEVELS)]


def _downsample(planes: jax.Array, hit: jax.Array) -> jax.Array:
    """[C, H/2, W/2] the means of those of four pixels that have a surface; 0 without any."""

    def four(planes: jax.Array) -> jax.Array:
        corners = [planes[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]
        return corners[0] + corners[1] + corners[2] + corners[3]

    return four(jnp.where(hit[None], planes, 0.0)) / jnp.maximum(four(hit.astype(planes.dtype)), 1.0)[None]


def _filter_half(planes: jax.Array, guides: list[Guide], level_weights: list[jax.Array]) -> jax.Array:
    """Light, and what else goes the same way, [C, H/2, W/2] after the levels at half resolution."""
    for index, guide in enumerate(guides):
        planes = planes + level_weights[index][None] * (affinity_filter(planes, guide, step=2**index) - planes)
    return planes


def _filter_change(residual: jax.Array, guides: list[Guide], light: jax.Array, hit: jax.Array) -> jax.Array:
    """The change of light [3, H/2, W/2], told from what the mean lacks of the newest frame.

    Every level is taken whole: a single frame needs all of them, where a mean of many needs few.
    """
    planes = lighting_change.split_checkerboard(residual)
    for index, guide in enumerate(guides):
        planes = affinity_filter(planes, guide, step=2**index)
    return lighting_change.estimate_change(planes, light, hit)


def receptive_field(full_levels: int, *, with_regression: bool, with_lighting_change: bool) -> int:
    """How far, in pixels, :func:`filter_light` sees."""
    more = regression.receptive_field() if with_regression else 0
    if with_lighting_change:
        more = max(more, 2 * lighting_change.receptive_field())
    return affinity_levels.receptive_field(full_levels, LEVELS) + more
