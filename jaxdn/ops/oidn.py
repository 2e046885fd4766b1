"""Binding of Open Image Denoise, a library of networks that denoise single images, by the package ``pyoidn``.

On a CPU the library reads and writes the arrays of each call; on a GPU they are copied to buffers of its own and back.
Building a network takes longer than running it, so the last few are kept.

Attila T. Áfra, "Intel Open Image Denoise", 2019-2025, https://www.openimagedenoise.org.
"""

import functools
import importlib.util
import threading
import weakref
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxdn.runtime.cores import count_cores
from jaxdn.runtime.optional import install

MODULE = "pyoidn"
_FIELD, _LARGE_FIELD = 96, 112
"""Radius in pixels of what a network sees, and of the larger ones that the library takes for guides without noise, and
to denoise guides, in its quality ``"high"``: 91 and 103 pixels are the farthest measured."""

_SCRATCH, _LEAST_SCRATCH = 450, 100
"""Bytes a pixel, and megabytes at least, that the larger networks compute in: as much as the others need. They take the
image in parts for it, with the same result."""

Quality = Literal["high", "balanced", "fast"]
Auxiliary = Literal["noisy", "clean", "prefiltered"]
Device = Literal["auto", "cpu", "cuda"]


class OidnSettings(NamedTuple):
    """How an image is denoised."""

    quality: Quality = "high"
    hdr: bool = True
    """Radiance may exceed 1; otherwise it is in [0, 1], encoded with the sRGB curve."""
    auxiliary: Auxiliary = "noisy"
    """What is known of albedo and normal: they may be noisy, they have no noise, or the library denoises them first."""
    device: Device = "auto"
    """``"auto"`` is an NVIDIA GPU if the library can use one, else the CPU."""
    guide_quality: Quality | None = None
    """How prefiltered guides are denoised; None: as the image."""

    @property
    def receptive_field(self) -> int:
        """How far, in pixels, a pixel of the image sees."""
        high = self.quality == "high" and self.auxiliary != "noisy"
        guides = _LARGE_FIELD if (self.guide_quality or self.quality) == "high" else _FIELD
        return (_LARGE_FIELD if high else _FIELD) + (guides if self.auxiliary == "prefiltered" else 0)


def available() -> bool:
    """Whether the package is installed."""
    return importlib.util.find_spec(MODULE) is not None


def library() -> Any:
    """The package. Raises ModuleNotFoundError, saying what to install, where it is missing."""
    try:
        import pyoidn
    except ModuleNotFoundError as error:
        if error.name != MODULE:
            raise
        raise ModuleNotFoundError(
            f"oidn: expected the package {MODULE} (Open Image Denoise), which is not installed: {install('oidn')}",
            name=MODULE,
        ) from error
    return pyoidn


def choose_device(device: Device) -> Literal["cpu", "cuda"]:
    """The device that ``"auto"`` stands for here; any other name is that one."""
    if device != "auto":
        return device
    return "cuda" if library().Device.is_cuda_available(0) else "cpu"


def denoise(
    color: np.ndarray,
    albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    *,
    settings: OidnSettings = OidnSettings(),  # noqa: B008, immutable
    scale: float = float("nan"),
    out: np.ndarray | None = None,
) -> np.ndarray:
    """The denoised image [H, W, 3] float32 of one frame.

    Args:
      color: [H, W, 3] linear radiance >= 0, or what :attr:`OidnSettings.hdr` says.
      albedo: [H, W, 3] in [0, 1]; None: the network for images without guides, or without this one.
      normal: [H, W, 3] in [-1, 1], of any space; needs an albedo.
      settings: see :class:`OidnSettings`.
      scale: the factor that makes radiance as bright as a photograph; NaN: the library measures it
        (as :func:`jaxdn.color.exposure`).
      out: [H, W, 3] float32, contiguous: the array to fill and to return; None: a new one.

    Raises ModuleNotFoundError without the package, ValueError for images of different sizes, and RuntimeError with the
    library's own message where it fails.
    """
    guides = {name: image for name, image in (("albedo", albedo), ("normal", normal)) if image is not None}
    height, width = np.shape(color)[:2]
    for name, image in {"color": color, **guides}.items():
        if np.shape(image) != (height, width, 3):
            raise ValueError(f"{name}: expected {(height, width, 3)} as the colour, got {np.shape(image)}.")
    settings = settings._replace(device=choose_device(settings.device))
    kernel_of = functools.partial(_kernel, height, width, settings)
    if settings.auxiliary == "prefiltered":
        careful = settings._replace(quality=settings.guide_quality or settings.quality)
        guides = {name: _kernel(height, width, careful, (name,))({name: image}) for name, image in guides.items()}
    return kernel_of(("color", *guides))({"color": color, **guides}, scale, out)


