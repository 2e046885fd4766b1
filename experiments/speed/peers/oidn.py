"""Open Image Denoise on the CPU, as a peer for time and quality: one image, not temporal."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pyoidn

from jaxdn.core.frame import Frame, written_out
from jaxdn.denoiser import Denoiser, Params, State

QUALITIES = {
    "high": pyoidn.OIDN_QUALITY_HIGH,
    "balanced": pyoidn.OIDN_QUALITY_BALANCED,
    "fast": pyoidn.OIDN_QUALITY_FAST,
}

Filter = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def oidn(height: int, width: int, *, quality: str = "high", threads: int | None = None) -> Filter:
    """A filter ``(image, albedo, normal) -> denoised image``, all [H, W, 3] float32 of this size, linear HDR radiance.

    Albedo in [0, 1], normals in [-1, 1], both possibly noisy. The next call overwrites the result. ``threads``: by
    default the machine's cores. The network is built once, here; a call copies its arguments into the filter's own
    images and runs it. Raises ValueError for an unknown quality or another size, and RuntimeError with the library's
    message if it fails.
    """
    if quality not in QUALITIES:
        raise ValueError(f"quality: expected one of {', '.join(QUALITIES)}, got {quality!r}.")
    shape = (height, width, 3)
    images = {name: np.zeros(shape, np.float32) for name in ("color", "albedo", "normal", "output")}
    device = pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CPU)
    device.set_int("numThreads", threads or os.cpu_count() or 1)
    device.commit()
    kernel = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
    for name, image in images.items():
        kernel.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
    kernel.set_bool("hdr", True)
    kernel.set_quality(QUALITIES[quality])
    kernel.commit()
    _check(device)

    def denoise(image: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
        for name, array in (("color", image), ("albedo", albedo), ("normal", normal)):
            if np.shape(array) != shape:
                raise ValueError(f"{name}: expected {shape} as the filter was built for, got {np.shape(array)}.")
            np.copyto(images[name], array)
        kernel.execute()
        _check(device)
        return images["output"]

    return denoise


def _check(device: pyoidn.Device) -> None:
    error = device.get_error()
    if error is not None:
        raise RuntimeError(f"Open Image Denoise: {error}")


def frame_by_frame(quality: str = "high") -> Denoiser:
    """Open Image Denoise with the denoiser interface, without a history, so that comparisons can run it.

    Reads albedo and normals; a missing one is its neutral value. The image stays on the CPU.
    """

    def start(params: Params, frame: Frame) -> tuple[()]:
        return ()

    def step(params: Params, state: State, frame: Frame) -> tuple[State, jax.Array]:
        whole = written_out(frame, ("albedo", "normal"))
        height, width = frame.radiance.shape[:2]
        run = oidn(height, width, quality=quality)

        def filtered(*images: jax.Array) -> np.ndarray:
            return run(*(np.asarray(image, np.float32) for image in images)).copy()

        like = jax.ShapeDtypeStruct((height, width, 3), jnp.float32)
        return state, jax.pure_callback(filtered, like, whole.radiance, whole.albedo, whole.normal)

    return Denoiser(lambda key, frame: {}, start, step, frozenset({"albedo", "normal"}))
