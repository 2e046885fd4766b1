"""Medians of whole images and of windows, without sorting: XLA sorts one number at a time on CPUs."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation

_BITS = 31
"""Of a float32 that is not negative."""
_NINE = ((1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3), (5, 8), (4, 7), (3, 6))
_NINE_END = ((1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2))
"""Pairs of places that are put in order one after the other; then the median is at place 4 (Paeth, "Median finding on a
3x3 grid", Graphics Gems, 1990)."""


def median(values: jax.Array, counted: jax.Array | None = None, *, implementation: str | None = None) -> jax.Array:
    """The median of numbers >= 0 in float32, the mean of the two in the middle where their number is even; exact.

    Args:
      values: of any shape, without NaN where they count.
      counted: bool of the same shape, which of them count; None: all. Without any, the median is 0.
      implementation: see :mod:`jaxdn.ops.dispatch.operation`.

    Raises ValueError if the shapes differ.
    """
    counted = jnp.ones(jnp.shape(values), bool) if counted is None else counted
    if jnp.shape(counted) != jnp.shape(values):
        raise ValueError(f"counted: expected the shape {jnp.shape(values)} of values, got {jnp.shape(counted)}.")
    return _median(jnp.ravel(values), jnp.ravel(counted), implementation=implementation)


@operation(name="median")
def _median(values: jax.Array, counted: jax.Array) -> jax.Array:
    """:func:`median` of numbers in a row.

    The bits of such numbers are in their order. From the highest bit on, each is set if no more numbers are below than
    shall be: 31 passes over the image instead of a sort.
    """
    bits = jax.lax.bitcast_convert_type(jnp.asarray(values, jnp.float32) + 0.0, jnp.int32)
    number = jnp.sum(counted, dtype=jnp.int32)

    def set_bit(step: jax.Array, found: jax.Array) -> jax.Array:
        tried = found | (1 << (_BITS - 1 - step)).astype(jnp.int32)
        below = jnp.sum(counted & (bits < tried), dtype=jnp.int32)
        return jnp.where(below <= (number - 1) // 2, tried, found)

    lower = jax.lax.fori_loop(0, _BITS, set_bit, jnp.zeros((), jnp.int32))
    up_to = jnp.sum(counted & (bits <= lower), dtype=jnp.int32)
    following = jnp.min(jnp.where(counted & (bits > lower), bits, jnp.iinfo(jnp.int32).max))
    upper = jnp.where(up_to > number // 2, lower, following)
    low, high = (jax.lax.bitcast_convert_type(one, jnp.float32) for one in (lower, upper))
    return jnp.where(number > 0, jnp.where(low == high, low, 0.5 * low + 0.5 * high), 0.0)


@numba_call.implements(_median)
def _median_by_numba(values: jax.Array, counted: jax.Array) -> jax.Array:
    from jaxdn.ops.numba_medians import find_median

    return numba_call.call(find_median, [(1,)], [values, counted], rows=1)[0][0]


@_median.example
def _median_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for number in (height * width, height * width + 1):
        yield Example((rng.gamma(0.3, 1, number), rng.random(number) < 0.7))


def median_of_nine(images: list[jax.Array]) -> jax.Array:
    """The median of nine images of one shape, pixel by pixel, by 19 comparisons."""
    held = list(images)
    for low, high in (*_NINE, *_NINE_END):
        held[low], held[high] = jnp.minimum(held[low], held[high]), jnp.maximum(held[low], held[high])
    return held[4]


def median_3x3(image: jax.Array) -> jax.Array:
    """The median of the 3x3 pixels around each pixel of an image [H, W], whose border is repeated."""
    height, width = image.shape
    padded = jnp.pad(image, 1, mode="edge")
    return median_of_nine([padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)])
