"""Numba loops of :mod:`jaxdn.ops.scales`: arrays of several layouts as planes or as pixels, unknown pixels filled."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, copy, loop

PLANES, PIXELS, BLOCKS, CORNERS, MEANS = range(5)
"""Layouts of an array, see :data:`jaxdn.ops.scales.Channels`."""


@loop
def join_rows(top: int, bottom: int, arrays: tuple[Array, ...], out: Array, layouts: tuple[int, ...]) -> None:
    """Rows of ``out`` [C, H, W]: the channels of all arrays."""
    width = out.shape[2]
    for y in range(top, bottom):
        first = 0
        for index in range(len(arrays)):
            array, layout = arrays[index], layouts[index]
            if layout == PLANES:
                count = array.shape[0]
                for channel in range(count):
                    copy(out[first + channel, y], array[channel, y])
            elif layout == PIXELS:
                count = array.shape[2]
                for channel in range(count):
                    row, pixels = out[first + channel, y], array[y]
                    for x in range(width):
                        row[x] = pixels[x, channel]
            elif layout == BLOCKS:
                count = array.shape[2] // 4
                for channel in range(count):
                    row, blocks, corner = out[first + channel, y], array[y // 2], 4 * channel + 2 * (y % 2)
                    for x in range(width // 2):
                        row[2 * x], row[2 * x + 1] = blocks[x, corner], blocks[x, corner + 1]
            elif layout == CORNERS:
                count = array.shape[2] // 4
                for channel in range(count):
                    row, blocks = out[first + channel, y], array[y]
                    for x in range(width):
                        total = np.float32(0.0)
                        for corner in range(4 * channel, 4 * channel + 4):
                            total += blocks[x, corner]
                        row[x] = np.float32(0.25) * total
            else:
                count = array.shape[2]
                for channel in range(count):
                    row, above, below = out[first + channel, y], array[2 * y], array[2 * y + 1]
                    for x in range(width):
                        one = above[2 * x, channel] + above[2 * x + 1, channel]
                        other = below[2 * x, channel] + below[2 * x + 1, channel]
                        row[x] = np.float32(0.25) * (one + other)
            first += count


@loop
def join_pixel_rows(top: int, bottom: int, arrays: tuple[Array, ...], out: Array, layouts: tuple[int, ...]) -> None:
    """Rows of ``out`` [h, w, C]: what becomes of planes, by the numbers of :data:`jaxdn.ops.scales.PLANE_LAYOUTS`."""
    quarter = np.float32(0.25)
    for y in range(top, bottom):
        row, first, width = out[y], 0, 0
        for index in range(len(arrays)):
            array, layout = arrays[index], layouts[index]
            if array.shape[0] == 0:  # a part that has nothing
                continue
            if layout == 0:  # as they are
                above, width = min(y, array.shape[1] - 1), array.shape[2]
                for channel in range(array.shape[0]):
                    plane = array[channel, above]
                    for x in range(width):
                        row[x, first] = plane[x]
                    first += 1
                continue
            above, width = 2 * min(y, (array.shape[1] - 1) // 2), (array.shape[2] + 1) // 2
            below, whole = min(above + 1, array.shape[1] - 1), array.shape[2] // 2
            for channel in range(array.shape[0]):
                upper, lower = array[channel, above], array[channel, below]
                if layout == 1:  # the pixels of 2x2
                    for x in range(whole):
                        row[x, first], row[x, first + 1] = upper[2 * x], upper[2 * x + 1]
                        row[x, first + 2], row[x, first + 3] = lower[2 * x], lower[2 * x + 1]
                    if whole < width:
                        row[whole, first], row[whole, first + 1] = upper[2 * whole], upper[2 * whole]
                        row[whole, first + 2], row[whole, first + 3] = lower[2 * whole], lower[2 * whole]
                    first += 4
                else:  # their means
                    for x in range(whole):
                        row[x, first] = quarter * (upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1])
                    if whole < width:
                        row[whole, first] = quarter * (2 * upper[2 * whole] + 2 * lower[2 * whole])
                    first += 1
        for x in range(width, out.shape[1]):
            for channel in range(first):
                row[x, channel] = row[width - 1, channel]


@loop
def fill_rows(top: int, bottom: int, image: Array, known: Array, out: Array) -> None:
    """Four rows of ``out`` [H, W, C] each: ``image`` where it is known, else the mean of a block's known pixels."""
    width, zero, one = known.shape[1], np.float32(0.0), np.float32(1.0)
    for block in range(top, bottom):
        y = 4 * block
        for row in range(y, y + 4):
            for x in range(width):
                for channel in range(image.shape[2]):
                    out[row, x, channel] = image[row, x, channel]
        for x in range(0, width, 4):
            missing = 0
            for place in range(16):
                missing += not known[y + place // 4, x + place % 4]
            if missing == 0:
                continue
            for channel in range(image.shape[2]):
                # The means of those of the four blocks of 2x2 pixels, and of all.
                total, number = zero, zero
                for place in range(16):
                    row, column = y + place // 4, x + place % 4
                    if known[row, column]:
                        total, number = total + image[row, column, channel], number + one
                wide = total / max(number, one)
                for corner in range(4):
                    upper, left = y + 2 * (corner // 2), x + 2 * (corner % 2)
                    total, number = zero, zero
                    for place in range(4):
                        row, column = upper + place // 2, left + place % 2
                        if known[row, column]:
                            total, number = total + image[row, column, channel], number + one
                    near = total / number if number > zero else wide
                    for place in range(4):
                        row, column = upper + place // 2, left + place % 2
                        if not known[row, column]:
                            out[row, column, channel] = near
