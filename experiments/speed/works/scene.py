"""Frame buffers with the computing cost of real ones, made without a renderer, for timing only."""

import numpy as np

from jaxdn.core.frame import Clip, Frame


def clip(frames: int, height: int, width: int, *, seed: int = 0) -> Clip:
    """A clip [T, H, W, C] of a patterned wall with a panning camera and a moving square in front, with 1 spp noise.

    Vectors have fractions of a pixel, a border of history is off-screen, and next to the square are pixels that the
    frame before did not show and whose dual vector differs from the traditional one, as in a rendered clip.
    """
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    shape = (frames, height, width)
    albedo, normal = np.empty((*shape, 3), np.float32), np.empty((*shape, 3), np.float32)
    reference, motion = np.empty_like(albedo), np.empty((*shape, 2), np.float32)
    depth, dual, visible = np.empty((*shape, 1), np.float32), np.empty_like(motion), np.empty((*shape, 1), bool)
    side, pan = min(height, width) // 4, np.array([1.3, 0.4], np.float32)
    for index in range(frames):
        x, y = columns + index * pan[0], rows + index * pan[1]
        across, down = np.sin(x / 17), np.cos(y / 23)
        albedo[index] = 0.5 + 0.4 * np.stack([across * down, across, down], -1)
        slope = np.stack([0.3 * across, 0.3 * down, np.ones_like(across)], -1)
        normal[index] = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
        depth[index] = 4 + np.stack([across + down], -1)
        motion[index] = dual[index] = pan
        left, top = (int(start + 2 * index) % max(length - side, 1) for start, length in ((5, width), (9, height)))
        square = (slice(top, top + side), slice(left, left + side))
        motion[index][square] = dual[index][square] = -2.0
        depth[index][square], normal[index][square] = 1.5, (0, 0, 1)
        uncovered = (slice(top, top + side), slice(max(left - 3, 0), left))
        dual[index][uncovered] = -2.0
        visible[index] = True
        visible[index][uncovered] = False
        reference[index] = albedo[index] * (0.6 + 0.4 * np.cos((x + y) / 40))[..., None]
    noise = rng.exponential(size=(*shape, 3)).astype(np.float32)
    return Clip(
        Frame(reference * noise, albedo, normal, depth, motion=motion, dual_motion=dual, visible=visible),
        reference,
    )
