"""Values of another renderer's guides that mean nothing: replaced, counted, and told in words.

Fractions are clamped to [0, 1]; a distance that is NaN counts as far away.
"""

from collections.abc import Iterable

import numpy as np

from jaxdn.core.frame import BUFFERS
from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.layers import NOT_WANTED, advise_naming
from jaxdn.data.foreign.lighting import SLACK

FRACTIONS = ("albedo", "roughness", "specular_reflectance")
"""Buffers whose values lie in [0, 1]."""
_MANY = 0.1
"""Share of the pixels; so many odd values are no odd pixels: the layer holds something else."""


class Repairs:
    """What is replaced in the frames of a shot."""

    def __init__(self) -> None:
        self._pixels: dict[str, int] = {}
        self._frames: dict[str, int] = {}
        self._sound: set[str] = set()
        self._news: list[str] = []

    def clamp(self, name: str, layer: str, values: np.ndarray) -> np.ndarray:
        """Values [H, W, C] in [0, 1]; NaN stays. What a pixel filter overshoots at edges is cut off without a word.

        Blender's denoising albedo holds the light of a lamp where the camera sees one: such an albedo is 1. Raises
        ClipError where many values of roughness or reflectance are beyond, and no earlier frame was sound: they are of
        another kind.
        """
        known = np.isfinite(values)
        if known.all() and values.min(initial=0) >= 0 and values.max(initial=0) <= 1:
            self._sound.add(name)
            return values
        odd = np.any((values < -SLACK) | (values > 1 + SLACK), axis=-1) & known.any(axis=-1)
        count = int(odd.sum())
        if name != "albedo" and name not in self._sound and count > _MANY * odd.size:
            raise ClipError(_explain_wrong(name, layer, values[known]))
        if count:
            self._count(name, layer, count, values[known])
        else:
            self._sound.add(name)
        return np.clip(values, 0.0, 1.0)

    def replace_nan(self, name: str, layer: str, values: np.ndarray) -> np.ndarray:
        """Distances [H, W, 1] with infinity, which is far away, in place of NaN."""
        odd = np.isnan(values)
        if count := int(odd.sum()):
            if name not in self._frames:
                self._news.append(f"{name}: {_pixels(count)} of {layer!r} NaN: taken as far away")
            self._add(name, count)
            values = np.where(odd, np.inf, values)
        return values

    def restart(self) -> None:
        """Count anew: the same frames are read once more. What has been told is not told again."""
        self._pixels = dict.fromkeys(self._pixels, 0)
        self._frames = dict.fromkeys(self._frames, 0)

    def news(self) -> list[str]:
        """What has been replaced for the first time since this was asked for, as lines."""
        news, self._news = self._news, []
        return news

    def totals(self) -> Iterable[str]:
        """How much was replaced in all frames, as lines, of buffers where that is more than in the first one."""
        for name, frames in self._frames.items():
            if frames > 1:
                distance = name in BUFFERS and BUFFERS[name].kind == "distance"
                what = "NaN, taken as far away" if distance else "clamped to [0, 1]"
                yield f"{name}: {self._pixels[name]} pixels of {frames} frames were {what}"

    def _count(self, name: str, layer: str, count: int, known: np.ndarray) -> None:
        if name not in self._frames:
            pixels = _pixels(count)
            low, high = known.min(initial=0), known.max(initial=1)
            if name == "albedo" and low >= -SLACK:
                what = f"{pixels} of {layer!r} above 1, up to {high:g}: the light of a lamp, taken as 1"
            else:
                worst = high if high - 1 > -low else low
                what = f"{pixels} of {layer!r} beyond [0, 1], such as {worst:g}: clamped"
            self._news.append(f"{name}: {what}")
        self._add(name, count)

    def _add(self, name: str, count: int) -> None:
        self._pixels[name] = self._pixels.get(name, 0) + count
        self._frames[name] = self._frames.get(name, 0) + 1


def _pixels(count: int) -> str:
    return f"{count} pixel{'s' * (count != 1)}"


def _explain_wrong(name: str, layer: str, known: np.ndarray) -> str:
    """What is wrong with values of another kind, and what to do."""
    advice = "rename it if it is something else"
    if name in BUFFERS:
        advice = f"{advise_naming(name)}, or leave it out: --channels {name}={NOT_WANTED}"
    return f"{name}: expected values in [0, 1] in layer {layer!r}, got {known.min():g} to {known.max():g}; {advice}."
