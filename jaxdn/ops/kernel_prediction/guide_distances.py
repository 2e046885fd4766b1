"""Squared distances between the features of a pixel and those of its neighbours: the prior of guided kernels.

The log weight of a cross-bilateral filter is ``-|f(p) - f(q)|^2`` for pixel p, its neighbour q and features f (Eisemann
and Durand 2004, "Flash Photography Enhancement via Intrinsic Relighting"; Petschnigg et al. 2004, "Digital Photography
with Flash and No-Flash Image Pairs"). The distance of p to q is that of q to p, so that 12 planes of distances hold the
log weights of all 25 taps.

A plane belongs to an offset (dy, dx) that points down, or right in the same row. Its size is ``[H + dy, W + |dx|]``,
because it also holds the distances to pixels beyond the border, which repeat the nearest edge pixel.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp


class PlaneShift(NamedTuple):
    """Where a plane's distances lead, and where the taps lie in it."""

    down: int
    """Rows to the neighbour, >= 0."""
    left: int
    """Columns to the neighbour, if it is to the right; else 0. The tap (dy, dx) of pixel 0 is at this column."""
    right: int
    """Columns to the neighbour, if it is to the left; else 0. The tap (-dy, -dx) of pixel 0 is at this column."""


def half_offsets(taps: int) -> list[PlaneShift]:
    """The offsets of the second half of the taps, in their order; the first half are their opposites, reversed."""
    radius = math.isqrt(taps) // 2
    after = [divmod(tap, 2 * radius + 1) for tap in range(taps // 2 + 1, taps)]
    return [PlaneShift(row - radius, max(column - radius, 0), max(radius - column, 0)) for row, column in after]


def _planar(features: jax.Array, radius: int) -> jax.Array:
    """[H, W, F] -> [F, H + 2r, W + 2r], edge pixels repeated. Channel by channel: half of the time of a transpose."""
    return jnp.stack([jnp.pad(features[..., f], radius, mode="edge") for f in range(features.shape[-1])])


def _slice_ends(extended: jax.Array, offset: PlaneShift, radius: int) -> tuple[jax.Array, jax.Array]:
    """The features of both ends of every distance in a plane, [F, H + dy, W + |dx|] each."""
    height = extended.shape[1] - 2 * radius + offset.down
    width = extended.shape[2] - 2 * radius + offset.left + offset.right
    top, here, there = radius - offset.down, radius - offset.left, radius - offset.right
    return (
        extended[:, top : top + height, here : here + width],
        extended[:, radius : radius + height, there : there + width],
    )


def compute_distances(features: jax.Array, taps: int) -> tuple[jax.Array, ...]:
    """The plane of squared distances for each of :func:`half_offsets`, from features [H, W, F]."""
    radius = math.isqrt(taps) // 2
    extended = _planar(features, radius)
    planes = []
    for offset in half_offsets(taps):
        here, there = _slice_ends(extended, offset, radius)
        # A sum of differences squared: with 2 <f, g> - |g|^2 features of size 20 would lose three digits.
        terms = [jnp.square(there[f] - here[f]) for f in range(extended.shape[0])]
        planes.append(sum(terms[1:], terms[0]))
    return tuple(planes)


def planes_to_taps(planes: Sequence[jax.Array], height: int, width: int, taps: int) -> jax.Array:
    """The squared distance of every pixel to each of its taps, [height, width, taps]."""
    before, after = [], []
    for plane, offset in zip(planes, half_offsets(taps), strict=True):
        before.append(plane[:height, offset.right : offset.right + width])
        after.append(plane[offset.down : offset.down + height, offset.left : offset.left + width])
    return jnp.stack([*reversed(before), jnp.zeros_like(after[0]), *after], axis=-1)


def taps_to_planes(slopes: jax.Array, taps: int) -> tuple[jax.Array, ...]:
    """The gradient by the planes, from that by the distances of the taps [height, width, taps]: the transpose of
    :func:`planes_to_taps`."""
    planes = []
    for index, (down, left, right) in enumerate(half_offsets(taps)):
        after = jnp.pad(slopes[..., taps // 2 + 1 + index], ((down, 0), (left, right)))
        before = jnp.pad(slopes[..., taps // 2 - 1 - index], ((0, down), (right, left)))
        planes.append(after + before)
    return tuple(planes)


def features_gradient(features: jax.Array, by_planes: Sequence[jax.Array], taps: int) -> jax.Array:
    """The gradient by the features [H, W, F], from that by the planes.

    Gathered: with g(x) the gradient by the distance from x to x + offset, pixel x of the extended features receives
    ``2 (f(x) - f(x + offset)) g(x) + 2 (f(x) - f(x - offset)) g(x - offset)`` of every plane.
    """
    radius = math.isqrt(taps) // 2
    extended, undo = jax.vjp(lambda features: _planar(features, radius), features)
    rows, columns = extended.shape[1:]

    def moved(wide: jax.Array, down: int, across: int) -> jax.Array:
        return wide[..., radius + down : radius + down + rows, radius + across : radius + across + columns]

    wide = jnp.pad(extended, ((0, 0), (radius, radius), (radius, radius)))
    total = jnp.zeros_like(extended)
    for (down, left, right), plane in zip(half_offsets(taps), by_planes, strict=True):
        # Zeros where the plane has no distance, so that both ends can be read at every pixel.
        slopes = jnp.pad(plane, ((2 * radius - down, 2 * radius), (2 * radius - left, 2 * radius - right)))
        total = total + (extended - moved(wide, down, left - right)) * moved(slopes, 0, 0)[None]
        total = total + (extended - moved(wide, -down, right - left)) * moved(slopes, -down, right - left)[None]
    return undo(2 * total)[0]
