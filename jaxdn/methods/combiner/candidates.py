"""The images that the result is mixed of: the prior, what corrects it, the mean of priors and the last result.

A *correction* adds to the prior what a filter by affinities finds between the mean of noisy light and that of the
prior's images: its error, as far as it lasts, without blur of what the prior shows (in the manner of Back et al. 2020,
"Deep Combiner for Independent and Correlated Pixel Estimates").
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters import affinity_levels
from jaxdn.filters.affinity_levels import (
    LEAST_TRUST,
    compute_inverse_depth,
    halve_inverse_depth,
    scale_guide,
    weigh_enlarged,
)
from jaxdn.methods.combiner.history import Means
from jaxdn.ops.affinity.filter import Guide, affinity_filter
from jaxdn.ops.affinity.joint_upsample import joint_bilateral_upsample
from jaxdn.ops.scales import halve_planes, join_planes

CANDIDATES = (
    "prior",
    "fine correction",
    "coarse correction",
    "prior mean",
    "last result",
)
"""In the order of their weights."""
FULL_LEVELS, LEVELS = 2, 4
"""Levels of the filter at full resolution, taps 1 and 2 pixels apart, and at half, 2, 4, 8 and 16."""
GUIDES = {"albedo": 3, "normal": 3, "light": 3}
"""What likeness is told by, besides learned features and depth, and its channels."""


class FilterParameters(NamedTuple):
    """What a network decides about the filter."""

    features: jax.Array
    """[H/2, W/2, 4F] of all four pixels of a block (:func:`jaxdn.ops.scales.space_to_depth`)."""
    trust: jax.Array
    """[H, W] in [0, 1]."""
    half_features: jax.Array
    """[H/2, W/2, G]."""
    half_trust: jax.Array
    """[H/2, W/2] in [0, 1]."""
    level_weights: jax.Array
    """[LEVELS, H/2, W/2] in [0, 1], how much of each level at half resolution is taken."""


def make_candidates(
    precisions: Mapping[str, jax.Array],
    means: Means,
    prior: jax.Array,
    last: jax.Array,
    depth: jax.Array | None,
    parameters: FilterParameters,
    statistics: FrameStatistics,
) -> list[jax.Array]:
    """The images [3, H, W] of :data:`CANDIDATES`, linear radiance; H and W are multiples of 4.

    ``precisions`` [1 + LEVELS] of albedo, normal, light, depth and learned features are logarithms, one for full
    resolution and one for each level at half, of what squares of differences are multiplied by. Light is compared as
    the mean of the prior's images, at the frame's exposure and compressed. ``prior`` [3, H, W] is of this frame,
    ``last`` the image of the frame before, where it is now.
    """
    factors = {name: jnp.exp(0.5 * logarithm) for name, logarithm in precisions.items()}
    inverse_depth = jnp.zeros_like(means.light) if depth is None else compute_inverse_depth(depth, statistics)
    seen = color.compress(statistics.exposure * means.prior)
    surfaces = jnp.concatenate([means.albedo, means.normal, seen])
    fine = jnp.concatenate([means.light, means.prior])
    features = join_planes([("planes", surfaces), ("blocks", parameters.features)])
    at_full = scale_guide(Guide(features, inverse_depth, parameters.trust + LEAST_TRUST), factors, 0, GUIDES)
    for index in range(FULL_LEVELS):
        fine = affinity_filter(fine, at_full, step=2**index)
    coarse = _filter_at_half(fine, surfaces, inverse_depth, at_full, parameters, factors)
    corrected = [prior + filtered[:3] - filtered[3:] for filtered in (fine, coarse)]
    return [prior, *corrected, means.prior, last]


def _filter_at_half(
    fine: jax.Array,
    surfaces: jax.Array,
    inverse_depth: jax.Array,
    at_full: Guide,
    parameters: FilterParameters,
    factors: Mapping[str, jax.Array],
) -> jax.Array:
    """Planes after the levels at half resolution, enlarged along the guides; where none is alike, as they were."""
    trust = parameters.half_trust + LEAST_TRUST
    inverse_depth_half = halve_inverse_depth(inverse_depth)
    halved = halve_planes(surfaces)
    features = join_planes([("planes", halved), ("pixels", parameters.half_features)])
    at_half, planes = Guide(features, inverse_depth_half, trust), halve_planes(fine)
    for index in range(LEVELS):
        filtered = affinity_filter(planes, scale_guide(at_half, factors, 1 + index, GUIDES), step=2**index)
        planes = planes + parameters.level_weights[index][None] * (filtered - planes)
    there = join_planes([("planes", halved), ("corners", parameters.features)])
    enlarged, weight = joint_bilateral_upsample(planes, Guide(there, inverse_depth[:, ::2, ::2], trust), at_full)
    return fine + weigh_enlarged(weight)[None] * (enlarged - fine)


def receptive_field() -> int:
    """How far, in pixels, :func:`make_candidates` sees."""
    return affinity_levels.receptive_field(FULL_LEVELS, LEVELS)
