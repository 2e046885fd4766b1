"""Compiled loops of :mod:`jaxdn.methods.steady.accumulation`."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, loop, mean_of_blocks


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
