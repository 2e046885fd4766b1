"""A compiled loop of :mod:`jaxdn.denoiser.statistics`: sums over the depths of rows."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, logarithm, loop


@loop
def depths(top: int, bottom: int, depth: Array, out: Array, far: float) -> None:
    """Rows of ``out`` [H, 3]: sums of log z, of 1 / z and of 1 over the pixels of ``depth`` [H, W, 1] in (0, far)."""
    width, zero, one = depth.shape[1], np.float32(0.0), np.float32(1.0)
    row = np.empty(width, np.float32)
    for y in range(top, bottom):
        inverses, number = 0.0, 0.0  # in double precision
        for x in range(width):
            z = depth[y, x, 0]
            known = (z > zero) & (z < far)
            row[x] = z if known else one
            inverses += float(one / row[x]) if known else 0.0
            number += known
        logarithm(row)
        logarithms = 0.0
        for x in range(width):
            logarithms += row[x]
        out[y, 0], out[y, 1], out[y, 2] = logarithms, inverses, number
