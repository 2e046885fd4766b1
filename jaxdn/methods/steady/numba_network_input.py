"""Numba loop of :mod:`jaxdn.methods.steady.network_input`: surfaces and light of a frame, by blocks of 2x2 pixels."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, copy, exponential, inlined, logarithm, loop, mean_of_blocks


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
def assemble_network_input(
    top: int,
    bottom: int,
    geometry: tuple[Array, ...],
    noisy: Array,
    history: Array,
    valid: Array,
    hit: Array,
    gain: Array,
    out: Array,
    weights: Array,
    dark: float,
    gamma: float,
    toe: float,
    slope: float,
) -> None:
    """Rows of ``out`` [h, w, C]; what lies beyond H/2 and W/2 is that of the last row and column.

    ``weights`` are those of the luminance, ``dark`` is light at one brightness that is as good as none; the curve is
    ``log(1 + x)^gamma``, below ``toe`` ``slope log(1 + x)``.
    """
    width = noisy.shape[1]
    half = width // 2
    rows = np.empty((2, 3, width), np.float32)
    sums, logarithms = np.empty(width, np.float32), np.empty(width, np.float32)
    means = np.empty(half, np.float32)
    for row in range(top, bottom):
        y, pixels, first = 2 * min(row, noisy.shape[0] // 2 - 1), out[row], 0
        for index in range(len(geometry)):
            surface = geometry[index]
            for channel in range(surface.shape[2]):
                for x in range(half):
                    for corner in range(4):
                        pixels[x, first + corner] = surface[y + corner // 2, 2 * x + corner % 2, channel]
                first += 4
        # The noisy light, the running mean and the last output.
        for image in range(3):
            for below in range(2):
                for channel in range(3):
                    one = rows[below, channel]
                    kept = channel if image == 1 else channel + 5
                    for x in range(width):
                        before = image > 0 and valid[y + below, x]
                        found = history[y + below, x, kept] if before else noisy[y + below, x, channel]
                        one[x] = gain[0] * found
                    _compress(one, sums, logarithms, gamma, toe, slope)
                if image != 1:
                    place = first + (12 if image == 0 else 16) + 2 * below
                    for x in range(width):
                        red, green, blue = rows[below, 0, x], rows[below, 1, x], rows[below, 2, x]
                        sums[x] = weights[0] * red + weights[1] * green + weights[2] * blue
                    for x in range(half):
                        pixels[x, place], pixels[x, place + 1] = sums[2 * x], sums[2 * x + 1]
            for channel in range(3):
                mean_of_blocks(means, rows[0, channel], rows[1, channel])
                for x in range(half):
                    pixels[x, first + 3 * image + channel] = means[x]
        # How much the history varies, its number of samples, whether there is a surface.
        for below in range(2):
            for x in range(width):
                then = history[y + below, x]
                level = weights[0] * then[0] + weights[1] * then[1] + weights[2] * then[2]
                deviation = np.sqrt(max(then[3] - level * level, np.float32(0.0)) + np.float32(1e-12))
                rows[below, 0, x] = np.float32(0.125) * min(deviation / (level + dark / gain[0]), np.float32(8.0))
                rows[below, 1, x] = np.float32(1.0) / (np.float32(1.0) + then[4])
                rows[below, 2, x] = np.float32(hit[y + below, x])
        for fact in range(3):
            mean_of_blocks(means, rows[0, fact], rows[1, fact])
            for x in range(half):
                pixels[x, first + 9 + fact] = means[x]
        for x in range(half, out.shape[1]):
            copy(pixels[x], pixels[half - 1])
