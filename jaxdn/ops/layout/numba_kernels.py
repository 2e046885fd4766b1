"""Compiled loops: arrays of several layouts as planes (:mod:`jaxdn.ops.layout.planar`), unknown pixels filled."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, copy, loop

PLANES, PIXELS, BLOCKS, CORNERS, MEANS = range(5)
"""Layouts of an array, see :mod:`jaxdn.ops.layout.planar`."""


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
