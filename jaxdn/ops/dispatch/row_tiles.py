"""Pixelwise work by strips of rows, so that what lies between its operations stays in the cache, or of few pixels."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.platform import platform

Arrays = Any
"""A pytree of arrays [H, ...]."""
_BATCHES = 64
"""Into which the pixels of an image are parted where few are needed."""


def by_strips(work: Callable[[Arrays], Arrays], arrays: Arrays, *, pixels: int) -> Arrays:
    """``work(arrays)``, where every row of the result depends on the same row of the arrays alone.

    On CPUs ``work`` gets strips of about ``pixels`` pixels, one after the other: XLA:CPU writes what a gather fetches
    to memory before the next operation reads it. Elsewhere it gets everything at once. The last strip is filled up with
    zeros.
    """
    height, width = jax.tree.leaves(arrays)[0].shape[:2]
    rows = min(height, max(1, pixels // width)) if platform() == "cpu" else height
    if rows == height:
        return work(arrays)
    strips = -(-height // rows)

    def apart(array: jax.Array) -> jax.Array:
        below = [(0, strips * rows - height)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, below).reshape(strips, rows, *array.shape[1:])

    def joined(array: jax.Array) -> jax.Array:
        return array.reshape(strips * rows, *array.shape[2:])[:height]

    return jax.tree.map(joined, lax.map(work, jax.tree.map(apart, arrays)))


def where_needed(work: Callable[[Arrays], Arrays], needed: jax.Array, arrays: Arrays) -> Arrays:
    """``work(arrays)`` of the pixels that are ``needed`` [H, W] alone, 0 elsewhere.

    ``work`` takes and returns arrays [n, ...], pixel by pixel, here batches of the needed pixels of ``arrays``
    [H, W, ...]: they may be everywhere, so that no strip of the image is without one. Its time grows with their number.
    """
    height, width = needed.shape
    pixels = height * width
    batch = -(-pixels // _BATCHES)
    alone = needed.reshape(pixels)
    count, rank = jnp.sum(alone, dtype=jnp.int32), jnp.cumsum(alone, dtype=jnp.int32) - 1
    places = jnp.where(alone, rank, _BATCHES * batch)
    listed = jnp.zeros(_BATCHES * batch, jnp.int32).at[places].set(jnp.arange(pixels, dtype=jnp.int32), mode="drop")
    flat = jax.tree.map(lambda array: jnp.asarray(array).reshape(pixels, *array.shape[2:]), arrays)

    def some(own: jax.Array) -> Arrays:
        return work(jax.tree.map(lambda array: array[own], flat))

    def nothing(own: jax.Array) -> Arrays:
        return jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), jax.eval_shape(some, own))

    def one(number: jax.Array, own: jax.Array) -> Arrays:
        return lax.cond(number * batch < count, some, nothing, own)

    found = lax.map(lambda each: one(*each), (jnp.arange(_BATCHES), listed.reshape(_BATCHES, batch)))

    def placed(array: jax.Array) -> jax.Array:
        back = array.reshape(_BATCHES * batch, *array.shape[2:])[jnp.maximum(rank, 0)]
        mask = alone.reshape(pixels, *[1] * (back.ndim - 1))
        return jnp.where(mask, back, jnp.zeros((), back.dtype)).reshape(height, width, *back.shape[1:])

    return jax.tree.map(placed, found)
