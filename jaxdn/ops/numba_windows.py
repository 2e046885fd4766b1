"""Numba loops of :mod:`jaxdn.ops.windows`, plane by plane, row by row.

The sums of a pixel are done in the same order wherever it is in the image, so that tiles of an image agree to the bit.
"""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, inlined, loop


@inlined
def _add(total: Array, one: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += one[x]


@inlined
def _add_four(total: Array, one: Array, two: Array, three: Array, four: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += (one[x] + two[x]) + (three[x] + four[x])


@inlined
def _sum(total: Array, one: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] = one[x] + other[x]


@inlined
def _weigh(
    total: Array, center: Array, near: Array, other: Array, far: Array, farther: Array, h0: float, h1: float, h2: float
) -> None:
    for x in range(total.shape[0]):
        total[x] = h0 * center[x] + h1 * (near[x] + other[x]) + h2 * (far[x] + farther[x])


@inlined
def _mirror(place: int, size: int) -> int:
    """The pixel at a place outside of 0 .. size - 1 of a line that is mirrored, the last pixel included."""
    place = place % (2 * size)
    return min(place, 2 * size - 1 - place)


@loop
def mean_rows(top: int, bottom: int, image: Array, out: Array, radius: int) -> None:
    """Rows of ``out`` [C, H, W]: means of ``image`` over windows, of what of them is in it."""
    planes, height, width = image.shape
    side, zero = 2 * radius + 1, np.float32(0.0)
    # Sums of 1, 2, 4 ... neighbours from each place on; around the row there is nothing.
    sums, doubled = np.zeros(width + 2 * radius, np.float32), np.zeros(width + 2 * radius, np.float32)
    total, number, nothing = np.empty(width, np.float32), np.empty(width, np.float32), np.zeros(width, np.float32)
    for x in range(width):
        number[x] = min(x, radius) + min(width - 1 - x, radius) + 1
    for plane in range(planes):
        for y in range(top, bottom):
            first, last = max(y - radius, 0), min(y + radius, height - 1)
            for x in range(radius):
                sums[x], sums[radius + width + x] = zero, zero
            row = sums[radius : radius + width]
            for x in range(width):
                row[x], total[x] = zero, zero
            for upper in range(y - radius, y + radius + 1, 4):
                one = image[plane, upper] if first <= upper <= last else nothing
                two = image[plane, upper + 1] if first <= upper + 1 <= last else nothing
                three = image[plane, upper + 2] if first <= upper + 2 <= last else nothing
                four = image[plane, upper + 3] if first <= upper + 3 <= last else nothing
                _add_four(row, one, two, three, four)
            start, count = 0, 1
            while start < side:
                if side & count:
                    _add(total, sums[start : start + width])
                    start += count
                if start < side:
                    length = max(width + 2 * radius - count, 0)
                    _sum(doubled[:length], sums[:length], sums[count : count + length])
                    sums, doubled = doubled, sums
                count *= 2
            rows, means = np.float32(last - first + 1), out[plane, y]
            for x in range(width):
                means[x] = total[x] / (rows * number[x])


@loop
def smooth_rows(top: int, bottom: int, image: Array, out: Array, taps: tuple[float, ...], step: int) -> None:
    """Rows of ``out`` [C, H, W]: ``image`` filtered along both axes, mirrored; ``taps`` are 3, from the centre on."""
    planes, height, width = image.shape
    reach = 2 * step
    h0, h1, h2 = taps
    wide = np.empty(width + 2 * reach, np.float32)
    row = wide[reach : reach + width]
    near, other = wide[step : step + width], wide[reach + step : reach + step + width]
    for plane in range(planes):
        source, smoothed = image[plane], out[plane]
        for y in range(top, bottom):
            above, below = source[_mirror(y - step, height)], source[_mirror(y + step, height)]
            higher, lower = source[_mirror(y - reach, height)], source[_mirror(y + reach, height)]
            _weigh(row, source[y], above, below, higher, lower, h0, h1, h2)
            for x in range(reach):
                wide[reach - 1 - x] = row[_mirror(-1 - x, width)]
                wide[reach + width + x] = row[_mirror(width + x, width)]
            _weigh(smoothed[y], row, near, other, wide[:width], wide[2 * reach :], h0, h1, h2)
