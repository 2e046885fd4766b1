"""The additive layers of other renderers' files, denoised with the beauty (``jaxdn denoise --aovs additive``)."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.data.exr.windows import Window
from jaxdn.data.foreign.import_exr import read_placed
from jaxdn.data.foreign.layers import Channels, beauty, detect_channels
from jaxdn.data.foreign.lighting import copies_of, parts_of
from jaxdn.sequence.aov_shares import Shares, share, start_shares


class Aovs:
    """The additive layers of consecutive frames. Which layers these are is decided in the first frame, and told."""

    def __init__(self, canvas: Window, naming: Mapping[str, Any], log: Callable[[str], None]) -> None:
        """``naming``: ``channels`` and ``layer`` of :func:`jaxdn.data.foreign.layers.detect_channels`."""
        self._canvas, self._naming, self._log = canvas, naming, log
        self._parts: dict[str, Channels] | None = None
        self._state: Shares | None = None

    def denoise(self, file: Path, frame: Frame, image: np.ndarray) -> dict[str, np.ndarray]:
        """Layer -> denoised image [H, W, 3], of a frame and its denoised beauty; empty without additive layers."""
        there = read_placed(file, self._canvas)
        if self._parts is None:
            found = detect_channels(list(there), **self._naming)
            self._parts = parts_of(there, beauty(list(there), found), found)
            copies = copies_of(there, found["radiance"], self._parts)
            self._log(_told(self._parts, copies, there, found["radiance"]))
        if not self._parts:
            return {}
        noisy = np.stack([_stack(there, channels) for channels in self._parts.values()])
        state = start_shares(frame, len(noisy)) if self._state is None else self._state
        # Without what the shares do not read, a step is compiled once for all denoisers.
        guides = Frame(frame.radiance, depth=frame.depth, normal=frame.normal, ids=frame.ids, motion=frame.motion)
        self._state, images = share(state, guides, image, noisy)
        return dict(zip(self._parts, np.asarray(images), strict=True))


def _told(
    parts: Mapping[str, Channels], copies: Collection[str], there: Mapping[str, np.ndarray], radiance: Channels
) -> str:
    added = [layer for layer in parts if layer not in copies]
    again = f"{', '.join(sorted(copies))} (the beauty once more)"
    if not added:
        told = "--aovs additive: no layer is a part of the beauty; all stay as they are"
        return f"{told}, but {again}" if copies else told
    whole = np.nansum(_stack(there, radiance))
    total = sum(np.nansum(_stack(there, parts[layer])) for layer in added)
    told = f"denoised with the beauty: {', '.join(added)}; together they have {total / whole:.2f} of its light"
    return f"{told}; and {again}" if copies else told


def _stack(there: Mapping[str, np.ndarray], channels: Channels) -> np.ndarray:
    return np.stack([there[channel] for channel in channels], axis=-1).astype(np.float32)
