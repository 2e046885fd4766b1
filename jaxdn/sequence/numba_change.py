"""Numba loops of :mod:`jaxdn.sequence.change`, by rows of planes."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, inlined, loop


@inlined
def _middle(one: float, other: float, third: float) -> float:
    """The median of three."""
    return max(min(one, other), min(max(one, other), third))


@inlined
def _repeat_ends(row: Array) -> None:
    """A row's first and last number are those beside them."""
    row[0], row[row.shape[0] - 1] = row[1], row[row.shape[0] - 2]


@loop
def winsorize_rows(
    top: int, bottom: int, whole: Array, change: Array, common: Array, bound: float, most: float
) -> None:
    """Rows of ``change`` [3, H, W], ``whole`` within its bounds and +-``most``, and of ``common`` [1, H, W], 1 or 0.

    The median of 3x3 pixels, whose columns are in order: that of the largest of the least, the median of the middle
    ones and the least of the largest (Smith, "Implementing median filters in XC4000E FPGAs", 1996).
    """
    height, width = whole.shape[1:]
    least, middle, largest = np.empty((3, width + 2), np.float32)
    third = np.float32(1 / 3)
    for y in range(top, bottom):
        above, below = whole[:, max(y - 1, 0)], whole[:, min(y + 1, height - 1)]
        here = whole[:, y]
        for x in range(width):
            one = third * (abs(above[0, x]) + abs(above[1, x]) + abs(above[2, x]))
            two = third * (abs(here[0, x]) + abs(here[1, x]) + abs(here[2, x]))
            three = third * (abs(below[0, x]) + abs(below[1, x]) + abs(below[2, x]))
            least[x + 1] = min(one, min(two, three))
            middle[x + 1] = _middle(one, two, three)
            largest[x + 1] = max(one, max(two, three))
        _repeat_ends(least)
        _repeat_ends(middle)
        _repeat_ends(largest)
        for x in range(width):
            low = max(least[x], max(least[x + 1], least[x + 2]))
            high = min(largest[x], min(largest[x + 1], largest[x + 2]))
            limit = max(_middle(low, _middle(middle[x], middle[x + 1], middle[x + 2]), high), bound)
            red, green, blue = here[0, x], here[1, x], here[2, x]
            inside = (abs(red) <= limit) & (abs(green) <= limit) & (abs(blue) <= limit)
            common[0, y, x] = np.float32(1.0) if inside else np.float32(0.0)
            limit = min(limit, most)
            change[0, y, x] = min(max(red, -limit), limit)
            change[1, y, x] = min(max(green, -limit), limit)
            change[2, y, x] = min(max(blue, -limit), limit)


@inlined
def _widen(row: Array, pixels: Array) -> None:
    """A row with one more pixel at both ends, mirrored without the last one."""
    width = pixels.shape[0]
    for x in range(width):
        row[x + 1] = pixels[x]
    row[0], row[width + 1] = pixels[min(1, width - 1)], pixels[max(width - 2, 0)]


@loop
def curve_rows(top: int, bottom: int, change: Array, out: Array) -> None:
    """Rows of ``out`` [4, H, W]: mean squares of the second differences of ``change`` [C, H, W], over 6."""
    channels, height, width = change.shape
    above, here, below = np.empty((3, width + 2), np.float32)
    share, two, zero = np.float32(1.0 / (6 * channels)), np.float32(2.0), np.float32(0.0)
    for y in range(top, bottom):
        upper = min(1, height - 1) if y == 0 else y - 1
        lower = max(height - 2, 0) if y == height - 1 else y + 1
        flat, steep, falling, rising = out[0, y], out[1, y], out[2, y], out[3, y]
        for x in range(width):
            flat[x], steep[x], falling[x], rising[x] = zero, zero, zero, zero
        for channel in range(channels):
            _widen(above, change[channel, upper])
            _widen(here, change[channel, y])
            _widen(below, change[channel, lower])
            for x in range(width):
                center = two * here[x + 1]
                along = here[x] + here[x + 2] - center
                down = above[x + 1] + below[x + 1] - center
                one = above[x] + below[x + 2] - center
                other = above[x + 2] + below[x] - center
                flat[x], steep[x] = flat[x] + share * (along * along), steep[x] + share * (down * down)
                falling[x], rising[x] = falling[x] + share * (one * one), rising[x] + share * (other * other)
