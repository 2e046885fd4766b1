"""A sequence in both directions: frames with time turned around, and two passes blended by what each has seen.

A denoiser with a history knows little in its first frames. Run a second time from the last frame to the first, it knows
most there. Time turned around needs motion vectors that lead to the next frame instead of the previous one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Array, Frame, only
from jaxdn.denoiser.sanitize import sanitize
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, expect_surface, guides_of, same_surface
from jaxdn.ops.motion import find_targets

LENGTH_MAX = 8.0
"""More frames than this hardly make a history better: each new one counts a fifth or so (docs/how-to/two-passes.md)."""
_DEPTH_TOLERANCE, _NORMAL_THRESHOLD = 0.02, 0.9
_READS = frozenset({"normal", "depth", "previous_depth", "motion", "ids"})
_ONE_WAY = ("dual_motion", "visible", "luminance_gradient", "shadow_motion", "glossy_motion", "far_motion")
"""What a frame tells about the one before it and not about the one after; left out, so that it is neutral."""


def reverse_time(frame: Frame, after: Frame | None, forward: Array = None) -> Frame:
    """A frame as if time ran backwards: ``motion`` leads to the frame after it, ``previous_depth`` is that frame's.

    The other buffers that compare with the frame before are left out. NumPy arrays in, NumPy arrays out.

    Args:
      frame: [H, W, C]; without motion, nothing moves, and only what is left out changes.
      after: the next frame of the sequence; None after the last, whose vectors are 0 then.
      forward: [H, W, 2] px, next minus current position, y down, where the file has it. Else it is derived: each pixel
        of ``after`` came from ``p + motion``, and what it shows there is the same surface (the test of a history's
        taps) at up to four pixels, of which each takes over the vector that ends closest to it. Pixels where none ends
        are hidden in ``after``: NaN, no history.
    """
    changed: dict[str, Array] = dict.fromkeys(_ONE_WAY)
    if frame.motion is None:
        return frame._replace(**changed, previous_depth=None)
    if forward is not None:
        return frame._replace(
            **changed, motion=forward if after is not None else np.zeros_like(forward), previous_depth=None
        )
    if after is None:
        return frame._replace(**changed, motion=np.zeros_like(frame.motion), previous_depth=frame.depth)
    motion, depth = jax.tree.map(np.asarray, _derive_motion(only(frame, _READS), only(after, _READS)))
    return frame._replace(**changed, motion=motion, previous_depth=depth)


@jax.jit
def _derive_motion(frame: Frame, after: Frame) -> tuple[jax.Array, jax.Array | None]:
    """Motion [H, W, 2] to the frame after, NaN for what is hidden there, and the depth [H, W, 1] of the point then."""
    frame, after = sanitize(frame)[0], sanitize(after)[0]
    height, width = frame.radiance.shape[:2]
    count = height * width
    motion = jnp.zeros((height, width, 2)) if after.motion is None else after.motion
    x, y = find_targets(motion)
    known = jnp.isfinite(x) & jnp.isfinite(y)
    x, y = jnp.where(known, x, 0.0), jnp.where(known, y, 0.0)
    guides = guides_of(frame)
    expected = expect_surface(after, guides, depth_tolerance=_DEPTH_TOLERANCE)
    best = jnp.full(count + 1, jnp.inf)  # the last entry takes what belongs nowhere
    taps = []
    for dy, dx in np.ndindex(2, 2):
        column, row = jnp.floor(x) + dx, jnp.floor(y) + dy
        inside = known & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        place = jnp.where(inside, row * width + column, 0).astype(jnp.int32)
        tap = Guides(*(None if each is None else each.reshape(count, -1)[place] for each in guides))
        fits = inside & same_surface(tap, expected, normal_threshold=_NORMAL_THRESHOLD)
        distance = (x - column) ** 2 + (y - row) ** 2
        place = jnp.where(fits & (distance < 1), place, count)
        best = best.at[place].min(distance)
        taps.append((place, distance))
    source = jnp.full(count + 1, count)
    for place, distance in taps:  # of several at one distance the first, so that the result is the same everywhere
        ends = (place < count) & (distance == best[place])
        source = source.at[jnp.where(ends, place, count)].min(jnp.arange(count).reshape(height, width))
    found = (source[:-1] < count)[:, None]
    source = jnp.where(found[:, 0], source[:-1], 0)
    moved = jnp.where(found, -motion.reshape(count, 2)[source], jnp.nan).reshape(height, width, 2)
    if frame.depth is None or after.depth is None:
        return moved, None
    depth = jnp.where(found, after.depth.reshape(count, 1)[source], frame.depth.reshape(count, 1))
    return moved, depth.reshape(height, width, 1)


class HistoryLength(NamedTuple):
    """For how many frames in a row a pass has seen the point in each pixel."""

    number: jax.Array
    """[H, W, 1], 1 for a point that has just come into view, at most :data:`LENGTH_MAX`."""
    guides: Guides
    """Of the same frame."""


@jax.jit
def update_history_length(before: HistoryLength | None, frame: Frame) -> HistoryLength:
    """The same after one more frame; ``before`` is None at the first. Taps are tested as those of a history."""
    frame, _ = sanitize(only(frame, _READS))
    guides = guides_of(frame)
    if before is None:
        return HistoryLength(jnp.ones((*frame.radiance.shape[:2], 1), frame.radiance.dtype), guides)
    past = reproject(
        before.number,
        before.guides,
        frame,
        jnp.asarray(False),
        depth_tolerance=_DEPTH_TOLERANCE,
        normal_threshold=_NORMAL_THRESHOLD,
    )
    return HistoryLength(jnp.minimum(past.history + 1, LENGTH_MAX), guides)


def blend(one: Array, other: Array, seen_by_one: Array, seen_by_other: Array) -> Array:
    """Two images [H, W, 3] of one frame, weighted by the frames that went into them, [H, W, 1] each, > 0.

    The mean of two independent estimates with the least variance, where that of each is one over its number of frames.
    """
    share = seen_by_one / (seen_by_one + seen_by_other)
    return share * one + (1 - share) * other
