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
from jaxdn.filters.affinity_levels import LEAST_TRUST, compute_inverse_depth, scale_guide
from jaxdn.methods.combiner.history import Means
from jaxdn.ops.affinity.filter import Guide, affinity_filter

CANDIDATES = ("prior", "correction", "prior mean", "last result")
"""In the order of their weights."""
LEVELS = 2
"""Levels of the filter, taps 1 and 2 pixels apart. What wider ones find has grain of many pixels where it is dark."""
GUIDES = {"albedo": 3, "normal": 3, "light": 3}
"""What likeness is told by, besides learned features and depth, and its channels."""


class FilterParameters(NamedTuple):
    """What a network decides about the filter."""

    features: jax.Array
    """[F, H, W]."""
    trust: jax.Array
    """[H, W] in [0, 1]."""


def make_candidates(
    precisions: Mapping[str, jax.Array],
    means: Means,
    prior: jax.Array,
    last: jax.Array,
    depth: jax.Array | None,
    parameters: FilterParameters,
    statistics: FrameStatistics,
) -> list[jax.Array]:
    """The images [3, H, W] of :data:`CANDIDATES`, linear radiance; H and W are even.

    ``precisions`` [1] of albedo, normal, light, depth and learned features are logarithms of what squares of
    differences are multiplied by. Light is compared as the mean of the prior's images, at the frame's exposure and
    compressed. ``prior`` [3, H, W] is of this frame, ``last`` the image of the frame before, where it is now.
    """
    factors = {name: jnp.exp(0.5 * logarithm) for name, logarithm in precisions.items()}
    inverse_depth = jnp.zeros_like(means.light) if depth is None else compute_inverse_depth(depth, statistics)
    seen = color.compress(statistics.exposure * means.prior)
    features = jnp.concatenate([means.albedo, means.normal, seen, parameters.features])
    guide = scale_guide(Guide(features, inverse_depth, parameters.trust + LEAST_TRUST), factors, 0, GUIDES)
    filtered = jnp.concatenate([means.light, means.prior])
    for index in range(LEVELS):
        filtered = affinity_filter(filtered, guide, step=2**index)
    return [prior, prior + filtered[:3] - filtered[3:], means.prior, last]


def receptive_field() -> int:
    """How far, in pixels, :func:`make_candidates` sees."""
    return affinity_levels.receptive_field(LEVELS)
