"""Sub-pixel jitter: every frame is seen through another point of its pixels, so that a history holds whole pixels.

The guides and the noisy layers of a frame share its offset; motion vectors do not know it, so that a camera at rest has
none; the reference is the mean over the pixel. What is needed is the sensor's principal point alone.
"""

from typing import Any

import mitsuba as mi

PERIOD = 8
"""Frames after which the offsets repeat."""
POSITIONS = 32
"""Points of the pixel that a reference is the mean of."""


def get_offset(index: int) -> tuple[float, float]:
    """The point (x, y) of number ``index`` in pixels from the centre, in (-1/2, 1/2): the Halton sequence (2, 3).

    It begins with its number 1: number 0 is the pixel's corner.
    """
    return _inverse(index + 1, 2) - 0.5, _inverse(index + 1, 3) - 0.5


def get_frame_offset(frame: int) -> tuple[float, float]:
    """The offset of a frame."""
    return get_offset(frame % PERIOD)


def shift_principal_point(built: Any, point: tuple[float, float]) -> Any:
    """The ``mi.Scene``, its first sensor's rays now through ``point``, in pixels from the centres of the pixels."""
    sensor = built.sensors()[0]
    width, height = (int(size) for size in sensor.film().crop_size())
    values: Any = mi.traverse(sensor)
    values["principal_point_offset_x"] = point[0] / width
    values["principal_point_offset_y"] = point[1] / height
    values.update()
    return built


def _inverse(index: int, base: int) -> float:
    """The radical inverse: the digits of ``index`` mirrored at the point (van der Corput 1935)."""
    value, scale = 0.0, 1.0 / base
    while index:
        index, digit = divmod(index, base)
        value += digit * scale
        scale /= base
    return value
