"""Denoised frames as files: new ones for our clips, copies of the source with another beauty for other renderers."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn import color
from jaxdn.core.frame import Frame
from jaxdn.data.exr.exr import write_exr
from jaxdn.data.exr.file import ExrFile, Window
from jaxdn.data.foreign.layers import find_alpha
from jaxdn.data.foreign.result import NewPixels, replace_channels, write_result
from jaxdn.data.foreign.views import ViewFile
from jaxdn.evaluation.report.images import save_png
from jaxdn.sequence.additive_aovs import AdditiveAovs
from jaxdn.sequence.alpha import AlphaDenoiser
from jaxdn.sequence.frame_denoiser import light_of
from jaxdn.sequence.optics import CameraBlur
from jaxdn.sequence.panorama import Panorama
from jaxdn.sequence.settings import Settings

Write = Callable[[], Sequence[str]]
"""Writes a file, in any thread; returns lines for the user about what could not be kept."""


class ClipWriter:
    """Writes frames of our clips."""

    has_history = False
    """Whether frames that are not wanted change those after them."""

    def __init__(self, settings: Settings) -> None:
        self._preview = settings.preview

    def prepare(self, target: Path | None, source: ExrFile | None, frame: Frame, image: np.ndarray) -> Write | None:
        """What writes the denoised image [H, W, 3] of a frame; None without a target."""
        return None if target is None else partial(self._write, target, frame, image)

    def _write(self, target: Path, frame: Frame, image: np.ndarray) -> Sequence[str]:
        beauty = compose_beauty(frame, image)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_exr(target, name_channels("", beauty) | name_channels("denoised.", image))
        if self._preview:
            write_preview(target, beauty)
        return ()


class ForeignWriter:
    """Writes frames of another renderer, with their additive layers and alpha denoised where the settings say so."""

    def __init__(
        self,
        window: Window,
        settings: Settings,
        log: Callable[[str], None],
        result: "SharedResult | None" = None,
        panorama: Panorama | None = None,
    ) -> None:
        """``result``: of a view among several, what is written with the others; ``panorama``: frames are widened."""
        self._window, self._settings, self._log = window, settings, log
        self.has_history = settings.aovs == "additive" or settings.alpha
        self._aovs = AdditiveAovs(settings.naming, log) if settings.aovs == "additive" else None
        self._alpha = AlphaDenoiser(safe=settings.safe) if settings.alpha else None
        self._blur = (
            None if settings.reblur is None else CameraBlur(settings.reblur, log, settings.naming, wraps=settings.wrap)
        )
        self._result, self._panorama = result, panorama

    def prepare(self, target: Path | None, source: ExrFile | None, frame: Frame, image: np.ndarray) -> Write | None:
        """Denoise the additive layers of a frame; what writes all, and then drops the source's pixels.

        None: without a target they are for the history alone.
        """
        assert source is not None
        layers = {} if self._aovs is None else self._aovs.denoise(self._place(source), frame, image, source.beside)
        alpha = self._denoise_alpha(source, frame, image)
        if target is None:
            source.drop()
            return None
        beauty = compose_beauty(frame, image)
        if self._blur is not None:
            beauty, alpha, layers = self._reblur(self._blur, source, frame, beauty, alpha, layers)
        if self._panorama is not None:
            beauty, alpha = self._panorama.cut(beauty), None if alpha is None else self._panorama.cut(alpha)
            layers = {name: self._panorama.cut(layer) for name, layer in layers.items()}
        return partial(self._write, target, source, {"": beauty, **layers}, alpha)

    def _write(
        self, target: Path, source: ExrFile, images: Mapping[str, np.ndarray], alpha: np.ndarray | None
    ) -> Sequence[str]:
        target.parent.mkdir(parents=True, exist_ok=True)
        settings = self._settings
        own = replace_channels(source, images, self._window, settings.naming, alpha=alpha)
        new: NewPixels | None = own
        preview = target
        if self._result is not None and isinstance(source, ViewFile):
            new, preview = self._result.join(source.view, own), target.with_name(f"{target.stem}.{source.view}.exr")
        if settings.preview:
            write_preview(preview, images[""])
        notes = [] if new is None else write_result(source, target, new, only_beauty=settings.only_beauty)
        source.drop()
        return notes

    def _denoise_alpha(self, source: ExrFile, frame: Frame, image: np.ndarray) -> np.ndarray | None:
        """The denoised alpha [H, W] of a frame; None: nobody asked, or there is none."""
        if self._alpha is None:
            return None
        noisy = self._read_alpha(source)
        if noisy is None:
            self._log("--alpha: there is no alpha beside the beauty")
            return None
        return self._alpha.denoise(noisy, frame, compose_beauty(frame, image))

    def _read_alpha(self, source: ExrFile) -> np.ndarray | None:
        """The alpha [H, W] beside the beauty of a frame, if there is one; 0 where it is not finite."""
        names = list(source.windows)
        channel = find_alpha(names, self._settings.naming.detect(names)["radiance"])
        if channel is None:
            return None
        alpha = self._place(source)[channel]
        return np.where(np.isfinite(alpha), alpha, 0)

    def _reblur(
        self,
        camera: CameraBlur,
        source: ExrFile,
        frame: Frame,
        beauty: np.ndarray,
        alpha: np.ndarray | None,
        layers: Mapping[str, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray | None, dict[str, np.ndarray]]:
        """Beauty, alpha and layers as the camera sees them; the alpha of the file where it is not denoised."""
        alpha = self._read_alpha(source) if alpha is None else alpha
        beside = {} if alpha is None else {" alpha": alpha[..., None]}  # no layer's name begins with a space
        blurred = camera.blur(source, frame, {"": np.asarray(beauty), **layers, **beside})
        covered = blurred.pop(" alpha", None)
        return blurred.pop(""), None if covered is None else covered[..., 0], blurred

    def _place(self, source: ExrFile) -> Mapping[str, np.ndarray]:
        """The channels of a file as frames have them."""
        placed = source.placed(self._window)
        return placed if self._panorama is None else self._panorama.widen_channels(placed)


class SharedResult:
    """The views of one file, which come one after the other, frame by frame."""

    def __init__(self, views: Sequence[str]) -> None:
        self._views = tuple(views)
        self._joined: NewPixels | None = None

    def join(self, view: str, new: NewPixels) -> NewPixels | None:
        """What is new in all views of a frame; None until the last one has come."""
        joined = None if view == self._views[0] else self._joined
        self._joined = new if joined is None else joined.with_view(view, new)
        return self._joined if view == self._views[-1] else None


def compose_beauty(frame: Frame, image: np.ndarray) -> Any:
    """The denoised image [H, W, 3] with the frame's direct and emitted light added back."""
    return image + light_of(frame.direct) + light_of(frame.emission)


def name_channels(prefix: str, image: np.ndarray) -> dict[str, np.ndarray]:
    """An image [H, W, 3] as the channels ``R``, ``G``, ``B`` of a file, with a prefix."""
    return {f"{prefix}{letter}": np.ascontiguousarray(image[..., i], np.float32) for i, letter in enumerate("RGB")}


def write_preview(target: Path, image: Any) -> None:
    """Write a linear image [H, W, 3], tone-mapped, as a PNG next to the file ``target``."""
    save_png(target.with_suffix(".png"), color.tonemap(image))
