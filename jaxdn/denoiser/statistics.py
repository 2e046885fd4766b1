"""Frame statistics: what of a whole frame decides about each of its pixels. Brightness, depths, height.

A frame that is denoised in tiles (:mod:`jaxdn.denoiser.tiles`) must be measured as a whole first. Everything here is a
sum over pixels, or over blocks of 16x16 of them, so that the sums of tiles that lie side by side add up to those of the
frame.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.core.frame import FAR, Array, Frame
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation


class FrameStatistics(NamedTuple):
    """Sums over a frame, all scalars."""

    brightness: jax.Array
    """[2] of :func:`jaxdn.color.brightness`."""
    depth: jax.Array
    """[3] the sums of log z and of 1 / z over surfaces, and their number of pixels."""
    reflectance_differs: jax.Array
    """Number of pixels whose reflectance is not their albedo."""
    height: jax.Array
    """Rows of the frame; no sum."""

    @property
    def exposure(self) -> jax.Array:
        """As :func:`jaxdn.color.exposure`."""
        return color.exposure_of(self.brightness)

    @property
    def mean_depth(self) -> jax.Array:
        """The geometric mean of depth over surfaces; 1 without any."""
        return geometric_mean_depth(self.depth)

    @property
    def mean_inverse_depth(self) -> jax.Array:
        """The mean of inverse depth over surfaces; 1 without any."""
        mean = self.depth[1] / jnp.maximum(self.depth[2], 1.0)
        return jnp.where(mean > 0, mean, 1.0)


def measure_frame(light: jax.Array, depth: Array, frame: Frame) -> FrameStatistics:
    """The sums of a frame.

    Args:
      light: [H, W, 3] the light whose brightness counts.
      depth: [H, W, 1], or None.
      frame: for reflectance and albedo, and its height.
    """
    return FrameStatistics(
        color.brightness(light),
        jnp.zeros(3, light.dtype) if depth is None else sum_depths(depth),
        jnp.asarray(count_reflectance_differs(frame), light.dtype),
        jnp.asarray(frame.radiance.shape[0], light.dtype),
    )


def count_reflectance_differs(frame: Frame) -> jax.Array | float:
    """:attr:`FrameStatistics.reflectance_differs` of a frame; 0 unless it has both buffers."""
    if frame.reflectance is None or frame.albedo is None:
        return 0.0
    return jnp.sum(jnp.any(frame.reflectance != frame.albedo, axis=-1), dtype=frame.radiance.dtype)


def geometric_mean_depth(depth: jax.Array) -> jax.Array:
    """The geometric mean of depth over surfaces, from :attr:`FrameStatistics.depth`; 1 without any."""
    return jnp.exp(depth[0] / jnp.maximum(depth[2], 1.0))


@operation
def sum_depths(depth: jax.Array) -> jax.Array:
    """:attr:`FrameStatistics.depth` of a depth [H, W, 1]; no surface is at 0 or at ``FAR``."""
    known = (depth > 0) & (depth < FAR)
    there = jnp.where(known, depth, 1.0)
    logarithms, inverses = jnp.log(there), jnp.where(known, 1.0 / there, 0.0)
    return jnp.stack([jnp.sum(logarithms), jnp.sum(inverses), jnp.sum(known, dtype=depth.dtype)])


@numba_call.implements(sum_depths)
def _sum_depths_by_numba(depth: jax.Array) -> jax.Array:
    from jaxdn.denoiser.numba_statistics import depths

    return numba_call.call(depths, [(depth.shape[0], 3)], [depth], np.float32(FAR), rows=depth.shape[0])[0].sum(axis=0)


@sum_depths.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    depth = 10.0 ** rng.uniform(-3, 3, (height, width, 1))
    yield Example((np.where(rng.random(depth.shape) > 0.1, depth, rng.choice([0.0, -1.0, FAR], depth.shape)),))
