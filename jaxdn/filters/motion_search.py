"""Motion that is measured: where what one frame shows lay in the frame before, by guides that have little noise.

Frames without motion vectors still show where their surfaces went. Three steps find it, from coarse to fine:

1. *Blocks.* For whole vectors v the cost at p is the mean over a window and the features f of

       min(|f_before(p + v) - f_now(p)|, 0.3).

   At each level of a pyramid the vectors of the coarser level, those of neighbours and those beside the best are tried
   (Barnes et al., "PatchMatch", 2009). The finest is refined between pixels: over the window, d solves
   ``sum(g g^T) d = sum(g (f_now - f_before(p + v)))`` with the gradients g of f_now (Baker and Matthews, "Lucas-Kanade
   20 Years On", 2004, the inverse compositional way).
2. *The camera* (:mod:`jaxdn.filters.camera_search`). All that stands still moves by few numbers and its depth.
   They are fitted to the blocks first, then to the features themselves, so that a wall without texture moves with the
   corners of its room.
3. *The choice.* Each pixel takes the camera's vector, unless its block leaves clearly less: then something moves by
   itself. Where the camera explains no more than rest does, it rests: vectors are exactly 0.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.core.frame import FAR, Array, Frame
from jaxdn.filters.camera_search import fit_camera, move_by_camera
from jaxdn.filters.image_steps import differentiate, halve, mean_around
from jaxdn.ops.warp import warp

SIDE = 640
"""Pixels; larger frames are searched at a half, a quarter ... of their size."""
_RADIUS = 2
"""Of windows whose costs are compared: 2 r + 1 pixels a side."""
_REFINED = 3
"""The radius of windows that are refined between pixels."""
_SMALLEST = 12
"""Pixels of the shorter side of the coarsest level, at the least."""
_LEVELS = 6
_OUTLIER = 0.3
"""A difference of features counts no more than this."""
_KEEP = 0.98
"""A vector is better if its cost is less than this share of the best one's."""
_NEIGHBOURS: tuple[tuple[int, int], ...] = ((0, 0), (0, 4), (0, -4), (4, 0), (-4, 0))
"""Whose vectors are tried: across the edges of what moves otherwise."""
_STEPS = 2
_FLAT = 1e-5
"""Mean squares of gradients that are taken for noise."""
_BY_ITSELF = 0.7
"""A block moves by itself where it leaves less than this share of what the camera leaves ..."""
_TOGETHER = 0.6
"""... and the vectors around it differ by less than so many pixels; those that fit noise differ by more."""
_RESTS = 0.97
"""The camera rests if its vectors leave more than this share of what no vectors leave."""
_CLEAR = 0.5
"""A match is certain if the square that it leaves is less than this share of what a step of one pixel changes ..."""
_TEXTURE = 0.02
"""... and if that is more than this, as a root mean square of features between 0 and 1."""
_ALIKE = 8.0
"""Pixels of a window that change alike, from which on it is no noise; of noise 0.1 % of the windows have as many."""
_SHARE = 0.01
"""Of the windows of a frame in which something moves."""


class MeasuredMotion(NamedTuple):
    """Vectors in pixels, previous minus current, y down."""

    motion: Array
    """[H, W, 2]."""
    certain: Array
    """[H, W] bool: there is texture, and it fits."""


class Look(NamedTuple):
    """What is compared of a frame."""

    features: jax.Array
    """[h, w, C] of about 0 to 1, at the size at which is searched."""
    nearness: jax.Array | None
    """[H, W], the mean depth by the depth, 0 to 4; 0 where nothing is. None without depth."""


def see(frame: Frame) -> Look | None:
    """What a frame shows of its surfaces: albedo and half of the normal; None without both."""
    if frame.albedo is None and frame.normal is None:
        return None
    guides = Frame(frame.radiance[:0], albedo=frame.albedo, normal=frame.normal, depth=frame.depth)
    return _see(guides)


@jax.jit
def _see(frame: Frame) -> Look:
    parts = [] if frame.albedo is None else [frame.albedo]
    parts += [] if frame.normal is None else [0.5 * frame.normal]
    nearness = None if frame.depth is None else measure_nearness(frame.depth[..., 0])
    features = jnp.clip(jnp.nan_to_num(jnp.concatenate(parts, axis=-1)), -2, 2)
    return Look(reduce_size(features.astype(jnp.float32)), nearness)


def measure_nearness(depth: jax.Array) -> jax.Array:
    """The geometric mean of the depth [H, W] by the depth, at most 4; 0 where nothing is."""
    there = (depth > 0) & (depth < FAR)
    logarithm = jnp.log(jnp.where(there, depth, 1.0))
    mean = jnp.sum(logarithm) / jnp.maximum(jnp.sum(there), 1)
    return jnp.where(there, jnp.minimum(jnp.exp(mean - logarithm), 4.0), 0.0).astype(jnp.float32)


def reduce_size(image: jax.Array) -> jax.Array:
    """[H, W, C] halved until no side is longer than :data:`SIDE`."""
    while max(image.shape[:2]) > SIDE:
        image = halve(image)
    return image


