"""The inputs of denoisers and operations: a valid clip, and ways to corrupt one of its buffers."""

from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import BUFFERS, Buffer, Clip, Frame

FRAMES, HEIGHT, WIDTH = 3, 16, 24
BY_HAND = frozenset({
    *("radiance", "albedo", "normal", "depth", "roughness", "motion", "dual_motion", "visible", "previous_depth"),
    *("ids", "direct", "emission", "reflectance"),
})  # fmt: skip
"""The buffers that show the wall and the square; all others are random values of their kind."""


class Inputs(NamedTuple):
    """The inputs of denoisers and operations."""

    clip: Clip
    logits: np.ndarray
    """[H, W, 25] of predicted kernels."""
    blend: np.ndarray
    """[H / 2, W / 2, 1] of a composition, before the sigmoid; rounded up where the size is odd."""
    mask: np.ndarray
    """[T, H, W, 1] in {0, 1}: the pixels of a metric or of the occlusion loss."""


def good(seed: int = 0, *, frames: int = FRAMES, height: int = HEIGHT, width: int = WIDTH) -> Inputs:
    """A wall, and a square that moves over it by 1.5 px a frame: noisy, valid, with every buffer.

    The buffers that are not :data:`BY_HAND` have random values that are valid for their kind.
    """
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    wall = 0.4 + 0.2 * np.sin(columns / 3) * np.cos(rows / 4)

    def square(t: float) -> np.ndarray:
        left = 4 + 1.5 * t
        return (columns >= left) & (columns < left + 7) & (rows >= 4) & (rows < 11)

    shape = (frames, height, width)
    inside = np.stack([square(t) for t in range(frames)])[..., None]
    before = np.stack([square(t - 1) for t in range(frames)])[..., None]
    reference = np.where(inside, [0.2, 0.5, 0.9], wall[None, ..., None] * [1.0, 0.8, 0.6]).astype(np.float32)
    motion = np.where(inside, [-1.5, 0.0], 0.0).astype(np.float32)
    normal = np.where(inside, [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]).astype(np.float32)
    by_hand = {
        "radiance": (reference * rng.exponential(size=(*shape, 1))).astype(np.float32),
        "albedo": np.where(inside, [0.3, 0.6, 0.9], 0.7).astype(np.float32),
        "reflectance": np.where(inside, [0.4, 0.65, 0.9], 0.72).astype(np.float32),
        "normal": normal,
        "depth": np.where(inside, 2.0, 5.0 + columns[None, ..., None] / 50).astype(np.float32),
        "roughness": np.where(inside, 0.3, 1.0).astype(np.float32),
        "motion": motion,
        "dual_motion": np.where(before & ~inside, [1.5, 0.0], motion).astype(np.float32),
        "visible": inside | ~before,
        "previous_depth": np.where(inside, 2.0, 5.0 + columns[None, ..., None] / 50).astype(np.float32),
        "ids": np.where(inside, 1, 0).astype(np.int32),
        "direct": (0.1 * reference).astype(np.float32),
        "emission": np.zeros((*shape, 3), np.float32),
    }
    drawn = {name: _drawn(name, buffer, shape, seed) for name, buffer in BUFFERS.items() if name not in BY_HAND}
    logits = rng.standard_normal((height, width, 25)).astype(np.float32)
    blend = rng.standard_normal((-(-height // 2), -(-width // 2), 1)).astype(np.float32)
    mask = np.broadcast_to((rows + columns)[None, ..., None] % 4 < 3, (*shape, 1)).astype(np.float32)
    return Inputs(Clip(Frame(**by_hand, **drawn), reference), logits, blend, mask)


def _drawn(name: str, buffer: Buffer, shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Valid random values [*shape, C], which depend only on the buffer."""
    rng = np.random.default_rng([seed, *name.encode()])
    shape = (*shape, buffer.channels)
    match buffer.kind:
        case "light":
            values = rng.exponential(0.3, shape)
        case "signed" | "vector":
            values = rng.normal(0.0, 1.0, shape)
        case "fraction":
            values = rng.uniform(0.0, 1.0, shape)
        case "direction":
            values = rng.normal(0.0, 1.0, shape)
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        case "distance":
            values = rng.uniform(1.0, 9.0, shape)
        case "count" | "id":
            values = rng.integers(1, 9, shape)
        case "flag":
            values = rng.random(shape) < 0.9
    return values.astype(buffer.dtype)


def replaced(inputs: Inputs, **buffers: Any) -> Inputs:
    """The same inputs with other buffers in their frames."""
    frames = {name: np.asarray(buffer) for name, buffer in buffers.items()}
    return inputs._replace(clip=inputs.clip._replace(frames=inputs.clip.frames._replace(**frames)))


def filled(inputs: Inputs, name: str, value: Any) -> Inputs:
    """One value in every pixel of a buffer."""
    buffer = getattr(inputs.clip.frames, name)
    return replaced(inputs, **{name: np.full_like(buffer, value)})


def dotted(inputs: Inputs, name: str, value: Any, *, every: int = 7) -> Inputs:
    """One value in every seventh pixel of a buffer."""
    buffer = np.array(getattr(inputs.clip.frames, name))
    buffer.reshape(-1, buffer.shape[-1])[::every] = value
    return replaced(inputs, **{name: buffer})
