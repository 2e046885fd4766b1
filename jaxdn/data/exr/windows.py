"""Data and display windows: which pixels of the picture a file, or a part of it, has.

A renderer may store less than the picture (a region, a cropped bounding box that differs from frame to frame) or more
(overscan). All frames of a sequence are placed into the union of their data windows, so that motion vectors mean the
same in each of them.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np


class Window(NamedTuple):
    """A rectangle of pixels; its ends count, as in OpenEXR."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top + 1, self.right - self.left + 1

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """As an attribute of a header."""
        return np.array([self.left, self.top], np.int32), np.array([self.right, self.bottom], np.int32)


def window_of(header: Mapping[str, Any], name: str) -> Window:
    """The ``dataWindow`` or ``displayWindow`` of a header."""
    low, high = header[name]
    return Window(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def union_of(windows: Iterable[Window]) -> Window:
    """The smallest window that has all of them in it."""
    left, top, right, bottom = zip(*windows, strict=True)
    return Window(min(left), min(top), max(right), max(bottom))


def place(pixels: np.ndarray, window: Window, union: Window) -> np.ndarray:
    """Pixels [H, W, ...] of a window as an image of a union that contains it; 0 elsewhere.

    The pixels themselves where the window is the union.
    """
    if window == union:
        return pixels
    image = np.zeros((*union.size, *pixels.shape[2:]), pixels.dtype)
    image[_inside(window, union)] = pixels
    return image


def crop(image: np.ndarray, union: Window, window: Window) -> np.ndarray:
    """The pixels of a window that lies in the union, from an image of the union."""
    return image[_inside(window, union)]


def _inside(window: Window, union: Window) -> tuple[slice, slice]:
    height, width = window.size
    top, left = window.top - union.top, window.left - union.left
    return slice(top, top + height), slice(left, left + width)
