"""What levels of affinity filters (:mod:`jaxdn.ops.affinity.filter`) share, whatever tells likeness in them.

Taps of a level lie twice as far apart as those of the level before: 1, 2 ... pixels at full resolution, and as many of
the larger pixels at half.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from jaxdn.core.frame import FAR
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.surface_test import depth_slopes
from jaxdn.ops.affinity.filter import Guide

LEAST_TRUST = 1e-3
"""So that a pixel is filtered even where none is trusted."""


def compute_inverse_depth(depth: jax.Array, statistics: FrameStatistics) -> jax.Array:
    """[3, H, W] inverse depth [H, W, 1] relative to its mean, which is affine on planes, and its slopes a pixel along x
    and y; 0 without a surface."""
    known = (depth > 0) & (depth < FAR)
    inverse = jnp.where(known, 1.0 / jnp.where(known, depth, 1.0), 0.0) / statistics.mean_inverse_depth
    return jnp.stack([inverse[..., 0], *depth_slopes(inverse, None)])


def scale_guide(guide: Guide, factors: Mapping[str, jax.Array], index: int, channels: Mapping[str, int]) -> Guide:
    """The guide with the factors of one level.

    Args:
      guide: its features [C, H, W] are ``channels``, in their order, and then learned ones.
      factors: name -> [levels], of ``channels``, ``learned`` and ``depth``: what differences are multiplied by.
      index: of the level.
      channels: name -> number of channels.
    """
    count = {**channels, "learned": guide.features.shape[0] - sum(channels.values()), "depth": 1}
    return guide._replace(scales=jnp.concatenate([jnp.full(n, factors[name][index]) for name, n in count.items()]))


def receptive_field(full_levels: int, half_levels: int = 0) -> int:
    """How far, in pixels, so many levels at full and at half resolution see; 16 for blocks, slopes and enlarging."""
    return 2 * (2**full_levels - 1) + sum(4 * 2**index for index in range(half_levels)) + 16
