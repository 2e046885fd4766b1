"""Padded row tiles: planes of an image with zeros around it, and weighted sums over a stencil, strip by strip.

Arrays here are planar, ``[C, H, W]``: the stencil then runs along contiguous rows and vectorises. For each
strip of rows, a scan over the taps computes the weight of one tap while it adds up the tap before: written as a plain
sum, XLA:CPU recomputes every weight for each channel, which takes twice the time. The strips fit into the cache.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.filters.edge_stopping import Planes, TapOffset, Weight
from jaxdn.ops.dispatch.row_tiles import rows_per_tile

_STRIP_PIXELS = 16384
NO_WEIGHT = 1e-10
"""Smaller sums of weights count as no tap: their cube, in the gradient of the variance, would underflow to 0. So would
the square of their square, in that of a division by it: there are two divisions instead."""


class PaddedTiles(NamedTuple):
    """How an image is padded by zeros, which all taps outside it hit, and divided into strips of rows."""

    height: int
    width: int
    rows: int
    """Of a strip."""
    margin: tuple[int, int]
    """Rows of zeros above and columns of them to the left, and as many below and to the right."""

    @property
    def strips(self) -> int:
        """Their number; the last one may have rows below the image."""
        return -(-self.height // self.rows)

    @property
    def spare(self) -> int:
        """Rows of the last strip below the image."""
        return self.strips * self.rows - self.height

    def pad(self, planes: jax.Array) -> jax.Array:
        """Planes [..., H, W] with zeros on all sides."""
        (y, x), whole = self.margin, [(0, 0)] * (planes.ndim - 2)
        return jnp.pad(planes, [*whole, (y, y + self.spare), (x, x)])

    def pad_rows(self, planes: jax.Array) -> jax.Array:
        """Planes [..., H, W] with the spare rows alone."""
        return jnp.pad(planes, [*[(0, 0)] * (planes.ndim - 2), (0, self.spare), (0, 0)])

    def crop(self, wide: jax.Array) -> jax.Array:
        """The image [..., H, W] of :meth:`pad` planes."""
        y, x = self.margin
        return wide[..., y : y + self.height, x : x + self.width]

    def map_strips(self, strip: Callable[[jax.Array], list[jax.Array]]) -> list[jax.Array]:
        """Wide planes from ``strip``: first row -> [rows, W] of each plane, 0 below the image."""
        if self.strips == 1:
            return [self.pad(plane) for plane in strip(jnp.zeros((), jnp.int32))]
        y, x = self.margin
        shape = (self.strips * self.rows + 2 * y, self.width + 2 * x)
        tops = self.rows * jnp.arange(self.strips, dtype=jnp.int32)

        def paint(planes: list[jax.Array], top: jax.Array) -> tuple[list[jax.Array], None]:
            new = zip(planes, strip(top), strict=True)
            return [lax.dynamic_update_slice(plane, rows, (top + y, x)) for plane, rows in new], None

        blank = [jnp.zeros(shape, each.dtype) for each in jax.eval_shape(strip, tops[0])]
        return lax.scan(paint, blank, tops)[0]

    def row(self, top: jax.Array, planes: jax.Array) -> jax.Array:
        """The strip [..., rows, W] of :meth:`pad_rows` planes whose first row is ``top``."""
        return lax.dynamic_slice_in_dim(planes, top, self.rows, axis=planes.ndim - 2)

    def shifted(self, top: jax.Array, wide: jax.Array, offset: jax.Array) -> jax.Array:
        """The strip [rows, W] of a :meth:`pad` plane, ``offset`` (rows, columns, margins included) away."""
        return lax.dynamic_slice(wide, (top + offset[0], offset[1]), (self.rows, self.width))


def plan_tiles(height: int, width: int, taps: np.ndarray, *, step_max: int) -> PaddedTiles:
    """The padded tiles of an image for ``taps``, rows of (dy, dx, h), that are up to ``step_max`` pixels apart.

    Strips are for the CPU's cache only; other devices take one strip.
    """
    rows = rows_per_tile(height, width, pixels=_STRIP_PIXELS, least=8)
    reach = np.abs(taps[:, :2]).max(axis=0).astype(int) * step_max
    return PaddedTiles(height, width, rows, (int(reach[0]), int(reach[1])))


class PaddedGuides(NamedTuple):
    """The planes that edge-stopping weights read."""

    there: list[list[jax.Array]]
    """Of each weight, the planes that are read at the tap, wide."""
    here: list[list[jax.Array]]
    """Those that are read at the centre, tall."""


def pad_guides(tiles: PaddedTiles, weights: Sequence[Weight]) -> PaddedGuides:
    """The planes of ``weights``, on the padded tiles."""
    return PaddedGuides(
        [[tiles.pad(plane) for plane in one.there] for one in weights],
        [[tiles.pad_rows(plane) for plane in one.here] for one in weights],
    )


class Sums(NamedTuple):
    """Sums over the taps of a strip, each [rows, W]."""

    planes: list[jax.Array]
    """``sum w v`` of each plane."""
    total: jax.Array
    """``sum w``."""
    spread: jax.Array | None
    """``sum w^2 variance``."""

    def mean(self) -> tuple[list[jax.Array], jax.Array | None]:
        """The mean of each plane, and the variance of this mean; 0 where ``sum w`` counts as no tap."""
        some = self.total > NO_WEIGHT
        share = jnp.where(some, self.total, 1.0)
        mean = [jnp.where(some, plane, 0.0) / share for plane in self.planes]
        return mean, None if self.spread is None else jnp.where(some, self.spread, 0.0) / share / share


def weighted_sums(
    tiles: PaddedTiles,
    top: jax.Array,
    taps: np.ndarray,
    step: int | jax.Array,
    weights: Sequence[Weight],
    guides: PaddedGuides,
    planes: Sequence[jax.Array],
    inside: jax.Array,
    spread: jax.Array | None,
) -> Sums:
    """The sums of one strip, the centre of whose stencil has exactly its h.

    Args:
      tiles: where all planes lie.
      top: first row of the strip in the image.
      taps: rows of (dy, dx, h), the centre first.
      step: their spacing; it may be traced.
      weights: edge-stopping weights.
      guides: their planes.
      planes: wide, 0 where ``inside`` is.
      inside: wide, how much each pixel counts.
      spread: wide, the variance; None: it is not summed.
    """
    dtype, shape = inside.dtype, (tiles.rows, tiles.width)
    offsets = step * jnp.asarray(taps[:, :2], jnp.int32) + jnp.asarray(tiles.margin, jnp.int32)[None]
    # Per tap: dx, dy and its length, all for step 1, and h.
    length = np.hypot(taps[:, 0], taps[:, 1])
    numbers = jnp.asarray(np.stack([taps[:, 1], taps[:, 0], length, taps[:, 2]], axis=1), dtype)
    numbers = numbers * jnp.where(jnp.arange(4) < 3, jnp.asarray(step, dtype), 1.0)[None]
    centre: list[Planes] = [[tiles.row(top, plane) for plane in own] for own in guides.here]
    summed = [*planes, inside]

    def weigh(offset: jax.Array, number: jax.Array) -> jax.Array:
        tap, factor = TapOffset(number[0], number[1], number[2]), jnp.full(shape, number[3])
        around = [[tiles.shifted(top, plane, offset) for plane in own] for own in guides.there]
        samples = list(zip(weights, around, centre, strict=True))
        exponents = [one.exponent(there, here, tap) for one, there, here in samples if one.exponent]
        if exponents:
            factor = factor * jnp.exp(-functools.reduce(jnp.add, exponents))
        for one, there, here in samples:
            if one.factor:
                factor = factor * one.factor(there, here, tap)
        return factor

    def add(
        sums: tuple[list[jax.Array], jax.Array | None], weight: jax.Array, offset: jax.Array
    ) -> tuple[list[jax.Array], jax.Array | None]:
        total, squares = sums
        if spread is not None and squares is not None:
            squares = squares + weight * weight * tiles.shifted(top, spread, offset)
        return [
            old + weight * tiles.shifted(top, plane, offset) for old, plane in zip(total, summed, strict=True)
        ], squares

    def body(carry, tap):
        sums, ready, offset = carry
        return (add(sums, ready, offset), weigh(*tap), tap[0]), None

    # The centre's weight h is ready before the first tap's weight is computed.
    nothing = jnp.zeros(shape, dtype)
    begin = (
        ([nothing] * len(summed), None if spread is None else nothing),
        jnp.full(shape, taps[0, 2], dtype),
        offsets[0],
    )
    (sums, ready, offset), _ = lax.scan(body, begin, (offsets[1:], numbers[1:]))
    total, squares = add(sums, ready, offset)
    return Sums(total[:-1], total[-1], squares)
