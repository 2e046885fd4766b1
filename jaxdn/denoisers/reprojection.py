"""History fetched by motion, every tap tested on its own: what SVGF and its descendants do instead of a plain warp.

A plain bilinear warp mixes whatever lies under the four taps. Here each tap is accepted or rejected (same object,
expected depth, same orientation), the accepted ones are renormalised, and where none is left the 3x3 neighbourhood of
the target gets a second chance (Schied et al. 2017).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.frame import FAR

WEIGHT_MIN = 0.01
"""Least sum of accepted bilinear weights that counts as history."""


class Guides(NamedTuple):
    """Where the layers of packed guides ``[H, W, G]`` lie; ``None`` is a buffer that is absent."""

    depth: int | None
    normal: slice | None
    ids: int | None


def pack_guides(
    depth: jax.Array | None, normal: jax.Array | None, ids: jax.Array | None, like: jax.Array
) -> tuple[jax.Array, Guides]:
    """Put what is there of depth, normal and ids into one array ``[H, W, 0..5]`` of the dtype of ``like``.

    Ids are stored as floating-point numbers, exact up to 2**24 objects in float32.
    """
    layers: list[jax.Array] = []
    width = 0
    places: list[int | None] = []
    for buffer in (depth, normal, ids):
        places.append(None if buffer is None else width)
        if buffer is not None:
            layers.append(buffer.astype(like.dtype))
            width += buffer.shape[-1]
    packed = jnp.concatenate(layers, axis=-1) if layers else jnp.zeros((*like.shape[:2], 0), like.dtype)
    at_normal = None if places[1] is None else slice(places[1], places[1] + 3)
    return packed, Guides(places[0], at_normal, places[2])


def hit_mask(depth: jax.Array | None, ids: jax.Array | None) -> jax.Array | None:
    """[H, W] bool: the camera ray met a surface; ``None`` (everywhere) where neither buffer can tell."""
    known = []
    if depth is not None:
        known.append(depth[..., 0] < FAR)
    if ids is not None:
        known.append(ids[..., 0] >= 0)
    return None if not known else known[0] if len(known) == 1 else known[0] & known[1]


def cosine(first: jax.Array, second: jax.Array) -> jax.Array:
    """[..., 3] normals -> [...] cosine, where the zero normal of *no surface* is orthogonal to all but itself."""
    both_absent = jnp.all(first == 0, axis=-1) & jnp.all(second == 0, axis=-1)
    return jnp.where(both_absent, 1.0, jnp.sum(first * second, axis=-1))


def depth_slopes(depth: jax.Array, ids: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Screen-space slope of depth ``[H, W, 1]`` along x and y, each ``[H, W]``, per pixel.

    Of the forward and the backward difference, restricted to the same object, the smaller in magnitude; 0 where neither
    exists. A silhouette thus does not pass for a steep surface.
    """
    z = depth[..., 0]
    identity = None if ids is None else ids[..., 0]

    def along(axis: int) -> jax.Array:
        size = z.shape[axis]
        difference = jnp.diff(z, axis=axis)
        same = jnp.ones(difference.shape, bool) if identity is None else jnp.diff(identity, axis=axis) == 0
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        if size == 1:
            return jnp.zeros_like(z)
        forward, has_forward = jnp.pad(difference, after), jnp.pad(same, after)
        backward, has_backward = jnp.pad(difference, before), jnp.pad(same, before)
        take_forward = has_forward & (~has_backward | (jnp.abs(forward) <= jnp.abs(backward)))
        return jnp.where(take_forward, forward, jnp.where(has_backward, backward, 0.0))

    return along(1), along(0)


def reproject(
    packed: jax.Array,
    motion: jax.Array | None,
    accept: Callable[[jax.Array], jax.Array],
    *,
    fallback: bool = True,
) -> tuple[jax.Array, jax.Array]:
    """Fetch ``packed`` [H, W, C] of the previous frame at ``p + motion(p)`` from accepted taps only.

    ``accept`` gets one tap for every pixel, [H, W, C], and returns [H, W] bool. Taps outside the image count as
    rejected, rejected values are never multiplied (they may be NaN), and no gradient flows into the motion. Returns the
    renormalised mean [H, W, C], 0 where there is none, and [H, W] bool: there is one. Motion that is not finite means
    none; no motion (``None``) is zero motion without a gather.
    """
    height, width, channels = packed.shape
    dtype = packed.dtype
    rows = lax.broadcasted_iota(jnp.int32, (height, width), 0)
    columns = lax.broadcasted_iota(jnp.int32, (height, width), 1)

    if motion is None:
        column, row = columns.astype(dtype), rows.astype(dtype)
        known = jnp.ones((height, width), bool)
        margin = jnp.pad(packed, ((1, 1), (1, 1), (0, 0)))
    else:
        vector = lax.stop_gradient(motion).astype(dtype)
        known = jnp.all(jnp.isfinite(vector), axis=-1)
        vector = jnp.where(known[..., None], vector, 0.0)
        # Clipped before the cast: converting a huge float to an integer is undefined.
        column = jnp.clip(columns + vector[..., 0], -2.0, width + 1.0)
        row = jnp.clip(rows + vector[..., 1], -2.0, height + 1.0)
        flat = packed.reshape(height * width, channels)

    def tap(base_row: jax.Array, base_column: jax.Array, dy: int, dx: int) -> tuple[jax.Array, jax.Array]:
        y, x = base_row + dy, base_column + dx
        inside = known & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        if motion is None:
            value = margin[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        else:
            index = jnp.clip(y, 0, height - 1) * width + jnp.clip(x, 0, width - 1)
            value = flat.at[index].get(mode="promise_in_bounds")
        accepted = inside & accept(value)
        return jnp.where(accepted[..., None], value, 0.0), accepted

    if motion is None:
        total, accepted = tap(rows, columns, 0, 0)
        weight = accepted.astype(dtype)
    else:
        top, left = jnp.floor(row).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
        down, right = row - top, column - left
        total, weight = jnp.zeros_like(packed), jnp.zeros((height, width), dtype)
        for dy, dx in np.ndindex(2, 2):
            share = (down if dy else 1 - down) * (right if dx else 1 - right)
            value, accepted = tap(top, left, dy, dx)
            share = jnp.where(accepted, share, 0.0)
            total, weight = total + share[..., None] * value, weight + share
    valid = weight >= WEIGHT_MIN
    mean = jnp.where(valid[..., None], total, 0.0) / jnp.where(valid, weight, 1.0)[..., None]
    if not fallback:
        return mean, valid

    def second_chance(mean: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
        near_row, near_column = (jnp.floor(at + 0.5).astype(jnp.int32) for at in (row, column))
        if motion is None:
            near_row, near_column = rows, columns
        total, count = jnp.zeros_like(packed), jnp.zeros((height, width), dtype)
        for dy, dx in np.ndindex(3, 3):
            value, accepted = tap(near_row, near_column, dy - 1, dx - 1)
            total, count = total + value, count + accepted
        found = ~valid & (count > 0)
        around = total / jnp.where(found, count, 1.0)[..., None]
        return jnp.where(found[..., None], around, mean), valid | found

    # A still camera rejects nothing: then the nine fetches are skipped.
    return lax.cond(jnp.all(valid | ~known), lambda mean, valid: (mean, valid), second_chance, mean, valid)
