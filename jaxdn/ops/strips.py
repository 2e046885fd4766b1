"""Pixelwise work by strips of rows, so that what lies between its first and its last operation stays in the cache."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

Arrays = Any
"""A pytree of arrays [H, ...]."""


def by_strips(work: Callable[[Arrays], Arrays], arrays: Arrays, *, pixels: int) -> Arrays:
    """``work(arrays)``, where every row of the result depends on the same row of the arrays alone.

    On CPUs ``work`` gets strips of about ``pixels`` pixels, one after the other: XLA:CPU writes what a gather fetches
    to memory before the next operation reads it. Elsewhere it gets everything at once. The last strip is filled up with
    zeros.
    """
    height, width = jax.tree.leaves(arrays)[0].shape[:2]
    rows = min(height, max(1, pixels // width)) if jax.default_backend() == "cpu" else height
    if rows == height:
        return work(arrays)
    strips = -(-height // rows)

    def apart(array: jax.Array) -> jax.Array:
        below = [(0, strips * rows - height)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, below).reshape(strips, rows, *array.shape[1:])

    def joined(array: jax.Array) -> jax.Array:
        return array.reshape(strips * rows, *array.shape[2:])[:height]

    return jax.tree.map(joined, lax.map(work, jax.tree.map(apart, arrays)))
