"""Which convention motion vectors have, measured: the one that brings two frames onto each other."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.data.foreign.layers import Channels, stack_channels
from jaxdn.data.foreign.vectors import MOTION_CONVENTIONS, convert_motion
from jaxdn.ops.motion import on_screen
from jaxdn.ops.warp import warp

_MOVES = 0.5
"""Pixels; shorter vectors tell nothing."""
_CLEAR = 0.6
"""A convention fits if it leaves less than this share of the difference that there is without motion ..."""
_TIE = 1.1
"""... and no more than this times what the best one leaves."""

_warp = jax.jit(warp)


def fitting_conventions(
    before: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray], buffers: Mapping[str, Channels]
) -> list[str]:
    """The conventions that fit two consecutive frames, best first; several where they mean the same here.

    The frame before is warped by the vectors as each convention has them, and compared with this one in what has no
    noise: albedo and normals, else the radiance itself. Empty where nothing moves or no convention fits clearly.

    Args:
      before: every channel of the frame before.
      now: every channel of this frame.
      buffers: buffer -> channels, with the motion.
    """
    names = [name for name in ("albedo", "normal") if name in buffers] or ["radiance"]
    first, second = (
        np.concatenate([_image(pixels, buffers[name]) for name in names], axis=-1) for pixels in (before, now)
    )
    vectors = _image(now, buffers["motion"])
    moves = np.isfinite(vectors).all(-1) & (np.abs(vectors).max(-1) > 0)
    left: dict[str, float] = {}
    for name in MOTION_CONVENTIONS:
        motion = convert_motion(np.where(moves[..., None], vectors, 0), name)
        known = moves & np.asarray(on_screen(jnp.asarray(motion)))[..., 0] & (np.abs(motion).max(-1) > _MOVES)
        if known.sum() < max(16, moves.sum() / 4):  # a few pixels fit by chance
            continue
        still = np.abs(first - second)[known].mean()
        if still > 0:
            left[name] = float(np.abs(np.asarray(_warp(first, motion)) - second)[known].mean() / still)
    best = min(left.values(), default=1.0)
    return sorted((name for name in left if left[name] <= min(_CLEAR, _TIE * best + 1e-3)), key=lambda name: left[name])


def _image(pixels: Mapping[str, np.ndarray], channels: Channels) -> np.ndarray:
    image = stack_channels(pixels, channels).astype(np.float32)
    return np.clip(np.nan_to_num(image), -1e4, 1e4)
