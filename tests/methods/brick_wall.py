"""A brick wall with thin lines behind a shelf and a pole, seen by a camera that pans: pixels are exact box filters."""

import jax
import numpy as np

from jaxdn.core.frame import Frame

SIZE = (56, 80)
_EVERYTHING = (-1e3, 1e3, -1e3, 1e3)
_MORTAR = np.array([0.75, 0.72, 0.68])
_BRICK = np.array([0.45, 0.18, 0.12])


def pan(rng, speed, count=16, error=0.03, spread=0.0):
    """(frames, truth) of a pan by ``speed`` pixels a frame: the denoiser's image is in ``direct``.

    ``error`` is the deviation of its errors, which 5x5 pixels share, relative to the light; ``spread`` is that of the
    albedo's noise.
    """
    frames, truths = [], []
    for index in range(count):
        albedo, truth, ids = draw_wall(speed * index, 0.37 * speed * index)
        wide = np.pad(rng.normal(size=truth.shape), ((2, 2), (2, 2), (0, 0)))
        errors = sum(wide[dy : dy + SIZE[0], dx : dx + SIZE[1]] for dy, dx in np.ndindex(5, 5)) / 5
        albedo = np.clip(albedo * (1 + spread * rng.normal(size=albedo.shape)), 0, 1)
        frames.append(
            Frame(
                (truth * rng.exponential(size=(*SIZE, 1))).astype(np.float32),
                direct=np.maximum(truth * (1 + error * errors), 0).astype(np.float32),
                albedo=albedo.astype(np.float32),
                motion=np.broadcast_to(np.float32([speed, 0.37 * speed]), (*SIZE, 2)),
                depth=(5.0 - ids[..., None]).astype(np.float32),
                ids=ids[..., None],
            )
        )
        truths.append(truth)
    return jax.tree.map(lambda *each: np.stack(each), *frames), np.stack(truths)


def draw_wall(x, y):
    """Albedo and radiance [H, W, 3], and the ids [H, W] of pixels' centres, of a camera at (x, y) in pixels."""
    rng = np.random.default_rng(0)
    things = [
        ((28.3 - x, 50.8 - x, 20.4 - y, 24.9 - y), np.array([0.3, 0.12, 0.05]), 1.4),
        ((62.6 - x, 64.1 - x, -1e3, 1e3), np.array([0.15, 0.2, 0.5]), 0.5),
    ]

    def seen(box):
        return _cover(box) - sum(_cover(_intersect(box, thing)) for thing, _, _ in things)

    albedo = seen(_EVERYTHING)[..., None] * _MORTAR
    for row, column in np.ndindex(24, 26):
        color = _BRICK * rng.uniform(0.6, 1.3)
        left, top = (column - 4 + row % 2 / 2) * 9.3 - x, (row - 2) * 5.2 - y
        albedo += seen((left, left + 8.2, top, top + 4.1))[..., None] * (color - _MORTAR)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    light = 0.8 + 0.35 * np.sin((columns + x) / 17) * np.cos((rows + y) / 13)
    radiance, ids = albedo * light[..., None], np.zeros(SIZE, np.int32)
    for number, (box, color, brightness) in enumerate(things, 1):
        share = _cover(box)[..., None] * color
        albedo, radiance = albedo + share, radiance + brightness * share
        ids[(columns >= box[0]) & (columns < box[1]) & (rows >= box[2]) & (rows < box[3])] = number
    return albedo, radiance, ids


def _intersect(one, two):
    return max(one[0], two[0]), min(one[1], two[1]), max(one[2], two[2]), min(one[3], two[3])


def _cover(box):
    """[H, W] the share of each pixel that a box (left, right, top, bottom) covers."""

    def along(low, high, size):
        begin = np.arange(size) - 0.5
        return np.clip(np.minimum(high, begin + 1) - np.maximum(low, begin), 0, 1)

    return np.outer(along(box[2], box[3], SIZE[0]), along(box[0], box[1], SIZE[1]))
