"""The history of every pixel, from the taps of its cell that show the same surface; with a gradient that is cheap.

The same test of every tap as in :mod:`jaxdn.filters.reprojection`, without its second chance among neighbours: a pixel
whose four taps all show something else has no history. Fetches and weights do not depend on the history's values, so
that training needs only the adjoint of a weighted sum. They run by strips: at 720p, fetching the taps of all pixels at
once takes twice as long.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.filters.guides import Guides, guides_of, pack, shared, unpack
from jaxdn.filters.reprojection import WEIGHT_MIN, Expected, expected, same_surface
from jaxdn.frame import Frame
from jaxdn.motion import targets
from jaxdn.ops.strips import by_strips
from jaxdn.ops.warp import cells, corners, differentiable_mean

_STRIP = 5_000
"""Approximate number of pixels in a strip."""


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
      depth_tolerance: see :func:`jaxdn.filters.reprojection.expected`.
      normal_threshold: see :func:`jaxdn.filters.reprojection.same_surface`.
    """
    before = shared(before, guides_of(frame))
    wanted = expected(frame, before, depth_tolerance=depth_tolerance)
    sound = jnp.all(jnp.isfinite(history) & (history >= 0), axis=-1, keepdims=True)
    broken = jnp.sum(~sound & ~first, dtype=jnp.int32)
    history = jnp.where(sound, history, 0.0)
    if frame.motion is None:
        same = same_surface(before, wanted, normal_threshold=normal_threshold)
        valid = (sound[..., 0] & same & ~first)[..., None]
        return Recalled(jnp.where(valid, history, 0.0), valid, broken)

    cell = _cells(frame.motion, first)
    packed = lax.stop_gradient(pack(jnp.concatenate([history, sound.astype(history.dtype)], axis=-1), before))

    def strip(part: tuple[_Cells, Expected]) -> tuple[jax.Array, jax.Array, jax.Array]:
        cell, wanted = part
        found = corners(packed, cell.top, cell.left)
        taps = [unpack(found[..., index, :], before) for index in range(4)]
        weights = []
        for share, (whole, guides) in zip(cell.shares(), taps, strict=True):
            same = same_surface(guides, wanted, normal_threshold=normal_threshold)
            weights.append(jnp.where(cell.inside & (whole[..., -1] > 0) & same, share[..., 0], 0.0))
        total = functools.reduce(jnp.add, weights)
        valid = total >= WEIGHT_MIN
        weights = [jnp.where(valid, weight / jnp.where(valid, total, 1.0), 0.0) for weight in weights]
        mean = [weight[..., None] * whole[..., :-1] for weight, (whole, _) in zip(weights, taps, strict=True)]
        return functools.reduce(jnp.add, mean), valid[..., None], jnp.stack(weights, axis=-1)

    # The weights are for the gradient; where none is taken, they are not computed.
    mean, valid, weights = by_strips(strip, (cell, wanted), pixels=_STRIP)
    return Recalled(differentiable_mean(mean, history, cell.top, cell.left, weights), valid, broken)


class _Cells(NamedTuple):
    """Where every pixel fetches; names as in :func:`jaxdn.ops.warp.cells`."""

    left: jax.Array
    top: jax.Array
    fx: jax.Array
    fy: jax.Array
    inside: jax.Array
    """[H, W] bool, the target is in the image and known."""

    def shares(self) -> list[jax.Array]:
        """The bilinear weights of the four corners."""
        return [(1 - y) * (1 - x) for y in (self.fy, 1 - self.fy) for x in (self.fx, 1 - self.fx)]


def _cells(motion: jax.Array, first: jax.Array) -> _Cells:
    """The cells of the targets ``p + motion(p)``."""
    height, width = motion.shape[:2]
    motion = lax.stop_gradient(motion)
    known = jnp.all(jnp.isfinite(motion), axis=-1)
    x, y = targets(jnp.where(known[..., None], motion, 0.0))
    inside = known & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1) & ~first
    left, top, fx, fy = cells(jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1), height, width)
    return _Cells(left, top, fx, fy, inside)
