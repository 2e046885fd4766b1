"""Compiled loops of :mod:`jaxdn.filters.regression`: moments of cells, and what slopes between cells explain."""

import numpy as np

from jaxdn.compiled.rows import Array, add_product, inlined, loop


@inlined
def _means(means: Array, sums: Array, cell: int) -> None:
    """Set to sums over ``cell`` neighbours, over ``cell`` squared; beyond the border there is nothing."""
    for x in range(means.shape[0]):
        total = np.float32(0.0)
        for column in range(x * cell, min(sums.shape[0], (x + 1) * cell)):
            total += sums[column]
        means[x] = total / np.float32(cell * cell)


@loop
def moments(top: int, bottom: int, planes: Array, out: Array, cell: int) -> None:
    """Rows of cells of ``out`` [C, C, h, w]: means of the products of all ``planes`` [C, H, W] with each other."""
    count, height, width = planes.shape
    sums = np.empty(width, np.float32)
    for y in range(top, bottom):
        for one in range(count):
            for other in range(one, count):
                sums[:] = 0
                for row in range(y * cell, min(height, (y + 1) * cell)):
                    add_product(sums, planes[one, row], planes[other, row])
                _means(out[one, other, y], sums, cell)
                out[other, one, y] = out[one, other, y]


@inlined
def _add_between(total: Array, above: Array, below: Array, share: float, away: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += (above[x] + share * (below[x] - above[x])) * away[x]


@loop
def explained(top: int, bottom: int, slopes: Array, away: Array, out: Array, cell: int) -> None:
    """Rows of ``out`` [3, H, W]: slopes [K, 3, h, W], interpolated between rows of cells, times away [K, H, W]."""
    count, _, rows, _ = slopes.shape
    width = away.shape[2]
    for y in range(top, bottom):
        place = max(np.float32(0.0), (np.float32(y) + np.float32(0.5)) / np.float32(cell) - np.float32(0.5))
        above = min(int(place), rows - 1)
        below, share = min(above + 1, rows - 1), place - np.float32(above)
        out[:, y] = 0
        for index in range(count):
            for channel in range(3):
                one, other = slopes[index, channel, above, :width], slopes[index, channel, below, :width]
                _add_between(out[channel, y], one, other, share, away[index, y])
