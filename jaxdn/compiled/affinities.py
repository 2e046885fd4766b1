"""Compiled loops of the two filters by affinity: :mod:`jaxdn.ops.affinity_filter` and :mod:`jaxdn.filters.enlarge`.

All work is on rows of one plane, which vectorises: a row of weights is summed up feature by feature, and multiplies row
by row of the image. All rows that a pixel's taps lie in stay in the cache.
"""

import numpy as np

from jaxdn.compiled.rows import Array, exponential, inlined, loop


@inlined
def _residual(
    total: Array,
    z: Array,
    slope_x: Array,
    slope_y: Array,
    other_z: Array,
    other_x: Array,
    other_y: Array,
    dy: float,
    dx: float,
    factor: float,
) -> None:
    """Set to the square of how far the slanted guide of the other pixels is from where a plane expects it."""
    for x in range(total.shape[0]):
        expected = dx * (slope_x[x] + other_x[x]) + dy * (slope_y[x] + other_y[x])
        away = other_z[x] - z[x] - np.float32(0.5) * expected
        total[x] = (factor * away) * (factor * away)


@inlined
def _add_square(total: Array, one: Array, other: Array, factor: float) -> None:
    for x in range(total.shape[0]):
        away = factor * (one[x] - other[x])
        total[x] += away * away


@inlined
def _add_product(total: Array, one: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += one[x] * other[x]


@inlined
def _multiply(total: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] *= other[x]


@inlined
def _product(total: Array, one: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] = one[x] * other[x]


@inlined
def _add(total: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += other[x]


@loop
def filtered(
    top: int,
    bottom: int,
    image: Array,
    features: Array,
    slanted: Array,
    confidence: Array,
    scales: Array,
    out: Array,
    step: int,
    spline: Array,
    least: float,
) -> None:
    """Rows of ``out`` [C, H, W]: a level of the filter, taps ``step`` apart.

    ``spline`` are the weights h from the centre outwards, ``least`` is a sum of weights that counts as none. The weight
    of p and p + o is that of p + o and p: it is computed once, with p the upper or the left one of both, and kept until
    the row of the other has had its turn.
    """
    channels, height, width = image.shape
    reach = spline.size - 1
    columns = 2 * reach + 1
    kept = reach * step + 1
    weights = np.empty((kept, reach + 1, columns, width), np.float32)
    total, tap = np.empty((channels + 1, width), np.float32), np.empty(width, np.float32)
    for y in range(max(0, top - reach * step), bottom):
        # Towards rows below, and to the right.
        for row in range(reach + 1):
            there = y + row * step
            if there >= height or there < top:
                continue
            for column in range(-reach, reach + 1):
                shift = column * step
                left, right = max(0, -shift), min(width, width - shift)
                if right <= left or (row == 0 and column <= 0):
                    continue
                first, last = left + shift, right + shift
                weight = weights[y % kept, row, column + reach, left:right]
                _residual(
                    weight,
                    slanted[0, y, left:right],
                    slanted[1, y, left:right],
                    slanted[2, y, left:right],
                    slanted[0, there, first:last],
                    slanted[1, there, first:last],
                    slanted[2, there, first:last],
                    np.float32(row * step),
                    np.float32(shift),
                    scales[-1],
                )
                for index in range(features.shape[0]):
                    here, other = features[index, y, left:right], features[index, there, first:last]
                    _add_square(weight, here, other, scales[index])
                exponential(weight, spline[row] * spline[abs(column)])
        if y < top:
            continue
        for index in range(channels + 1):
            sums, own = total[index], confidence[y]
            for x in range(width):
                sums[x] = spline[0] * spline[0] * own[x]
        for index in range(channels):
            _multiply(total[index], image[index, y])
        for row in range(-reach, reach + 1):
            there = y + row * step
            if there < 0 or there >= height:
                continue
            for column in range(-reach, reach + 1):
                shift = column * step
                left, right = max(0, -shift), min(width, width - shift)
                if right <= left or (row == 0 and column == 0):
                    continue
                first, last = left + shift, right + shift
                part = tap[: right - left]
                if row > 0 or (row == 0 and column > 0):
                    _product(part, weights[y % kept, row, column + reach, left:right], confidence[there, first:last])
                else:
                    opposite = weights[there % kept, -row, reach - column, first:last]
                    _product(part, opposite, confidence[there, first:last])
                for index in range(channels):
                    _add_product(total[index, left:right], part, image[index, there, first:last])
                _add(total[channels, left:right], part)
        mass = total[channels]
        for index in range(channels):
            result, sums, own = out[index, y], total[index], image[index, y]
            for x in range(width):
                result[x] = sums[x] / mass[x] if mass[x] > least else own[x]


@loop
def enlarged(
    top: int,
    bottom: int,
    coarse: Array,
    features: Array,
    slanted: Array,
    confidence: Array,
    fine_features: Array,
    fine_slanted: Array,
    scales: Array,
    image: Array,
    mass: Array,
    spatial: Array,
    least: float,
) -> None:
    """Rows of ``image`` [C, 2h, 2w] and of the sum of weights ``mass`` [2h, 2w] from ``coarse`` [C, h, w].

    ``spatial`` [3, 3, 2, 2] are the spatial weights of the taps (row, column) of a block's pixels (row, column);
    ``least`` is a sum of weights that counts as none.
    """
    channels, height, width = coarse.shape
    count = features.shape[0]
    own, slant = np.empty((count, width), np.float32), np.empty((3, width), np.float32)
    total, weights = np.empty((channels + 1, width), np.float32), np.empty(width, np.float32)
    for y in range(top, bottom):
        for odd in range(2):
            # Pixels of one column of the blocks, side by side.
            for index in range(count):
                own[index] = fine_features[index, y, odd::2]
            for index in range(3):
                slant[index] = fine_slanted[index, y, odd::2]
            total[:] = 0
            for row in range(-1, 2):
                there = y // 2 + row
                if there < 0 or there >= height:
                    continue
                for column in range(-1, 2):
                    left, right = max(0, -column), min(width, width - column)
                    if right <= left:
                        continue
                    first, last = left + column, right + column
                    weight = weights[: right - left]
                    _residual(
                        weight,
                        slant[0, left:right],
                        slant[1, left:right],
                        slant[2, left:right],
                        slanted[0, there, first:last],
                        slanted[1, there, first:last],
                        slanted[2, there, first:last],
                        np.float32(2 * row - y % 2),
                        np.float32(2 * column - odd),
                        scales[-1],
                    )
                    for index in range(count):
                        here, other = own[index, left:right], features[index, there, first:last]
                        _add_square(weight, here, other, scales[index])
                    exponential(weight, spatial[row + 1, column + 1, y % 2, odd])
                    _multiply(weight, confidence[there, first:last])
                    for index in range(channels):
                        _add_product(total[index, left:right], weight, coarse[index, there, first:last])
                    _add(total[channels, left:right], weight)
            for x in range(width):
                some = total[channels, x] > least
                mass[y, 2 * x + odd] = total[channels, x] if some else np.float32(0.0)
                share = np.float32(1.0) / total[channels, x] if some else np.float32(0.0)
                for index in range(channels):
                    image[index, y, 2 * x + odd] = share * total[index, x]
