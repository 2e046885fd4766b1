"""A compiled loop of :mod:`jaxdn.brdf`: the texture that a division leaves."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, loop


@loop
def texture(
    top: int,
    bottom: int,
    reflectance: Array,
    light: Array,
    hue: Array,
    out: Array,
    floor: float,
    scale: float,
    black: float,
    faint: float,
) -> None:
    """Rows of ``out`` [H, W, 3]; ``hue`` [1] is whether only the colour is wanted.

    ``scale`` is what the divisor of white must be multiplied by to be 1; where less than ``black`` is reflected, light
    is emitted; ``faint`` keeps colours of the dark bounded.
    """
    width, zero, one = reflectance.shape[1], np.float32(0.0), np.float32(1.0)
    for y in range(top, bottom):
        row, own = out[y].reshape(3 * width), reflectance[y].reshape(3 * width)
        for x in range(3 * width):
            larger, smaller = max(own[x], floor), min(own[x], floor)
            ratio = smaller / larger
            ratio *= ratio
            row[x] = min(own[x] / (larger * np.sqrt(np.sqrt(one + ratio * ratio)) * scale), one)
        for x in range(width):
            reflected = max(max(own[3 * x], own[3 * x + 1]), own[3 * x + 2])
            lit = max(max(light[y, x, 0], light[y, x, 1]), light[y, x, 2]) > zero
            if reflected < black and lit:
                row[3 * x], row[3 * x + 1], row[3 * x + 2] = one, one, one
        if hue[0]:
            for x in range(width):
                red, green, blue = row[3 * x] + faint, row[3 * x + 1] + faint, row[3 * x + 2] + faint
                brightest = max(max(red, green), blue)
                row[3 * x], row[3 * x + 1], row[3 * x + 2] = red / brightest, green / brightest, blue / brightest
