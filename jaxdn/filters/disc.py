"""Edge-stopped averages over a few taps of a disc, whose size and rotation differ from pixel to pixel.

Every pixel has its own rotation, so that what eight taps miss becomes noise that later frames average, not a pattern.
Arrays are planar, ``[C, H, W]``.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.filters.edge_stopping import TapOffset, Weight
from jaxdn.ops.dispatch.row_tiles import map_row_tiles

_PLACES = [(r, turn + 0.5 * np.pi * k) for r, turn in ((1.0, 0.0), (0.5, 0.25 * np.pi)) for k in range(4)]
TAPS = np.array([(r * np.cos(angle), r * np.sin(angle), np.exp(-0.66 * r * r)) for r, angle in _PLACES])
"""Rows of (x, y, h): four taps on the rim of the unit disc, four between them at half its radius, and a Gaussian."""
_TILE_PIXELS = 5_000
"""Approximate number of pixels in a tile."""


def rotations(shape: tuple[int, ...], number: jax.Array | int, dtype: jnp.dtype) -> jax.Array:
    """An angle in [0, 2 pi) for every pixel [H, W]: noise that is hashed from the pixel and ``number``."""
    key = jax.random.fold_in(jax.random.key(0), number)
    return 2 * jnp.pi * jax.random.uniform(key, shape, jnp.float32).astype(dtype)


def disc_average(
    values: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    radius: jax.Array,
    angle: jax.Array,
    *,
    taps: np.ndarray = TAPS,
) -> jax.Array:
    """Weighted mean of ``values`` [C, H, W] over a pixel and ``taps`` around it, each at the nearest pixel.

    The pixel itself has the weight 1; taps outside the image or without a surface have none. Where there is no surface
    the result is 0. No gradient flows into ``radius`` and ``angle``.

    Args:
      values: planes to average.
      hit: [H, W] bool, a surface is seen; other pixels are never taps. None: everywhere.
      weights: edge-stopping weights, see :mod:`jaxdn.filters.edge_stopping`.
      radius: [H, W] of the disc in pixels.
      angle: [H, W] by which it is rotated.
      taps: rows of (x, y, h) in the unit disc.
    """
    channels, height, width = values.shape
    inside = (jnp.ones((height, width), bool) if hit is None else hit).astype(values.dtype)[None]
    there = [jnp.where(inside > 0, values, 0.0), inside, *(one.there for one in weights)]
    ends = np.cumsum([len(planes) for planes in there])
    packed = jnp.concatenate(there).transpose(1, 2, 0).reshape(height * width, -1)
    here = [one.here.transpose(1, 2, 0) for one in weights]
    radius, angle = lax.stop_gradient(radius), lax.stop_gradient(angle)
    steps = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle)], axis=-1)
    place = jnp.stack(jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij"), axis=-1).astype(jnp.int32)

    def tile(part: tuple[jax.Array, ...]) -> jax.Array:
        place, steps, centre, *here = part

        def add(sums: jax.Array, tap: jax.Array) -> tuple[jax.Array, None]:
            x, y, share = tap
            column, row = x * steps[..., 0] - y * steps[..., 1], x * steps[..., 1] + y * steps[..., 0]
            column, row = (jnp.round(each) for each in (column, row))
            at_row, at_column = place[..., 0] + row.astype(jnp.int32), place[..., 1] + column.astype(jnp.int32)
            on_screen = (at_row >= 0) & (at_row < height) & (at_column >= 0) & (at_column < width)
            index = jnp.clip(at_row, 0, height - 1) * width + jnp.clip(at_column, 0, width - 1)
            found = packed.at[index].get(mode="promise_in_bounds")
            offset = TapOffset(column, row, jnp.sqrt(column * column + row * row))
            weight = (
                share * jnp.where(on_screen, found[..., channels], 0.0) * _weight(weights, found, ends, here, offset)
            )
            return sums + weight[..., None] * found[..., : channels + 1], None

        sums, _ = lax.scan(add, centre, jnp.asarray(taps, values.dtype))
        some = centre[..., -1:] > 0
        return jnp.where(some, sums[..., :-1] / jnp.where(some, sums[..., -1:], 1.0), 0.0)

    centre = packed[:, : channels + 1].reshape(height, width, -1)
    return map_row_tiles(tile, (place, steps, centre, *here), pixels=_TILE_PIXELS).transpose(2, 0, 1)


def _weight(
    weights: Sequence[Weight], found: jax.Array, ends: np.ndarray, here: Sequence[jax.Array], offset: TapOffset
) -> jax.Array:
    """The product of all weights [h, w] at a tap, where ``found`` [h, w, C] has their planes from ``ends[1]`` on."""
    planes = [
        ([found[..., i] for i in range(start, end)], [at[..., i] for i in range(at.shape[-1])])
        for start, end, at in zip(ends[1:-1], ends[2:], here, strict=True)
    ]
    exponents = [one.exponent(*at, offset) for one, at in zip(weights, planes, strict=True) if one.exponent]
    factors = [one.factor(*at, offset) for one, at in zip(weights, planes, strict=True) if one.factor]
    if exponents:
        factors.append(jnp.exp(-functools.reduce(jnp.add, exponents)))
    return functools.reduce(jnp.multiply, factors, jnp.ones(found.shape[:2], found.dtype))
