"""Arrays of several layouts as planes ``[C, H, W]`` one after another, which filters work on.

XLA:CPU does not vectorise what it transposes, and computes what it fuses into arrays side by side once for each of the
channels: a compiled loop keeps both apart.
"""

import functools
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.scales import downsample

LAYOUTS = ("planes", "pixels", "blocks", "corners", "means")
"""Names of layouts, in the order of their numbers in :mod:`jaxdn.ops.layout.numba_kernels`."""

Channels = tuple[str, jax.Array]
"""A layout and an array: ``"planes"`` [C, H, W], ``"pixels"`` [H, W, C], ``"blocks"`` [H/2, W/2, 4C] made as by
:func:`jaxdn.ops.scales.space_to_depth`; or what is averaged over blocks of 2x2 pixels: ``"corners"`` [H, W, 4C] made
likewise, or ``"means"`` [2H, 2W, C]."""


def join_planes(parts: Sequence[Channels], *, implementation: str | None = None) -> jax.Array:
    """[C, H, W] the channels of all parts, in their order; all parts have to be of one size."""
    layouts, arrays = zip(*parts, strict=True)
    return _join_planes(*arrays, layouts=layouts, implementation=implementation)


@operation(name="join_planes")
def _join_planes(*arrays: jax.Array, layouts: tuple[str, ...]) -> jax.Array:
    """The planes of all arrays, one after the other, each converted from its layout."""
    return jnp.concatenate([_TO_PLANES[layout](array) for layout, array in zip(layouts, arrays, strict=True)])


@numba_call.implements(_join_planes)
def _join_planes_by_numba(*arrays: jax.Array, layouts: tuple[str, ...]) -> jax.Array:
    from jaxdn.ops.layout.numba_kernels import join_rows

    reference = functools.partial(_join_planes, layouts=layouts, implementation="reference")
    shape = jax.eval_shape(reference, *arrays).shape
    return numba_call.call(join_rows, [shape], [arrays], tuple(map(LAYOUTS.index, layouts)), rows=shape[1])[0]


def to_planes(image: jax.Array) -> jax.Array:
    """[H, W, C] as [C, H, W]."""
    return image.transpose(2, 0, 1)


def _depth_to_space(blocks: jax.Array) -> jax.Array:
    height, width, channels = blocks.shape
    parts = blocks.reshape(height, width, channels // 4, 2, 2).transpose(2, 0, 3, 1, 4)
    return parts.reshape(channels // 4, 2 * height, 2 * width)


def _average_corners(blocks: jax.Array) -> jax.Array:
    return jnp.mean(blocks.reshape(*blocks.shape[:2], -1, 4), axis=-1)


_TO_PLANES = {
    "planes": lambda array: array,
    "pixels": to_planes,
    "blocks": _depth_to_space,
    "corners": lambda array: to_planes(_average_corners(array)),
    "means": lambda array: to_planes(downsample(array)),
}


@_join_planes.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    shapes = {
        "planes": (2, 2 * height, 2 * width),
        "pixels": (2 * height, 2 * width, 3),
        "blocks": (height, width, 8),
        "corners": (2 * height, 2 * width, 4),
        "means": (4 * height, 4 * width, 2),
    }
    yield Example(tuple(map(rng.random, shapes.values())), {"layouts": tuple(shapes)})
