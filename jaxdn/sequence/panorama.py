"""Equirectangular panoramas: the left edge continues at the right one, for filters and for what moves across.

A frame is widened by columns of the other side, denoised as any other, and cut again. The margin is as wide as what
decides about a pixel, so that the pixels beside the seam see what any others see. Motion over the seam may be counted
the long way round, with about the width W of the picture; ``x - W round(x / W)`` is the short way.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from jaxdn.core.frame import BUFFERS, GUIDES, Frame
from jaxdn.data.exr.file import ExrFile, Window
from jaxdn.denoiser.tiles import GRID

_USUAL = 128
"""Pixels of the margin for a method that does not say what decides about a pixel."""
_MOST = 256


class Panorama:
    """Frames that are widened and cut."""

    def __init__(self, receptive_field: int | None) -> None:
        """``receptive_field``: so many pixels around a pixel decide about it; None: unknown."""
        wanted = _USUAL if receptive_field is None else min(receptive_field + 1, _MOST)
        self.margin = -(-wanted // GRID) * GRID  # blocks of pixels stay the same blocks

    def widen(self, image: np.ndarray) -> np.ndarray:
        """[H, W, ...] -> [H, margin + W + margin, ...]."""
        return np.pad(image, [(0, 0), (self.margin, self.margin)] + [(0, 0)] * (image.ndim - 2), mode="wrap")

    def widen_frame(self, frame: Frame) -> Frame:
        """A frame of NumPy arrays with all of its buffers widened, and its vectors the short way round."""
        wide: dict[str, Any] = {"radiance": self.widen(np.asarray(frame.radiance))}
        for name in GUIDES:
            if (buffer := getattr(frame, name)) is not None:
                wide[name] = self.widen(_shorten(buffer) if BUFFERS[name].kind == "vector" else buffer)
        return Frame(**wide)

    def widen_channels(self, channels: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """The channels [H, W] of a file, each widened when it is looked up."""
        return _Widened(self, channels)

    def cut(self, image: np.ndarray) -> np.ndarray:
        """[H, margin + W + margin, ...] -> [H, W, ...]."""
        return image[:, self.margin : image.shape[1] - self.margin]


class _Widened(Mapping[str, np.ndarray]):
    def __init__(self, panorama: Panorama, channels: Mapping[str, np.ndarray]) -> None:
        self._panorama, self._channels = panorama, channels

    def __getitem__(self, name: str) -> np.ndarray:
        return self._panorama.widen(self._channels[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._channels)

    def __len__(self) -> int:
        return len(self._channels)


def find_panorama(
    file: ExrFile, window: Window, receptive_field: int | None, *, stated: bool, log: Callable[[str], None]
) -> Panorama | None:
    """How frames wrap whose first file and window are given; None where they do not.

    They do by the attribute of the file, or as ``stated``, unless the window is not as wide as the picture: then its
    edges are no neighbours, and ``log`` is called with a line.
    """
    if not stated and not file.is_panorama:
        return None
    display = file.display
    if (window.left, window.right) != (display.left, display.right):
        columns = f"columns {window.left} to {window.right} of {display.left} to {display.right}"
        log(f"the left edge does not continue at the right one, as the files have {columns}")
        return None
    log("a panorama: the left edge continues at the right one")
    return Panorama(receptive_field)


def _shorten(vectors: np.ndarray) -> np.ndarray:
    """Vectors [H, W, 2] that go less than half around."""
    width = vectors.shape[1]
    turns = np.round(np.where(np.isfinite(vectors[..., :1]), vectors[..., :1], 0) / width)
    return vectors - np.concatenate([turns, 0 * turns], axis=-1).astype(vectors.dtype) * width