class _Kernel:
    """One network of the library for images of one size, on a GPU with its buffers. Its calls take turns."""

    def __init__(self, height: int, width: int, settings: OidnSettings, inputs: tuple[str, ...]) -> None:
        oidn = library()
        self._shape = (height, width, 3)
        self._lock = threading.Lock()
        self._device = _open_device(settings.device, count_cores())
        names = () if settings.device == "cpu" else (*inputs, "output")
        self._buffers = {name: oidn.Buffer(self._device, height * width * 12) for name in names}
        self._filter = oidn.Filter(self._device, oidn.OIDN_FILTER_TYPE_RT)
        self._format = oidn.OIDN_FORMAT_FLOAT3
        self._place(self._buffers)
        qualities = {
            "high": oidn.OIDN_QUALITY_HIGH,
            "balanced": oidn.OIDN_QUALITY_BALANCED,
            "fast": oidn.OIDN_QUALITY_FAST,
        }
        self._filter.set_quality(qualities[settings.quality])
        self._has_color = "color" in inputs
        if self._has_color:
            self._filter.set_bool("hdr", settings.hdr)
            self._filter.set_bool("cleanAux", settings.auxiliary != "noisy" and len(inputs) > 1)
        if settings.auxiliary != "noisy":
            self._filter.set_int("maxMemoryMB", max(_LEAST_SCRATCH, _SCRATCH * height * width // 2**20))
        weakref.finalize(self, _release, (self._filter, *self._buffers.values()))
        self._check()  # one that lacks a buffer must not be kept

    def __call__(
        self, images: dict[str, np.ndarray], scale: float = float("nan"), out: np.ndarray | None = None
    ) -> np.ndarray:
        output = np.empty(self._shape, np.float32) if out is None else out
        given = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
        with self._lock:
            if not self._buffers:
                self._place({**given, "output": output})
            for name in self._buffers.keys() & given.keys():
                self._buffers[name].write(0, output.nbytes, given[name])
            if self._has_color:
                self._filter.set_float("inputScale", scale)
            self._filter.commit()  # the network is built the first time; other arrays of the same size take no time
            self._filter.execute()
            if self._buffers:
                self._buffers["output"].read(0, output.nbytes, output)
            self._check()
        return output

    def _place(self, images: Mapping[str, Any]) -> None:
        """Let the library use buffers or arrays, by name."""
        height, width = self._shape[:2]
        for name, image in images.items():
            self._filter.set_image(name, image, self._format, width, height)

    def _check(self) -> None:
        _check(self._device)


@functools.cache
def _open_device(kind: str, cores: int) -> Any:
    """The library's device for all networks: they use the same scratch memory, one after the other."""
    oidn = library()
    device = oidn.Device({"cpu": oidn.OIDN_DEVICE_TYPE_CPU, "cuda": oidn.OIDN_DEVICE_TYPE_CUDA}[kind])
    if kind == "cpu":
        device.set_int("numThreads", cores)
    device.commit()
    _check(device)
    return device


def _check(device: Any) -> None:
    error = device.get_error()
    if error is not None:
        raise RuntimeError(f"Open Image Denoise: {error}")


_kernel = functools.lru_cache(maxsize=4)(_Kernel)
"""The last networks: of a frame, or a tile, and of its guides."""


def _release(handles: tuple[Any, ...]) -> None:
    for handle in handles:
        handle.release()
