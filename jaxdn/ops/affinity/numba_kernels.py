"""Numba loops of :mod:`jaxdn.ops.affinity.filter` and :mod:`jaxdn.ops.affinity.joint_upsample`.

All work is on rows of one plane, which vectorises: a row of weights is summed up feature by feature, and multiplies row
by row of the image. All rows that a pixel's taps lie in stay in the cache.
"""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, add_product, copy, exponential, inlined, loop


@inlined
def _away(
    away: Array,
    z: Array,
    slope_x: Array,
    slope_y: Array,
    other_z: Array,
    other_x: Array,
    other_y: Array,
    dy: float,
    dx: float,
) -> None:
    """Set to how far the slanted guide of the other pixels is from where a plane expects it."""
    for x in range(away.shape[0]):
        expected = dx * (slope_x[x] + other_x[x]) + dy * (slope_y[x] + other_y[x])
        away[x] = other_z[x] - z[x] - np.float32(0.5) * expected


@inlined
def _square(values: Array, factor: float) -> None:
    for x in range(values.shape[0]):
        values[x] = (factor * values[x]) * (factor * values[x])


@inlined
def _add_square(total: Array, one: Array, other: Array, factor: float) -> None:
    for x in range(total.shape[0]):
        away = factor * (one[x] - other[x])
        total[x] += away * away


@inlined
def _product(total: Array, one: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] = one[x] * other[x]


