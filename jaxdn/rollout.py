"""A clip is a scan over frames: the one loop that inference and training share."""

from typing import Any

import jax
from jax import lax

from jaxdn.checks import check_image
from jaxdn.frame import Clip, Denoiser, Frame, frame_at, only


def unroll(denoiser: Denoiser, params: Any, frames: Frame, *, rematerialize: bool = False) -> jax.Array:
    """Denoise consecutive frames ``[T, H, W, C]`` with one recurrent state; returns images ``[T, H, W, 3]``.

    ``start`` sees the first frame once, then ``step`` is scanned over all T frames. With ``rematerialize`` the backward
    pass recomputes each step from its carried state, so that memory grows by one frame's state per frame and not by one
    network's activations (about a quarter of the memory for 1.1 to 1.4 times the time; Chen et al. 2016).
    """
    frames = only(frames, denoiser.reads)

    def step(state: Any, frame: Frame) -> tuple[Any, jax.Array]:
        return denoiser.step(params, state, frame)

    body = jax.checkpoint(step, prevent_cse=False) if rematerialize else step
    _, images = lax.scan(body, denoiser.start(params, frame_at(frames, 0)), frames)
    return images


def denoise(denoiser: Denoiser, params: Any, clip: Clip) -> jax.Array:
    """Denoise a clip; returns linear radiance ``[T, H, W, 3]``, >= 0.

    ``clip.frames`` are T frames of linear radiance with whatever other buffers the renderer gave; those that
    ``denoiser.reads`` does not name are left out of the program. Pure and not jitted: wrap it in ``jax.jit`` with the
    denoiser closed over. Raises ValueError when the radiance is not ``[T, H, W, 3]`` or a buffer's size differs.
    """
    radiance = clip.frames.radiance
    check_image(radiance, "clip.frames.radiance", channels=3, rank=4)
    for name, buffer in clip.frames._asdict().items():
        if buffer is not None and buffer.shape[:3] != radiance.shape[:3]:
            raise ValueError(
                f"clip.frames.{name}: expected [T, H, W] = {radiance.shape[:3]} as the radiance has, "
                f"got {buffer.shape[:3]}; crop or resample it."
            )
    return unroll(denoiser, params, clip.frames)
