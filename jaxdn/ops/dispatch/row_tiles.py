"""Pixelwise work by row tiles, so that what lies between its operations stays in the cache, or of few pixels."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.ops.dispatch.operation import platform

Arrays = Any
"""A pytree of arrays [H, ...]."""
_BATCHES = 64
"""Into which the pixels of an image are parted where few are needed."""


def rows_per_tile(height: int, width: int, *, pixels: int, least: int = 1) -> int:
    """Rows of a tile: on CPUs as many as have about ``pixels`` pixels, at least ``least``; elsewhere all."""
    return height if platform() != "cpu" else min(height, max(least, pixels // width))


def map_row_tiles(work: Callable[[Arrays], Arrays], arrays: Arrays, *, pixels: int) -> Arrays:
    """``work(arrays)``, where every row of the result depends on the same row of the arrays alone.

    On CPUs ``work`` gets tiles of about ``pixels`` pixels, one after the other: XLA:CPU writes what a gather fetches
    to memory before the next operation reads it. Elsewhere it gets everything at once. The last tile is filled up with
    zeros.
    """
    height, width = jax.tree.leaves(arrays)[0].shape[:2]
    rows = rows_per_tile(height, width, pixels=pixels)
    if rows == height:
        return work(arrays)
    tiles = -(-height // rows)

    def split(array: jax.Array) -> jax.Array:
        below = [(0, tiles * rows - height)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, below).reshape(tiles, rows, *array.shape[1:])

    def join(array: jax.Array) -> jax.Array:
        return array.reshape(tiles * rows, *array.shape[2:])[:height]

    return jax.tree.map(join, lax.map(work, jax.tree.map(split, arrays)))


def evaluate_sparsely(work: Callable[[Arrays], Arrays], needed: jax.Array, arrays: Arrays) -> Arrays:
    """``work(arrays)`` of the pixels that are ``needed`` [H, W] alone, 0 elsewhere.

    ``work`` takes and returns arrays [n, ...], pixel by pixel, here batches of the needed pixels of ``arrays``
    [H, W, ...]: they may be everywhere, so that no tile of the image is without one. Its time grows with their number.
    """
    height, width = needed.shape
    pixels = height * width
    batch = -(-pixels // _BATCHES)
    mask = needed.reshape(pixels)
    count, rank = jnp.sum(mask, dtype=jnp.int32), jnp.cumsum(mask, dtype=jnp.int32) - 1
    places = jnp.where(mask, rank, _BATCHES * batch)
    listed = jnp.zeros(_BATCHES * batch, jnp.int32).at[places].set(jnp.arange(pixels, dtype=jnp.int32), mode="drop")
    flat = jax.tree.map(lambda array: jnp.asarray(array).reshape(pixels, *array.shape[2:]), arrays)

    def some(own: jax.Array) -> Arrays:
        return work(jax.tree.map(lambda array: array[own], flat))

    def nothing(own: jax.Array) -> Arrays:
        return jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), jax.eval_shape(some, own))

    def run_batch(number: jax.Array, own: jax.Array) -> Arrays:
        return lax.cond(number * batch < count, some, nothing, own)

    found = lax.map(lambda batch: run_batch(*batch), (jnp.arange(_BATCHES), listed.reshape(_BATCHES, batch)))

    def place(array: jax.Array) -> jax.Array:
        back = array.reshape(_BATCHES * batch, *array.shape[2:])[jnp.maximum(rank, 0)]
        taken = mask.reshape(pixels, *[1] * (back.ndim - 1))
        return jnp.where(taken, back, jnp.zeros((), back.dtype)).reshape(height, width, *back.shape[1:])

    return jax.tree.map(place, found)
