"""Numba loop of :func:`jaxdn.ops.scales.fill_holes`."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, loop


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