@jax.jit
def something_moves(before: jax.Array, now: jax.Array) -> jax.Array:
    """Whether the difference of two frames' features [H, W, C] is more than noise in a hundredth of the windows."""
    return jnp.mean(_count_alike(now - before) > _ALIKE) > _SHARE


def _count_alike(difference: jax.Array) -> jax.Array:
    """[H, W] about how many pixels of the window around each differ alike: ``n |mean(d)|^2 / mean(|d|^2)``.

    Noise is independent from pixel to pixel: of any strength, it gives about 1. An edge that moves changes as many
    pixels alike as lie along it.
    """
    mean, square = mean_around(difference, _RADIUS), mean_around(jnp.sum(difference**2, axis=-1), _RADIUS)
    return (2 * _RADIUS + 1) ** 2 * jnp.sum(mean**2, axis=-1) / jnp.maximum(square, 1e-8)


@functools.partial(jax.jit, static_argnames="size")
def measure_motion(
    before: jax.Array, now: jax.Array, nearness: jax.Array | None = None, *, size: tuple[int, ...] | None = None
) -> MeasuredMotion:
    """The vectors that bring the features ``before`` [h, w, C] onto ``now``, for frames of ``size`` (H, W).

    Args:
      before: of about 0 to 1, such as albedo and normals, at the size at which is searched.
      now: of the same size.
      nearness: [H, W], :attr:`Look.nearness` of ``now``; None: the camera is fitted without depth.
      size: of the frames; None: that of the features.
    """
    check_image(before, "before")
    check_image(now, "now")
    check_same_size(before, now, ("before", "now"))
    height, width = now.shape[:2] if size is None else size
    before, now = _soften(jnp.asarray(before, jnp.float32)), _soften(jnp.asarray(now, jnp.float32))
    scale = 1
    while -(-max(height, width) // scale) > max(now.shape[:2]):
        scale *= 2
    whole = _search(before, now)
    blocks, texture = _refine(before, now, whole)
    left_by_whole, left_by_blocks = _leave(before, now, whole), _leave(before, now, blocks)
    blocks = jnp.where((left_by_blocks < left_by_whole)[..., None], blocks, whole)  # not across edges
    left_by_blocks = jnp.minimum(left_by_blocks, left_by_whole)
    small = nearness if nearness is None else reduce_size(nearness[..., None])[..., 0]
    camera = fit_camera(before, now, small, blocks, texture / (texture + 1e-4))
    moved = move_by_camera(camera, now.shape[:2], small)
    left_still, left = _leave(before, now, jnp.zeros_like(moved)), _leave(before, now, moved)
    moves = jnp.sum(left) < _RESTS * jnp.sum(left_still)
    moved, left = jnp.where(moves, moved, 0.0), jnp.where(moves, left, left_still)
    alone = (left_by_blocks < _BY_ITSELF * left) & (_spread(whole) < _TOGETHER)
    chosen = jnp.where(alone[..., None], blocks, moved)
    certain = _is_certain(before, now, chosen, texture)
    if scale == 1:
        return MeasuredMotion(chosen, certain)
    moved = scale * move_by_camera(camera, (height, width), nearness)
    alone, certain = (_enlarge(mask, scale, (height, width)) for mask in (alone, certain))
    blocks = scale * _enlarge(blocks, scale, (height, width))
    return MeasuredMotion(jnp.where(alone[..., None], blocks, jnp.where(moves, moved, 0.0)), certain)


def _soften(image: jax.Array) -> jax.Array:
    """Each pixel with a quarter of its neighbours': what lies between pixels is no less noisy then than what lies on
    them, and does not fit better for that alone."""
    for axis in (0, 1):
        widths = [(0, 0)] * 3
        widths[axis] = (1, 1)
        wide, length = jnp.pad(image, widths, mode="edge"), image.shape[axis]
        one, two, three = (lax.slice_in_dim(wide, k, k + length, axis=axis) for k in range(3))
        image = 0.25 * one + 0.5 * two + 0.25 * three
    return image


def _enlarge(image: jax.Array, scale: int, size: tuple[int, ...]) -> jax.Array:
    """Each pixel of [h, w, ...] as a block, of ``size`` in all."""
    return jnp.repeat(jnp.repeat(image, scale, 0), scale, 1)[: size[0], : size[1]]


def _search(before: jax.Array, now: jax.Array) -> jax.Array:
    """The best whole vectors [H, W, 2]."""
    levels = [(before, now)]
    while min(levels[-1][1].shape[:2]) >= 2 * _SMALLEST and len(levels) < _LEVELS:
        levels.append((halve(levels[-1][0]), halve(levels[-1][1])))
    vectors = jnp.zeros((2, *levels[-1][1].shape[:2]), jnp.int32)
    for number, (first, second) in reversed(list(enumerate(levels))):
        if number < len(levels) - 1:
            height, width = second.shape[:2]
            vectors = 2 * jnp.repeat(jnp.repeat(vectors, 2, 1), 2, 2)[:, :height, :width]
        reach = 3 if number == len(levels) - 1 else 1 if number == 0 else 2
        vectors = _search_level(first, second, vectors, reach)
        vectors = _search_level(first, second, vectors, 0)  # what a pixel has found, its neighbours try
    return jnp.moveaxis(vectors, 0, -1).astype(jnp.float32)


def _search_level(before: jax.Array, now: jax.Array, vectors: jax.Array, reach: int) -> jax.Array:
    """The best [2, H, W] of rest, the vectors, those of neighbours, and those up to ``reach`` pixels beside the best.

    Of equals the first, so that nothing moves without need.
    """
    height, width, channels = now.shape
    rows, columns = jnp.arange(height)[:, None], jnp.arange(width)[None]
    pixels = before.reshape(height * width, channels)
    around = range(-reach, reach + 1)
    steps = [(x, y) for y in around for x in around if x or y]
    starts = len(_NEIGHBOURS)
    away, far = jnp.asarray([*_NEIGHBOURS, *steps]), max(max(map(abs, each)) for each in _NEIGHBOURS)
    wide = jnp.pad(vectors, ((0, 0), (far, far), (far, far)), mode="edge")

    def cost(tried: jax.Array) -> jax.Array:
        place = jnp.clip(rows + tried[1], 0, height - 1) * width + jnp.clip(columns + tried[0], 0, width - 1)
        return _compare(pixels[place], now)

    def attempt(index: jax.Array, state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        best, least, start = state
        start = jnp.where(index == starts, best, start)
        x, y = away[index]
        taken = lax.dynamic_slice(wide, (0, far + y * (index < starts), far + x * (index < starts)), best.shape)
        tried = jnp.where(index < starts, taken, start + away[index][:, None, None])
        found = cost(tried)
        better = found < _KEEP * least - 1e-6
        return jnp.where(better[None], tried, best), jnp.where(better, found, least), start

    rest = jnp.zeros_like(vectors)
    return lax.fori_loop(0, len(away), attempt, (rest, cost(rest), rest))[0]


def _compare(one: jax.Array, other: jax.Array) -> jax.Array:
    """[H, W] the mean difference of two images [H, W, C] in the window around each pixel."""
    return mean_around(jnp.mean(jnp.minimum(jnp.abs(one - other), _OUTLIER), axis=-1), _RADIUS)


def _leave(before: jax.Array, now: jax.Array, motion: jax.Array) -> jax.Array:
    """[H, W] the cost of vectors."""
    return _compare(warp(before, motion), now)


def _spread(vectors: jax.Array) -> jax.Array:
    """[H, W] the standard deviation, in pixels, of the vectors [H, W, 2] in the window around each."""
    variance = mean_around(vectors**2, _REFINED) - mean_around(vectors, _REFINED) ** 2
    return jnp.sqrt(jnp.maximum(jnp.sum(variance, axis=-1), 0.0))


def _refine(before: jax.Array, now: jax.Array, motion: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The vectors [H, W, 2] between pixels, and the texture [H, W].

    That is what a step of a pixel changes in the direction that changes least, as a mean square: the smaller eigenvalue
    of ``sum(g g^T)``.
    """
    slope_x, slope_y = differentiate(now)
    xx, xy, yy = (_mean(one, other) for one, other in ((slope_x, slope_x), (slope_x, slope_y), (slope_y, slope_y)))
    texture = 0.5 * (xx + yy - jnp.sqrt((xx - yy) ** 2 + 4 * xy * xy))
    xx, yy = xx + _FLAT, yy + _FLAT
    determinant = xx * yy - xy * xy

    def step(_: jax.Array, motion: jax.Array) -> jax.Array:
        left = now - warp(before, motion)
        x, y = _mean(slope_x, left), _mean(slope_y, left)
        away = jnp.stack([yy * x - xy * y, xx * y - xy * x], axis=-1) / determinant[..., None]
        return motion + jnp.clip(away, -0.6, 0.6)

    return lax.fori_loop(0, _STEPS, step, motion), texture


def _mean(one: jax.Array, other: jax.Array) -> jax.Array:
    """[H, W] the mean product of two images [H, W, C] in the window around each pixel."""
    return mean_around(jnp.mean(one * other, axis=-1), _REFINED)


def _is_certain(before: jax.Array, now: jax.Array, motion: jax.Array, texture: jax.Array) -> jax.Array:
    """[H, W] bool: a step of a pixel would change more than what is left, and the window is in both frames."""
    height, width = texture.shape
    left = now - warp(before, motion)
    x, y = jnp.arange(width)[None] + motion[..., 0], jnp.arange(height)[:, None] + motion[..., 1]
    inside = (x >= _REFINED) & (x <= width - 1 - _REFINED) & (y >= _REFINED) & (y <= height - 1 - _REFINED)
    return inside & (texture > _TEXTURE**2) & (_mean(left, left) < _CLEAR * texture)
