"""Motion that is measured: where the guides of one frame lie in the frame before, by blocks, from coarse to fine."""

from typing import NamedTuple

import numpy as np

RADIUS = 3
"""Of the blocks that are compared: 2 r + 1 pixels a side."""
SIDE = 512
"""Pixels; wider frames are searched at a half, a quarter ... of their size."""
_SMALLEST = 12
"""Pixels of the shorter side of the coarsest level."""
_LEVELS = 5
_STEPS = 3
"""Between pixels."""
_CLEAR = 0.5
"""A match is certain if what it leaves is less than this share of what a step of one pixel changes ..."""
_TEXTURE = 0.02
"""... and if that is more than this, as a root mean square of features between 0 and 1."""


class MeasuredMotion(NamedTuple):
    """Vectors [H, W, 2] in pixels, previous minus current, y down; and [H, W] bool, where they are certain."""

    motion: np.ndarray
    certain: np.ndarray


def measure_motion(before: np.ndarray, now: np.ndarray) -> MeasuredMotion:
    """The vectors that bring ``before`` [H, W, C] onto ``now``, features of about 0 to 1 such as albedo and normals.

    Sums of squared differences over blocks are compared at each level of a pyramid, for the vectors of the coarser
    level and those beside them; the finest level is refined between pixels. Nothing is certain where nothing has
    texture.
    """
    height, width = now.shape[:2]
    scale = 1
    while max(height, width) // scale > SIDE:
        scale *= 2
    levels = [(_reduced(before, scale), _reduced(now, scale))]
    while min(levels[-1][1].shape[:2]) >= 2 * _SMALLEST and len(levels) < _LEVELS:
        levels.append((_reduced(levels[-1][0], 2), _reduced(levels[-1][1], 2)))
    vectors = np.zeros((*levels[-1][1].shape[:2], 2), np.int64)
    for number, (first, second) in reversed(list(enumerate(levels))):
        reach = 3 if number == len(levels) - 1 else 1
        vectors = _search(first, second, _enlarged(vectors, second.shape[:2]), reach)
    refined, certain = _refine(*levels[0], vectors)
    motion = scale * np.repeat(np.repeat(refined, scale, 0), scale, 1)[:height, :width]
    certain = np.repeat(np.repeat(certain, scale, 0), scale, 1)[:height, :width]
    widths = ((0, height - motion.shape[0]), (0, width - motion.shape[1]))
    return MeasuredMotion(np.pad(motion, (*widths, (0, 0)), mode="edge").astype(np.float32), np.pad(certain, widths))


def box_mean(image: np.ndarray, radius: int) -> np.ndarray:
    """Means over windows of 2 radius + 1 pixels a side, of what of them is in the image [H, W] or [H, W, C]."""
    for axis in (0, 1):
        length = image.shape[axis]
        widths = [(0, 0)] * image.ndim
        widths[axis] = (1, 0)
        sums = np.pad(np.cumsum(image, axis=axis, dtype=np.float64), widths)
        last = np.minimum(np.arange(length) + radius + 1, length)
        first = np.maximum(np.arange(length) - radius, 0)
        count = (last - first).reshape([-1 if each == axis else 1 for each in range(image.ndim)])
        image = (np.take(sums, last, axis) - np.take(sums, first, axis)) / count
    return image


def _reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Means of blocks; what does not fill a block is left out."""
    if factor == 1:
        return image.astype(np.float32)
    height, width, channels = image.shape
    rows, columns = height // factor, width // factor
    blocks = image[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, channels)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _enlarged(vectors: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """The vectors of a coarser level, for a level of this size."""
    if vectors.shape[:2] == tuple(size):
        return vectors
    rows = np.minimum(np.arange(size[0]) // 2, vectors.shape[0] - 1)
    columns = np.minimum(np.arange(size[1]) // 2, vectors.shape[1] - 1)
    return 2 * vectors[rows[:, None], columns[None, :]]


def _cost(before: np.ndarray, now: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """[H, W] the mean squared difference of the blocks that the vectors bring onto each other."""
    height, width = now.shape[:2]
    rows = np.clip(np.arange(height)[:, None] + vectors[..., 1], 0, height - 1)
    columns = np.clip(np.arange(width)[None, :] + vectors[..., 0], 0, width - 1)
    return box_mean(np.mean((before[rows, columns] - now) ** 2, axis=-1), RADIUS)


def _search(before: np.ndarray, now: np.ndarray, start: np.ndarray, reach: int) -> np.ndarray:
    """The best vectors within ``reach`` of the start and of its neighbours' starts; of equals, the start."""
    best, cost = start, _cost(before, now, start)
    steps = [(x, y) for y in range(-reach, reach + 1) for x in range(-reach, reach + 1) if x or y]
    starts = [(start, steps)]
    for axis, by in ((0, 4), (0, -4), (1, 4), (1, -4)):  # across the edges of what moves otherwise
        starts.append((np.roll(start, by, axis=axis), [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]))
    for base, around in starts:
        for step in around:
            tried = base + np.array(step)
            found = _cost(before, now, tried)
            better = found < 0.98 * cost - 1e-9
            best = np.where(better[..., None], tried, best)
            cost = np.where(better, found, cost)
    return best


def _refine(before: np.ndarray, now: np.ndarray, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vectors between pixels, and where they are certain.

    Over each block the step d solves sum(g g^T) d = sum(g (now - warped)), where g are the gradients of the warped
    frame (Lucas and Kanade 1981). A block is certain if a step of a pixel in the direction that changes least would
    change it more than what is left.
    """
    height, width = now.shape[:2]
    motion = vectors.astype(np.float64)
    for _ in range(_STEPS):
        warped = _sample(before, motion)
        slope_y, slope_x = np.gradient(warped, axis=(0, 1))
        left = now - warped
        products = (slope_x * slope_x, slope_x * slope_y, slope_y * slope_y, slope_x * left, slope_y * left)
        xx, xy, yy, bx, by = (box_mean(np.mean(each, axis=-1), RADIUS) for each in products)
        determinant = xx * yy - xy * xy
        solid = determinant > 1e-12
        safe = np.where(solid, determinant, 1.0)
        step = np.stack([yy * bx - xy * by, xx * by - xy * bx], axis=-1) / safe[..., None]
        motion += np.where(solid[..., None], np.clip(step, -0.6, 0.6), 0.0)
    least = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy * xy))
    cost = box_mean(np.mean((_sample(before, motion) - now) ** 2, axis=-1), RADIUS)
    x, y = np.arange(width)[None, :] + motion[..., 0], np.arange(height)[:, None] + motion[..., 1]
    inside = (x >= RADIUS) & (x <= width - 1 - RADIUS) & (y >= RADIUS) & (y <= height - 1 - RADIUS)
    return motion, inside & (least > _TEXTURE**2) & (cost < _CLEAR * least)


def _sample(image: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """The image at each pixel's target, bilinear in float64; the border is repeated."""
    height, width = image.shape[:2]
    x = np.clip(np.arange(width)[None, :] + motion[..., 0], 0, width - 1)
    y = np.clip(np.arange(height)[:, None] + motion[..., 1], 0, height - 1)
    column, row = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    u, v = (x - column)[..., None], (y - row)[..., None]
    upper = (1 - u) * image[row, column] + u * image[row, right]
    return (1 - v) * upper + v * ((1 - u) * image[below, column] + u * image[below, right])
