"""Arrays of several layouts as planes ``[C, H, W]`` one after another, which filters work on.

XLA:CPU does not vectorise what it transposes, and computes what it fuses into arrays side by side once for each of the
channels: a compiled loop keeps both apart.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.inference_path import alone
from jaxdn.ops.scales import downsample

LAYOUTS = ("planes", "pixels", "blocks", "corners", "means")
"""Names of layouts, in the order of their numbers in :mod:`jaxdn.ops.layout.numba_kernels`."""

Part = tuple[str, jax.Array]
"""A layout and an array: ``"planes"`` [C, H, W], ``"pixels"`` [H, W, C], ``"blocks"`` [H/2, W/2, 4C] made as by
:func:`jaxdn.ops.scales.fold`; or what is averaged over blocks of 2x2 pixels: ``"corners"`` [H, W, 4C] made likewise, or
``"means"`` [2H, 2W, C]."""


def planes_of(parts: Sequence[Part]) -> jax.Array:
    """[C, H, W] the channels of all parts, in their order; all parts have to be of one size."""
    layouts, arrays = zip(*parts, strict=True)

    def plain(*arrays: jax.Array) -> jax.Array:
        return jnp.concatenate([_LAYOUTS[layout](array) for layout, array in zip(layouts, arrays, strict=True)])

    def compiled(*arrays: jax.Array) -> jax.Array:
        from jaxdn.ops.layout.numba_kernels import planes

        shape = jax.eval_shape(plain, *arrays).shape
        return numba_call.call(planes, [shape], [arrays], tuple(map(LAYOUTS.index, layouts)), rows=shape[1])[0]

    if numba_call.available() and all(array.dtype == jnp.float32 for array in arrays):
        return alone(plain, compiled)(*arrays)
    return plain(*arrays)


def planar(image: jax.Array) -> jax.Array:
    """[H, W, C] as [C, H, W]."""
    return image.transpose(2, 0, 1)


def _unfolded(blocks: jax.Array) -> jax.Array:
    height, width, channels = blocks.shape
    parts = blocks.reshape(height, width, channels // 4, 2, 2).transpose(2, 0, 3, 1, 4)
    return parts.reshape(channels // 4, 2 * height, 2 * width)


def _mean_of_corners(blocks: jax.Array) -> jax.Array:
    return jnp.mean(blocks.reshape(*blocks.shape[:2], -1, 4), axis=-1)


_LAYOUTS = {
    "planes": lambda array: array,
    "pixels": planar,
    "blocks": _unfolded,
    "corners": lambda array: planar(_mean_of_corners(array)),
    "means": lambda array: planar(downsample(array)),
}
