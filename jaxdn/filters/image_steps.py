"""Small steps on images [H, W, ...] that searches for motion share."""

import functools

import jax
import jax.numpy as jnp
from jax import lax


def halve(image: jax.Array) -> jax.Array:
    """Means of 2 x 2 pixels of [H, W, C]; the last row or column of an odd side counts twice."""
    height, width = image.shape[:2]
    image = jnp.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return 0.25 * (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2])


def mean_around(image: jax.Array, radius: int) -> jax.Array:
    """Means of [H, W, ...] over windows of 2 radius + 1 pixels a side; the border is repeated."""
    for axis in (0, 1):
        widths = [(0, 0)] * image.ndim
        widths[axis] = (radius, radius)
        wide, length = jnp.pad(image, widths, mode="edge"), image.shape[axis]
        parts = [lax.slice_in_dim(wide, k, k + length, axis=axis) for k in range(2 * radius + 1)]
        image = functools.reduce(jnp.add, parts) / (2 * radius + 1)
    return image


def differentiate(image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Half the differences of both neighbours of [H, W, C] along x and along y; the border is repeated."""
    slopes = []
    for axis in (1, 0):
        widths = [(0, 0)] * 3
        widths[axis] = (1, 1)
        wide, length = jnp.pad(image, widths, mode="edge"), image.shape[axis]
        after = lax.slice_in_dim(wide, 2, 2 + length, axis=axis)
        slopes.append(0.5 * (after - lax.slice_in_dim(wide, 0, length, axis=axis)))
    return slopes[0], slopes[1]
