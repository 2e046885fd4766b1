"""A compiled loop of :mod:`jaxdn.methods.steady.method`: what a network decides, from what its head says."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, exponential, inlined, loop


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
