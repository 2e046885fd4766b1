"""A compiled loop of :mod:`jaxdn.filters.blocks`: compressed light, its mean over blocks and its luminance in them."""

import numpy as np

from jaxdn.compiled.rows import Array, exponential, inlined, logarithm, loop


@inlined
def _compress(light: Array, sums: Array, logarithms: Array, gamma: float, toe: float, slope: float) -> None:
    """In place :func:`jaxdn.color.compress` of light >= 0; the other rows are for the work."""
    for x in range(light.shape[0]):
        light[x] = min(light[x], np.float32(3.0e38))
        sums[x] = np.float32(1.0) + light[x]
        logarithms[x] = sums[x]
    logarithm(logarithms)
    for x in range(light.shape[0]):
        # What rounding took from 1 + light is given back (Kahan).
        rest = sums[x] - np.float32(1.0)
        exact = logarithms[x] * (light[x] / rest) if rest > np.float32(0.0) else light[x]
        sums[x] = exact
        light[x] = max(exact, toe)
    logarithm(light)
    for x in range(light.shape[0]):
        light[x] *= -gamma
    exponential(light, np.float32(1.0))
    for x in range(light.shape[0]):
        light[x] = light[x] if sums[x] > toe else slope * sums[x]


@loop
def seen(
    top: int, bottom: int, light: Array, gain: Array, out: Array, weights: Array, gamma: float, toe: float, slope: float
) -> None:
    """Rows of ``out`` [H/2, W/2, 7] from ``light`` [H, W, 3] times ``gain``.

    ``weights`` are those of the luminance; the curve is ``log(1 + x)^gamma``, below ``toe`` ``slope log(1 + x)``.
    """
    width = light.shape[1]
    rows = np.empty((2, 3, width), np.float32)
    sums, logarithms = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(top, bottom):
        for below in range(2):
            for channel in range(3):
                row = rows[below, channel]
                for x in range(width):
                    row[x] = gain[0] * light[2 * y + below, x, channel]
                _compress(row, sums, logarithms, gamma, toe, slope)
            for x in range(width):
                red, green, blue = rows[below, 0, x], rows[below, 1, x], rows[below, 2, x]
                out[y, x // 2, 3 + 2 * below + x % 2] = weights[0] * red + weights[1] * green + weights[2] * blue
        for channel in range(3):
            above, under = rows[0, channel], rows[1, channel]
            for x in range(width // 2):
                total = above[2 * x] + above[2 * x + 1] + under[2 * x] + under[2 * x + 1]
                out[y, x, channel] = np.float32(0.25) * total
