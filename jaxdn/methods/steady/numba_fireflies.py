"""A compiled loop of :mod:`jaxdn.methods.steady.fireflies`."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, loop


@loop
def suppress_fireflies(
    top: int,
    bottom: int,
    image: Array,
    hit: Array,
    light: Array,
    square: Array,
    number: Array,
    out: Array,
    weights: Array,
    dark: float,
    some: float,
    deviations: float,
    faintest: float,
    least: float,
) -> None:
    """Rows of ``out`` [3, H, W]: ``image``, no pixel of which is brighter than its eight neighbours.

    ``light`` [3, H, W], ``square`` and ``number`` [H, W] are a running mean; ``weights`` those of the luminance. The
    numbers are those of :mod:`jaxdn.methods.steady.fireflies` and the darkness of :mod:`jaxdn.filters.clamping`.
    """
    height, width = hit.shape
    zero, one, third = np.float32(0.0), np.float32(1.0), np.float32(1 / 3)
    # Brightness of three rows, one pixel wider at both ends; -1 where there is no surface.
    rows, share = np.empty((3, width + 2), np.float32), np.empty(width, np.float32)
    for y in range(top - 1, bottom + 1):
        row = rows[y % 3]
        row[0], row[width + 1] = -one, -one
        for x in range(width):
            row[x + 1] = -one
        if y >= 0 and y < height:
            for x in range(width):
                brightness = third * (image[0, y, x] + image[1, y, x] + image[2, y, x])
                row[x + 1] = brightness if hit[y, x] else -one
        if y <= top:
            continue
        at = y - 1
        above, here, below = rows[(at - 1) % 3], rows[at % 3], rows[y % 3]
        for x in range(width):
            limit = max(max(above[x], above[x + 1]), max(above[x + 2], here[x]))
            limit = max(max(limit, here[x + 2]), max(max(below[x], below[x + 1]), below[x + 2]))
            level = weights[0] * light[0, at, x] + weights[1] * light[1, at, x] + weights[2] * light[2, at, x]
            variance = max(square[at, x] - level * level, zero) / max(number[at, x], one)
            sure = one - deviations * np.sqrt(variance + least) / max(level, faintest)
            sure = sure if number[at, x] > some else zero
            brightness = third * (image[0, at, x] + image[1, at, x] + image[2, at, x])
            kept = max(limit / max(brightness, dark), sure)
            share[x] = kept if limit >= zero and brightness > limit else one
        for channel in range(3):
            for x in range(width):
                out[channel, at, x] = share[x] * image[channel, at, x]
