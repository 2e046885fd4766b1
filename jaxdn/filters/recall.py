"""The history of every pixel, from the taps of its cell that show the same surface; with a gradient that is cheap.

The same test of every tap as in :mod:`jaxdn.filters.reprojection`, without its second chance among neighbours: a pixel
whose four taps all show something else has no history. Fetches and weights do not depend on the history's values, so
that training needs only the adjoint of a weighted sum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.filters.guides import Guides, guides_of, pack, shared, unpack
from jaxdn.filters.reprojection import WEIGHT_MIN, same_surface
from jaxdn.frame import Frame
from jaxdn.ops.warp import cells, corners, weighted_cells


class Recalled(NamedTuple):
    """What is left of the history."""

    history: jax.Array
    """[H, W, C] the renormalised mean of the accepted taps; 0 where there is none."""
    valid: jax.Array
    """[H, W, 1] bool."""
    broken: jax.Array
    """How many pixels of the history were not finite or negative."""


def recall(
    history: jax.Array,
    before: Guides,
    frame: Frame,
    first: jax.Array,
    *,
    depth_tolerance: float = 0.02,
    normal_threshold: float = 0.9,
) -> Recalled:
    """Fetch ``history`` [H, W, C] >= 0 of the previous frame at ``p + motion(p)``.

    Args:
      history: pixels with a value that is not finite or negative are no taps.
      before: the guides of the previous frame.
      frame: the current frame; no motion is zero motion.
      first: bool scalar, there is no history.
      depth_tolerance: see :func:`jaxdn.filters.reprojection.same_surface`.
      normal_threshold: likewise.
    """
    height, width = history.shape[:2]
    before = shared(before, guides_of(frame))
    accept = same_surface(frame, before, depth_tolerance=depth_tolerance, normal_threshold=normal_threshold)
    motion = jnp.zeros((height, width, 2), history.dtype) if frame.motion is None else lax.stop_gradient(frame.motion)
    known = jnp.all(jnp.isfinite(motion), axis=-1)
    motion = jnp.where(known[..., None], motion, 0.0)
    x = lax.broadcasted_iota(motion.dtype, (height, width), 1) + motion[..., 0]
    y = lax.broadcasted_iota(motion.dtype, (height, width), 0) + motion[..., 1]
    inside = known & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1) & ~first
    left, top, fx, fy = cells(jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1), height, width)

    sound = jnp.all(jnp.isfinite(history) & (history >= 0), axis=-1, keepdims=True)
    taps = corners(pack(sound.astype(history.dtype), before), top, left)
    shares = []
    for index, share in enumerate(((1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx)):
        whole, guides = unpack(taps[..., index, :], before)
        shares.append(jnp.where(inside & (whole[..., 0] > 0) & accept(guides), share[..., 0], 0.0))
    weights = lax.stop_gradient(jnp.stack(shares, axis=-1))
    total = jnp.sum(weights, axis=-1, keepdims=True)
    valid = total >= WEIGHT_MIN
    weights = jnp.where(valid, weights, 0.0) / jnp.where(valid, total, 1.0)
    fetched = weighted_cells(jnp.where(sound, history, 0.0), top, left, weights)
    return Recalled(fetched, valid, jnp.sum(~sound & ~first, dtype=jnp.int32))
