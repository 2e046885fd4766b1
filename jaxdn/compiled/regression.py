"""Compiled loops of :mod:`jaxdn.filters.regression`: moments of cells, and what slopes between cells explain."""

import numpy as np

from jaxdn.compiled.rows import Array, inlined, loop


@inlined
def _add_product(total: Array, one: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += one[x] * other[x]


@inlined
def _means(means: Array, sums: Array, cell: int) -> None:
    """Set to sums over ``cell`` neighbours, over ``cell`` squared; beyond the border there is nothing."""
    for x in range(means.shape[0]):
        total = np.float32(0.0)
        for column in range(x * cell, min(sums.shape[0], (x + 1) * cell)):
            total += sums[column]
        means[x] = total / np.float32(cell * cell)


@loop
def moments(top: int, bottom: int, away: Array, rest: Array, hit: Array, out: Array, pairs: Array, cell: int) -> None:
    """Rows of cells of ``out`` [P + 2, h, w]: means of the P products of ``pairs`` of away [K, H, W] and rest
    [3, H, W], of the mean of squares of rest, and of ``hit`` [H, W].
    """
    count, height, width = away.shape
    sums = np.empty(width, np.float32)
    for y in range(top, bottom):
        rows = range(y * cell, min(height, (y + 1) * cell))
        for index in range(pairs.shape[0]):
            one, other = pairs[index]
            sums[:] = 0
            for row in rows:
                if other < count:
                    _add_product(sums, away[one, row], away[other, row])
                else:
                    _add_product(sums, away[one, row], rest[other - count, row])
            _means(out[index, y], sums, cell)
        sums[:] = 0
        for row in rows:
            for channel in range(3):
                _add_product(sums, rest[channel, row], rest[channel, row])
        for x in range(width):
            sums[x] /= np.float32(3.0)
        _means(out[-2, y], sums, cell)
        sums[:] = 0
        for row in rows:
            _add_product(sums, hit[row], hit[row])
        _means(out[-1, y], sums, cell)


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
