"""Numba loop of :mod:`jaxdn.filters.catmull_rom`: the sixteen pixels around every target, weighted and added."""

import math

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, inlined, loop


@inlined
def _set_weights(weights: Array, fraction: float) -> None:
    """Set to those of four neighbours for the fraction in [0, 1) between the second and the third."""
    half, square = np.float32(0.5), fraction * fraction
    cube = square * fraction
    weights[0] = square - half * (fraction + cube)
    weights[1] = np.float32(1.0) - np.float32(2.5) * square + np.float32(1.5) * cube
    weights[2] = half * fraction + np.float32(2.0) * square - np.float32(1.5) * cube
    weights[3] = half * (cube - square)


@loop
def warp_cubic(top: int, bottom: int, image: Array, motion: Array, warped: Array, lanes: tuple[int, ...]) -> None:
    """Rows of ``warped`` [H, W, C], as :func:`jaxdn.filters.catmull_rom.warp_cubic` says.

    ``lanes`` has an element for each channel: their number is known when the loop is compiled, so that all of them are
    worked on at once.
    """
    height, width, channels = image.shape[0], image.shape[1], len(lanes)
    zero, half = np.float32(0.0), np.float32(0.5)
    across, down = np.empty(4, np.float32), np.empty(4, np.float32)
    for i in range(top, bottom):
        for j in range(width):
            x, y = np.float32(j) + motion[i, j, 0], np.float32(i) + motion[i, j, 1]
            # False where one is not finite.
            inside = (x >= -half) & (x <= np.float32(width) - half) & (y >= -half) & (y <= np.float32(height) - half)
            if not inside:
                for channel in range(channels):
                    warped[i, j, channel] = zero
                continue
            left, upper = math.floor(x), math.floor(y)
            _set_weights(across, x - np.float32(left))
            _set_weights(down, y - np.float32(upper))
            # Beyond the border its pixels are repeated. Numbers, not arrays: what is written below may be in an array.
            x0, x1 = min(max(left - 1, 0), width - 1), min(max(left, 0), width - 1)
            x2, x3 = min(max(left + 1, 0), width - 1), min(left + 2, width - 1)
            y0, y1 = min(max(upper - 1, 0), height - 1), min(max(upper, 0), height - 1)
            y2, y3 = min(max(upper + 1, 0), height - 1), min(upper + 2, height - 1)
            a0, a1, a2, a3 = across[0], across[1], across[2], across[3]
            d0, d1, d2, d3 = down[0], down[1], down[2], down[3]
            # A row at a time: the compiler compares no more than eight addresses to see that what is read stays.
            for c in range(channels):
                row = a0 * image[y0, x0, c] + a1 * image[y0, x1, c] + a2 * image[y0, x2, c] + a3 * image[y0, x3, c]
                warped[i, j, c] = d0 * row
            for c in range(channels):
                row = a0 * image[y1, x0, c] + a1 * image[y1, x1, c] + a2 * image[y1, x2, c] + a3 * image[y1, x3, c]
                warped[i, j, c] += d1 * row
            for c in range(channels):
                row = a0 * image[y2, x0, c] + a1 * image[y2, x1, c] + a2 * image[y2, x2, c] + a3 * image[y2, x3, c]
                warped[i, j, c] += d2 * row
            for c in range(channels):
                row = a0 * image[y3, x0, c] + a1 * image[y3, x1, c] + a2 * image[y3, x2, c] + a3 * image[y3, x3, c]
                total = warped[i, j, c] + d3 * row
                warped[i, j, c] = zero if total < zero else total
