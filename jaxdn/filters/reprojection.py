"""Reprojection of the history with a test of every tap, as SVGF and later filters do instead of a plain warp.

A plain bilinear warp mixes all four taps. Here each tap is accepted or rejected (same object, expected depth, same
orientation) and the accepted ones are renormalised; where none is accepted, the 3x3 neighbourhood of the target is
tried (Schied et al. 2017).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.filters.guides import Guides, cosine, depth_slopes, guides_of, shared
from jaxdn.frame import Frame

WEIGHT_MIN = 0.01
"""Minimum sum of accepted bilinear weights that counts as history."""


class Expected(NamedTuple):
    """What a tap of the previous frame must show, for every pixel; ``None`` for what one of the frames lacks."""

    depth: jax.Array | None
    """[H, W]."""
    tolerance: jax.Array | None
    """[H, W] of the depth."""
    normal: jax.Array | None
    """[H, W, 3]."""
    ids: jax.Array | None
    """[H, W]."""


def expected(frame: Frame, before: Guides, *, depth_tolerance: float) -> Expected:
    """What a tap must show, for a previous frame with the guides ``before``.

    The depth at the target and ``depth_tolerance z + 2 (|dz/dx| + |dz/dy|)``, the normal and the id of the pixel.
    """
    tested = shared(guides_of(frame), before)
    ids = None if tested.ids is None else tested.ids[..., 0]
    if tested.depth is None:
        return Expected(None, None, tested.normal, ids)
    depth = (tested.depth if frame.previous_depth is None else frame.previous_depth)[..., 0]
    slope_x, slope_y = depth_slopes(tested.depth, frame.ids)
    return Expected(depth, depth_tolerance * depth + 2 * (jnp.abs(slope_x) + jnp.abs(slope_y)), tested.normal, ids)


def same_surface(tap: Guides, wanted: Expected, *, normal_threshold: float) -> jax.Array:
    """The test of one tap for every pixel, bool [H, W]: does it show the same surface?

    It does where ids agree, its depth is the expected one within the tolerance and the cosine of the normals exceeds
    ``normal_threshold``; what one of the two lacks is not tested. ``tap`` are the guides [H, W, C] of the taps.
    """
    passed: list[jax.Array] = []
    if tap.depth is not None and wanted.depth is not None and wanted.tolerance is not None:
        passed.append(jnp.abs(tap.depth[..., 0] - wanted.depth) <= wanted.tolerance)
    if tap.normal is not None and wanted.normal is not None:
        passed.append(cosine(tap.normal, wanted.normal) > normal_threshold)
    if tap.ids is not None and wanted.ids is not None:
        passed.append(tap.ids[..., 0] == wanted.ids)
    return functools.reduce(jnp.logical_and, passed, jnp.asarray(True))


def reproject(
    packed: jax.Array,
    motion: jax.Array | None,
    accept: Callable[[jax.Array], jax.Array],
) -> tuple[jax.Array, jax.Array]:
    """Fetch ``packed`` [H, W, C] of the previous frame at ``p + motion(p)`` from accepted taps only.

    ``accept`` gets one tap for every pixel, [H, W, C], and returns [H, W] bool. Taps outside the image count as
    rejected, rejected values are never multiplied (they may be NaN), and no gradient flows into the motion. Returns the
    renormalised mean [H, W, C], 0 where there is no history, and [H, W] bool, where there is one. Non-finite motion
    means no history; no motion (``None``) is zero motion without a gather.
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

    # With a static camera no tap is rejected, and the nine fetches are skipped.
    return lax.cond(jnp.all(valid | ~known), lambda mean, valid: (mean, valid), second_chance, mean, valid)