@inlined
def _add_two(total: Array, one: Array, other: Array, third: Array, fourth: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += one[x] * other[x] + third[x] * fourth[x]


@inlined
def _add_three(total: Array, one: Array, other: Array, third: Array, fourth: Array, fifth: Array, sixth: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += one[x] * other[x] + third[x] * fourth[x] + fifth[x] * sixth[x]


@loop
def filter_rows(
    top: int,
    bottom: int,
    image: Array,
    features: Array,
    slanted: Array,
    confidence: Array,
    scales: Array,
    out: Array,
    masses: Array,
    step: int,
    spline: Array,
    least: float,
) -> None:
    """Rows of ``out`` [C, H, W], a level of the filter, and of its sums of weights [H, W]; taps ``step`` apart.

    ``spline`` are the 3 weights h from the centre outwards, ``least`` is a sum of weights that counts as none. The
    weight of p and p + o is that of p + o and p: it is computed once, with p the upper or the left one of both, and
    kept until the row of the other has had its turn.
    """
    channels, height, width = image.shape
    beside, kept = 2 * step, 2 * step + 1
    # Beyond the border weights are 0, and so is light.
    weights = np.zeros((kept, 3, 5, width + 2 * beside), np.float32)
    weights[:, 0, 2] = spline[0] * spline[0]
    light, total = np.zeros(width + 2 * beside, np.float32), np.empty(width, np.float32)
    for y in range(max(0, top - beside), bottom):
        # Towards rows below, and to the right.
        for row in range(3):
            there = y + row * step
            if there >= height or there < top:
                continue
            for column in range(-2, 3):
                shift = column * step
                left, right = max(0, -shift), min(width, width - shift)
                if right <= left or (row == 0 and column <= 0):
                    continue
                first, last = left + shift, right + shift
                weight = weights[y % kept, row, column + 2, beside + left : beside + right]
                _away(
                    weight,
                    slanted[0, y, left:right],
                    slanted[1, y, left:right],
                    slanted[2, y, left:right],
                    slanted[0, there, first:last],
                    slanted[1, there, first:last],
                    slanted[2, there, first:last],
                    np.float32(row * step),
                    np.float32(shift),
                )
                _square(weight, scales[-1])
                for index in range(features.shape[0]):
                    here, other = features[index, y, left:right], features[index, there, first:last]
                    _add_square(weight, here, other, scales[index])
                exponential(weight, spline[row] * spline[abs(column)])
        if y < top:
            continue
        # The sum of weights first, then channel by channel: the sums of one stay in the nearest cache.
        for channel in range(-1, channels):
            total[:] = 0
            for row in range(-2, 3):
                there = y + row * step
                if there < 0 or there >= height:
                    continue
                inside = light[beside : beside + width]
                if channel < 0:
                    copy(inside, confidence[there])
                else:
                    _product(inside, image[channel, there], confidence[there])
                found = weights[(y if row > 0 else there) % kept, abs(row)]
                if row > 0:
                    far, near = found[0, beside:], found[1, beside:]
                else:
                    far, near = found[4], found[3, beside - step :]
                _add_two(total, far, light, near, light[step:])
                if row < 0:
                    near, far = found[1, beside + step :], found[0, 2 * beside :]
                else:
                    near, far = found[3, beside:], found[4, beside:]
                _add_three(total, found[2, beside:], inside, near, light[beside + step :], far, light[2 * beside :])
            if channel < 0:
                copy(masses[y], total)
                continue
            result, own, mass = out[channel, y], image[channel, y], masses[y]
            for x in range(width):
                result[x] = total[x] / mass[x] if mass[x] > least else own[x]


@inlined
def _by_distance(distance: Array, weight: Array, p_takes: Array, q_takes: Array, own: Array, other: Array) -> None:
    """Set to the gradient by the distance of p and q, times -2; ``own`` and ``other`` are their confidences."""
    for x in range(distance.shape[0]):
        distance[x] = np.float32(-2.0) * weight[x] * (other[x] * p_takes[x] + own[x] * q_takes[x])


@inlined
def _negative(total: Array, one: Array) -> None:
    for x in range(total.shape[0]):
        total[x] = -one[x]


@inlined
def _add_difference(total: Array, factor: Array, one: Array, other: Array) -> None:
    for x in range(total.shape[0]):
        total[x] += factor[x] * (one[x] - other[x])


@inlined
def _add_scaled(total: Array, other: Array, factor: float) -> None:
    for x in range(total.shape[0]):
        total[x] += factor * other[x]


@loop
def filter_gradient_rows(
    top: int,
    bottom: int,
    image: Array,
    features: Array,
    slanted: Array,
    confidence: Array,
    gains: Array,
    level: Array,
    by_image: Array,
    by_features: Array,
    by_slanted: Array,
    by_confidence: Array,
    step: int,
    spline: Array,
) -> None:
    """Rows of the gradient by image and guide, whose scales have been multiplied into it.

    Gathered: every pixel p collects what it gets as the centre and what it gets as a tap of its neighbours q. ``gains``
    [C, H, W] are the gradient by the result over its sum of weights, ``level`` [H, W] their product with the result.
    """
    channels, height, width = image.shape
    reach = spline.size - 1
    work = np.empty((6, width), np.float32)
    for y in range(top, bottom):
        centre = spline[0] * spline[0]
        by_features[:, y] = 0
        by_slanted[:, y] = 0
        for x in range(width):
            taken = -level[y, x]
            for index in range(channels):
                taken += gains[index, y, x] * image[index, y, x]
                by_image[index, y, x] = centre * confidence[y, x] * gains[index, y, x]
            by_confidence[y, x] = centre * taken
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
                count = right - left
                weight, away, distance = work[0, :count], work[1, :count], work[2, :count]
                p_takes, q_takes, share = work[3, :count], work[4, :count], work[5, :count]
                dy, dx = np.float32(row * step), np.float32(shift)
                _away(
                    away,
                    slanted[0, y, left:right],
                    slanted[1, y, left:right],
                    slanted[2, y, left:right],
                    slanted[0, there, first:last],
                    slanted[1, there, first:last],
                    slanted[2, there, first:last],
                    dy,
                    dx,
                )
                _product(weight, away, away)
                for index in range(features.shape[0]):
                    here, other = features[index, y, left:right], features[index, there, first:last]
                    _add_square(weight, here, other, np.float32(1.0))
                exponential(weight, spline[abs(row)] * spline[abs(column)])
                _negative(p_takes, level[y, left:right])
                _negative(q_takes, level[there, first:last])
                _product(share, weight, confidence[y, left:right])
                for index in range(channels):
                    add_product(p_takes, gains[index, y, left:right], image[index, there, first:last])
                    add_product(q_takes, gains[index, there, first:last], image[index, y, left:right])
                    add_product(by_image[index, y, left:right], share, gains[index, there, first:last])
                add_product(by_confidence[y, left:right], weight, q_takes)
                own, other_own = confidence[y, left:right], confidence[there, first:last]
                _by_distance(distance, weight, p_takes, q_takes, own, other_own)
                for index in range(features.shape[0]):
                    here, other = features[index, y, left:right], features[index, there, first:last]
                    _add_difference(by_features[index, y, left:right], distance, here, other)
                _product(share, distance, away)
                _add_scaled(by_slanted[0, y, left:right], share, np.float32(-1.0))
                _add_scaled(by_slanted[1, y, left:right], share, np.float32(-0.5) * dx)
                _add_scaled(by_slanted[2, y, left:right], share, np.float32(-0.5) * dy)


@inlined
def _shares(shares: Array, mass: Array, total: Array, least: float) -> None:
    """Sums of weights of both columns of the blocks side by side, 0 where they are too small, and their inverse."""
    for x in range(total.shape[1]):
        for odd in range(2):
            some = total[odd, x] > least
            mass[2 * x + odd] = total[odd, x] if some else np.float32(0.0)
            shares[odd, x] = np.float32(1.0) / total[odd, x] if some else np.float32(0.0)


@inlined
def _side_by_side(row: Array, total: Array, shares: Array) -> None:
    """Set to the products for both columns of the blocks."""
    one, other, share, other_share = total[0], total[1], shares[0], shares[1]
    for x in range(one.shape[0]):
        row[2 * x] = one[x] * share[x]
        row[2 * x + 1] = other[x] * other_share[x]


@loop
def upsample_rows(
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
    # Beyond the border weights are 0, and so is light.
    weights, light = np.zeros((2, 3, 3, width), np.float32), np.zeros(width + 2, np.float32)
    total, masses = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
    for y in range(top, bottom):
        for odd in range(2):
            # Pixels of one column of the blocks, side by side.
            for index in range(count):
                copy(own[index], fine_features[index, y, odd::2])
            for index in range(3):
                copy(slant[index], fine_slanted[index, y, odd::2])
            for row in range(3):
                there = y // 2 + row - 1
                if there < 0 or there >= height:
                    continue
                for column in range(3):
                    left, right = max(0, 1 - column), min(width, width + 1 - column)
                    if right <= left:
                        continue
                    first, last = left + column - 1, right + column - 1
                    weight = weights[odd, row, column, left:right]
                    _away(
                        weight,
                        slant[0, left:right],
                        slant[1, left:right],
                        slant[2, left:right],
                        slanted[0, there, first:last],
                        slanted[1, there, first:last],
                        slanted[2, there, first:last],
                        np.float32(2 * row - 2 - y % 2),
                        np.float32(2 * column - 2 - odd),
                    )
                    _square(weight, scales[-1])
                    for index in range(count):
                        here, other = own[index, left:right], features[index, there, first:last]
                        _add_square(weight, here, other, scales[index])
                    exponential(weight, spatial[row, column, y % 2, odd])
        # The sum of weights first, then channel by channel.
        for channel in range(-1, channels):
            total[:] = 0
            for row in range(3):
                there = y // 2 + row - 1
                if there < 0 or there >= height:
                    continue
                if channel < 0:
                    copy(light[1 : width + 1], confidence[there])
                else:
                    _product(light[1 : width + 1], coarse[channel, there], confidence[there])
                for odd in range(2):
                    found = weights[odd, row]
                    _add_three(total[odd], found[0], light, found[1], light[1:], found[2], light[2:])
            if channel < 0:
                _shares(masses, mass[y], total, least)
            else:
                _side_by_side(image[channel, y], total, masses)
