"""What is seen around each pixel, and a history clipped to it.

Brian Karis, "High Quality Temporal Supersampling", 2014; the box of mean and deviation is Marco Salvi's, "An Excursion
in Temporal Supersampling", 2016. Images are [H, W, 3]; neighbours beyond the border are the nearest pixel's.
"""

from collections.abc import Iterator
from functools import reduce
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

Box = Literal["variance", "minmax", "rounded"]
"""How the neighbourhood limits the history, see :func:`box_around`."""
_PLUS = (0, 2, 4, 5, 7)
"""Of :func:`neighbours`, the pixel itself and the four that share a side with it."""


def to_ycocg(image: jax.Array, *, axis: int = -1) -> jax.Array:
    """RGB to luma and two differences: Y = (R + 2G + B) / 4, Co = (R - B) / 2, Cg = (2G - R - B) / 4.

    ``axis`` is that of the channels.
    """
    red, green, blue = jnp.moveaxis(image, axis, 0)
    return jnp.stack([(red + 2 * green + blue) / 4, (red - blue) / 2, (2 * green - red - blue) / 4], axis=axis)


def from_ycocg(image: jax.Array, *, axis: int = -1) -> jax.Array:
    """The inverse of :func:`to_ycocg`."""
    luma, orange, green = jnp.moveaxis(image, axis, 0)
    rest = luma - green
    return jnp.stack([rest + orange, luma + green, rest - orange], axis=axis)


def neighbours(image: jax.Array) -> Iterator[jax.Array]:
    """The 3x3 neighbourhood of every pixel, the pixel itself first, as nine images."""
    height, width = image.shape[:2]
    wide = jnp.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    for dy, dx in sorted(np.ndindex(3, 3), key=lambda at: at != (1, 1)):
        yield wide[dy : dy + height, dx : dx + width]


def mean_around(image: jax.Array) -> jax.Array:
    """The mean of the 3x3 neighbourhood."""
    return sum(neighbours(image), jnp.zeros((), image.dtype)) / 9


def extremes_around(image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The smallest and the largest value of each channel in the 3x3 neighbourhood."""
    return reduce(jnp.minimum, neighbours(image)), reduce(jnp.maximum, neighbours(image))


def box_around(image: jax.Array, box: Box, gamma: float) -> tuple[jax.Array, jax.Array]:
    """Centre and half size [H, W, 3] of the box of colours in the 3x3 neighbourhood.

    ``"variance"``: mean and ``gamma`` standard deviations; ``"minmax"``: from the smallest to the largest value;
    ``"rounded"``: the mean of that box and of the one of the pixel and the four beside it (Karis 2014).
    """
    if box != "variance":
        low, high = extremes_around(image)
        if box == "rounded":
            plus = [near for index, near in enumerate(neighbours(image)) if index in _PLUS]
            low = (low + reduce(jnp.minimum, plus)) / 2
            high = (high + reduce(jnp.maximum, plus)) / 2
        return (low + high) / 2, (high - low) / 2
    mean = mean_around(image)
    # Differences are squared, not values: the variance of bright pixels does not cancel.
    variance = sum(((each - mean) ** 2 for each in neighbours(image)), jnp.zeros((), image.dtype)) / 9
    some = variance > 0
    return mean, gamma * jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1.0)), 0.0)


def clip_to_box(color: jax.Array, center: jax.Array, size: jax.Array) -> jax.Array:
    """``color`` moved towards the centre until it lies in the box: ``c + v / max(1, max_k |v_k| / size_k)``.

    All in YCoCg. A size below a thousandth of the centre's luma counts as that much: where the neighbourhood has only
    one hue, rounding would decide how far a colour lies outside.
    """
    offset = color - center
    smallest = 1e-3 * jnp.abs(center[..., :1]) + 1e-6
    excess = jnp.max(jnp.abs(offset) / jnp.maximum(size, smallest), axis=-1, keepdims=True)
    return center + offset / jnp.maximum(excess, 1.0)


def nearest_motion(motion: jax.Array, depth: jax.Array) -> jax.Array:
    """Each pixel takes over the motion [H, W, 2] of the pixel in its 3x3 neighbourhood with the smallest depth.

    The edge of a thing in front then moves with it (Karis 2014). Of equal depths the pixel's own motion counts.
    """

    def nearer(one: tuple[jax.Array, jax.Array], two: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        closer = two[0] < one[0]
        return jnp.where(closer, two[0], one[0]), jnp.where(closer, two[1], one[1])

    pairs = zip(neighbours(depth), neighbours(motion), strict=True)
    return reduce(nearer, pairs)[1]
