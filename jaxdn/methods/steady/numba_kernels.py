"""Numba loops of ``steady``, frame by frame in this order: what the network sees, what its head says, means, fireflies.

Those of the regression are in :mod:`jaxdn.methods.steady.numba_regression`.
"""

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


@inlined
def _sigmoid(values: Array) -> None:
    """In place ``1 / (1 + exp(-values))``."""
    for x in range(values.shape[0]):
        values[x] = min(max(values[x], np.float32(-80.0)), np.float32(80.0))
    exponential(values, np.float32(1.0))
    for x in range(values.shape[0]):
        values[x] = np.float32(1.0) / (np.float32(1.0) + values[x])


@loop
def split_heads(top: int, bottom: int, head: Array, own: Array, shares: Array, half: Array, rest: Array) -> None:
    """Rows of a ``head`` [h, w, C], taken apart along its channels.

    ``own`` [h, w, ...] are the first of them, unchanged; ``shares`` [N, 2h, 2w] in [0, 1] the next 4N, of all pixels of
    blocks of 2x2; ``half`` [h, w, ...] then follow unchanged, and ``rest`` [n, h, w] in [0, 1] are the last. More rows
    and columns of the head are left out.
    """
    width = own.shape[1]
    values = np.empty((2, width), np.float32)
    for y in range(top, bottom):
        pixels, first = head[y], 0
        for x in range(width):
            for channel in range(own.shape[2]):
                own[y, x, channel] = pixels[x, channel]
        first += own.shape[2]
        for name in range(shares.shape[0]):
            for below in range(2):
                for beside in range(2):
                    for x in range(width):
                        values[beside, x] = pixels[x, first + 2 * below + beside]
                    _sigmoid(values[beside])
                row = shares[name, 2 * y + below]
                for x in range(width):
                    row[2 * x], row[2 * x + 1] = values[0, x], values[1, x]
            first += 4
        for x in range(width):
            for channel in range(half.shape[2]):
                half[y, x, channel] = pixels[x, first + channel]
        first += half.shape[2]
        for index in range(rest.shape[0]):
            for x in range(width):
                rest[index, y, x] = pixels[x, first + index]
            _sigmoid(rest[index, y])


@loop
def update_mean(
    top: int,
    bottom: int,
    noisy: Array,
    history: Array,
    valid: Array,
    hit: Array,
    follow: Array,
    mean: Array,
    square: Array,
    number: Array,
    missed: Array,
    weights: Array,
    most: float,
) -> None:
    """Two rows of ``mean`` [3, H, W], ``square`` and ``number`` [H, W] for each of ``missed`` [3, H/2, W/2].

    ``weights`` are those of the luminance, ``most`` is the largest number.
    """
    width = noisy.shape[1]
    one = np.float32(1.0)
    shares, lacking = np.empty(width, np.float32), np.empty((2, 3, width), np.float32)
    for block in range(top, bottom):
        for below in range(2):
            y = 2 * block + below
            for x in range(width):
                count = max(history[y, x, 4], np.float32(1e-6))
                share = follow[y, x] / (follow[y, x] + count * (one - follow[y, x]))
                rest = one - share
                effective = min(one / (rest * rest / count + share * share), most)
                shares[x] = share if valid[y, x] else one
                number[y, x] = effective if valid[y, x] else one
            for channel in range(3):
                for x in range(width):
                    now = noisy[y, x, channel]
                    then = history[y, x, channel] if valid[y, x] else now
                    mixed = then + shares[x] * (now - then)
                    mean[channel, y, x] = mixed
                    lacking[below, channel, x] = now - mixed if hit[y, x] else np.float32(0.0)
            for x in range(width):
                red, green, blue = noisy[y, x, 0], noisy[y, x, 1], noisy[y, x, 2]
                level = weights[0] * red + weights[1] * green + weights[2] * blue
                then = history[y, x, 3] if valid[y, x] else level * level
                square[y, x] = then + shares[x] * (level * level - then)
        for channel in range(3):
            mean_of_blocks(missed[channel, block], lacking[0, channel], lacking[1, channel])


@loop
def update_history(
    top: int,
    bottom: int,
    light: Array,
    square: Array,
    number: Array,
    fine: Array,
    image: Array,
    change: Array | None,
    history: Array,
    valid: Array,
    feedback: Array,
    blend: Array,
    out: Array,
    most: float,
) -> None:
    """Rows of ``out`` [H, W, 8]; ``most`` is the largest light that is shown."""
    width, zero, one = valid.shape[1], np.float32(0.0), np.float32(1.0)
    newest = np.empty(width, np.float32)
    for y in range(top, bottom):
        for x in range(width):
            newest[x] = blend[y, x] if valid[y, x] else one
        for channel in range(3):
            for x in range(width):
                mean, before = light[channel, y, x], history[y, x, 5 + channel]
                kept = mean + feedback[y, x] * (fine[channel, y, x] - mean)
                if change is not None:
                    before += change[channel, y, x]
                    kept += change[channel, y, x]
                out[y, x, channel] = max(kept, zero)
                shown = before + newest[x] * (image[channel, y, x] - before)
                out[y, x, 5 + channel] = min(max(shown, zero), most)
        for x in range(width):
            out[y, x, 3], out[y, x, 4] = square[y, x], number[y, x]


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
    numbers are those of :mod:`jaxdn.methods.steady.accumulation` and the darkness of :mod:`jaxdn.filters.clamping`.
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
