"""Clamps against neighbours: a slow history to the range of a fast one, and fireflies to what is around them.

All arrays are planar, ``[C, H, W]``.
"""

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.filters.neighbourhood import from_ycocg, to_ycocg

_NO_SPREAD = 1e-10
"""Least variance of a neighbourhood: the square root has no slope at 0."""
DARK = 1e-12
"""Nothing is told from darkness below it: the slope of a quotient is finite there in single precision."""
_ROUNDING = 1e-4
"""Relative difference of two means in single precision that says nothing."""


def measure_neighbourhood(
    planes: jax.Array, hit: jax.Array | None, *, radius: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean and standard deviation of every plane over a square of ``2 radius + 1`` pixels, and their number [H, W].

    Only pixels of the image with a surface (``hit`` [H, W] bool; None: all) count; all are 0 where there is none.
    """
    inside = (jnp.ones(planes.shape[1:], bool) if hit is None else hit)[None].astype(planes.dtype)
    sums = jnp.concatenate([planes * inside, planes * planes * inside, inside])
    for axis in (1, 2):
        size = planes.shape[axis]
        wide = jnp.pad(sums, [(radius, radius) if each == axis else (0, 0) for each in range(3)])
        rows = [jax.lax.slice_in_dim(wide, start, start + size, axis=axis) for start in range(2 * radius + 1)]
        sums = functools.reduce(jnp.add, rows)
    mean, square = jnp.split(sums[:-1] / jnp.maximum(sums[-1:], 1.0), 2)
    return mean, jnp.sqrt(jnp.maximum(square - mean * mean, _NO_SPREAD)), sums[-1]


def detect_lag(slow: jax.Array, fast: jax.Array, hit: jax.Array | None, *, sigma: float, radius: int) -> jax.Array:
    """[H, W] in [0, 1]: how surely the slow history shows another brightness than the fast one around a pixel.

    ``d / (sigma e) - 1``, clipped, for the difference d of their means over a square of ``2 radius + 1`` pixels and the
    standard error ``e = s / sqrt(n)`` of the fast one, with its deviation s over the n pixels that have a surface.
    Noise alone makes d about as large as e.

    Args:
      slow: luminance of the slow history [H, W].
      fast: of the fast one.
      hit: [H, W] bool, a surface is seen; None: everywhere.
      sigma: standard errors that are not counted as a difference.
      radius: of the square.
    """
    means, deviation, number = measure_neighbourhood(jnp.stack([slow, fast]), hit, radius=radius)
    difference = jnp.abs(means[0] - means[1])
    # The mean's own rounding is no difference either.
    noise = sigma * deviation[1] / jnp.sqrt(jnp.maximum(number, 1.0)) + _ROUNDING * means[1]
    some = noise > 0
    return jnp.where(some, jnp.clip(difference / jnp.where(some, noise, 1.0) - 1.0, 0.0, 1.0), 0.0)


def clamp_to_fast(
    slow: jax.Array, fast: jax.Array, hit: jax.Array | None, *, sigma: float, radius: int = 2
) -> jax.Array:
    """The slow history [3, H, W], each pixel clamped to what the fast one shows around it.

    In YCoCg, to the mean of the fast history's neighbourhood plus or minus ``sigma`` standard deviations, a range that
    is extended to contain the fast history's own pixel (the colour boxes of temporal antialiasing: Karis 2014; variance
    clipping: Salvi 2016).
    """
    around = to_ycocg(fast, axis=0)
    mean, deviation, _ = measure_neighbourhood(around, hit, radius=radius)
    low = jnp.minimum(mean - sigma * deviation, around)
    high = jnp.maximum(mean + sigma * deviation, around)
    return jnp.maximum(from_ycocg(jnp.clip(to_ycocg(slow, axis=0), low, high), axis=0), 0.0)


def clamp_fireflies(color: jax.Array, same: jax.Array | None) -> jax.Array:
    """Each channel of ``color`` [3, H, W] clamped to the range of the eight neighbours of the same surface.

    ``same`` [C, H, W]: planes that are equal on one surface (ids, whether there is one); None: all count. A pixel
    without such a neighbour stays as it is. Rank-conditioned, thus without a threshold (Hardie and Boncelet 1993).
    """
    low, high = jnp.full_like(color, jnp.inf), jnp.full_like(color, -jnp.inf)
    inside = jnp.ones((1, *color.shape[1:]), color.dtype)
    guides = inside if same is None else jnp.concatenate([inside, same.astype(color.dtype)])
    for other, near in zip(_neighbours(color), _neighbours(guides), strict=True):
        alike = jnp.all(near == guides, axis=0)
        low = jnp.where(alike[None], jnp.minimum(low, other), low)
        high = jnp.where(alike[None], jnp.maximum(high, other), high)
    return jnp.where(low <= high, jnp.clip(color, low, high), color)


def firefly_attenuation(brightness: jax.Array, hit: jax.Array, sure: jax.Array) -> jax.Array:
    """[H, W] in [0, 1], the share of its light that a pixel keeps: none is brighter than all of its eight neighbours.

    What is left of a firefly after filtering is one pixel that had nobody to share it with.

    Args:
      brightness: [H, W] >= 0.
      hit: [H, W] bool, a surface is seen; other neighbours do not count, and a pixel without any keeps all.
      sure: [H, W] the share that each pixel keeps in any case: a lamp may be as small as a pixel.
    """
    seen = jnp.where(hit, brightness, -1.0)[None]
    limit = functools.reduce(jnp.maximum, _neighbours(seen, beyond=-1.0))[0]
    # About 1 where the two are about equal, whichever is larger: a compiler may compute the comparison more than once,
    # and round differently each time.
    share = limit / jnp.maximum(brightness, DARK)
    return jnp.where((limit >= 0) & (brightness > limit), jnp.maximum(share, sure), 1.0)


def _neighbours(planes: jax.Array, *, beyond: float = 0.0) -> Iterator[jax.Array]:
    """The eight neighbours of every pixel, ``beyond`` outside the border."""
    height, width = planes.shape[1:]
    wide = jnp.pad(planes, ((0, 0), (1, 1), (1, 1)), constant_values=beyond)
    for dy, dx in np.ndindex(3, 3):
        if (dy, dx) != (1, 1):
            yield wide[:, dy : dy + height, dx : dx + width]
