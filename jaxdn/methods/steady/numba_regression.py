"""Compiled loops of :mod:`jaxdn.methods.steady.regression`: moments of cells, and what slopes between cells explain."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, add_product, copy, inlined, loop

_BLOCK = 16
"""Cells side by side whose pixels stay in the cache together."""


@inlined
def _means(means: Array, sums: Array, cell: int) -> None:
    """Set to sums over ``cell`` neighbours, over ``cell`` squared."""
    for x in range(means.size):
        total = np.float32(0.0)
        for column in range(x * cell, (x + 1) * cell):
            total += sums[column]
        means[x] = total / np.float32(cell * cell)


@loop
def moments(
    top: int,
    bottom: int,
    before: Array,
    after: Array,
    hit: Array,
    floor: Array,
    factors: Array,
    out: Array,
    cell: int,
) -> None:
    """Rows of cells of ``out`` [K + 4, K + 4, h, w]: means of the products of d (K), r (3) and ``hit`` with each other.

    ``before`` and ``after`` [C, H, W] are light (3) and guides (K); ``factors`` [K] multiply the guides.
    """
    height, width = hit.shape
    guides, count, columns = factors.size, factors.size + 4, out.shape[3]
    both, sums = np.empty((count, cell, _BLOCK * cell), np.float32), np.empty(_BLOCK * cell, np.float32)
    for y in range(top, bottom):
        for x in range(0, columns, _BLOCK):
            left, right = x * cell, min(width, (x + _BLOCK) * cell)
            if (y + 1) * cell > height or right - left < _BLOCK * cell:
                both[:] = 0  # beyond the border there is nothing
            for row in range(y * cell, min(height, (y + 1) * cell)):
                pixels, seen = both[:, row - y * cell, : right - left], hit[row, left:right]
                surface = pixels[guides + 3]
                for place in range(right - left):
                    surface[place] = np.float32(1.0) if seen[place] else np.float32(0.0)
                red, green, blue = after[0, row, left:right], after[1, row, left:right], after[2, row, left:right]
                for index in range(3):
                    rest = pixels[guides + index]
                    here, there = before[index, row, left:right], after[index, row, left:right]
                    for place in range(right - left):
                        level = np.float32(1 / 3) * (red[place] + green[place] + blue[place]) + floor[0]
                        away = (here[place] - there[place]) / level
                        rest[place] = away if seen[place] else np.float32(0.0)
                for index in range(guides):
                    guide = pixels[index]
                    here, there = before[index + 3, row, left:right], after[index + 3, row, left:right]
                    for place in range(right - left):
                        away = factors[index] * (here[place] - there[place])
                        guide[place] = away if seen[place] else np.float32(0.0)
            for one in range(count):
                for other in range(one, count):
                    sums[:] = 0
                    for row in range(cell):
                        add_product(sums, both[one, row], both[other, row])
                    _means(out[one, other, y, x : x + _BLOCK], sums, cell)
                    copy(out[other, one, y, x : x + _BLOCK], out[one, other, y, x : x + _BLOCK])


@loop
def solve(top: int, bottom: int, system: Array, ridge: Array, expected: Array, out: Array) -> None:
    """Rows of cells of ``out`` [K, 3, h, w]: see :func:`jaxdn.methods.steady.regression.solve`."""
    count, columns = system.shape[0], system.shape[1]
    rows = np.empty((count, columns), np.float32)
    for y in range(top, bottom):
        for x in range(ridge.shape[1]):
            for row in range(count):
                for column in range(columns):
                    rows[row, column] = system[row, column, y, x]
                rows[row, row] += ridge[y, x]
                for channel in range(columns - count):
                    rows[row, count + channel] += ridge[y, x] * expected[row, channel, y, x]
            for pivot in range(count):
                share = np.float32(1.0) / rows[pivot, pivot]
                for column in range(columns):
                    rows[pivot, column] *= share
                for row in range(count):
                    if row != pivot:
                        factor = rows[row, pivot]
                        for column in range(columns):
                            rows[row, column] -= factor * rows[pivot, column]
            for row in range(count):
                for channel in range(columns - count):
                    out[row, channel, y, x] = rows[row, count + channel]


@inlined
def _add_between(total: Array, above: Array, below: Array, share: float, away: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += (above[x] + share * (below[x] - above[x])) * away[x]


@loop
def predict(
    top: int,
    bottom: int,
    slopes: Array,
    before: Array,
    after: Array,
    hit: Array,
    floor: Array,
    factors: Array,
    out: Array,
    cell: int,
) -> None:
    """Rows of ``out`` [3, H, W]: slopes [K, 3, h, W], interpolated between rows of cells, times d, by brightness."""
    count, _, rows, _ = slopes.shape
    width = hit.shape[1]
    away = np.empty(width, np.float32)
    for y in range(top, bottom):
        place = max(np.float32(0.0), (np.float32(y) + np.float32(0.5)) / np.float32(cell) - np.float32(0.5))
        above = min(int(place), rows - 1)
        below, share = min(above + 1, rows - 1), place - np.float32(above)
        out[:, y] = 0
        for index in range(count):
            for x in range(width):
                distance = factors[index] * (before[index + 3, y, x] - after[index + 3, y, x])
                away[x] = distance if hit[y, x] else np.float32(0.0)
            for channel in range(3):
                one, other = slopes[index, channel, above, :width], slopes[index, channel, below, :width]
                _add_between(out[channel, y], one, other, share, away)
        for x in range(width):
            away[x] = (after[0, y, x] + after[1, y, x] + after[2, y, x]) * np.float32(1 / 3) + floor[0]
        for channel in range(3):
            row = out[channel, y]
            for x in range(width):
                row[x] *= away[x]
