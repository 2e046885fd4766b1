"""Numba loop of :mod:`jaxdn.filters.reproject`: the taps of every pixel's target, fetched, tested and averaged."""

import math
from typing import Any

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, loop

Given = Any
"""An array, or None where there is none."""


@loop
def reproject(
    top: int,
    bottom: int,
    history: Array,
    depth: Given,
    normal: Given,
    ids: Given,
    x: Array,
    y: Array,
    inside: Array,
    wanted_depth: Given,
    tolerance: Given,
    wanted_normal: Given,
    wanted_ids: Given,
    mean: Array,
    valid: Array,
    invalid: Array,
    threshold: float,
    least: float,
    around: bool,
    lanes: tuple[int, ...],
) -> None:
    """Rows of ``mean`` [H, W, C], ``valid`` [H, W] (1 or 0) and ``invalid`` [H]: how many pixels of ``history`` are.

    As :func:`jaxdn.filters.reproject.reproject_along` says: accepted taps of the target's cell, renormalised if their
    weights sum to ``least``; else, with ``around``, the mean of those of the 3x3 pixels around the target. ``lanes``
    has an element for each channel: their number is known when the loop is compiled, so that all of them are worked on
    at once.
    """
    height, width, channels = history.shape[0], history.shape[1], len(lanes)
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    largest = np.float32(np.finfo(np.float32).max)
    # Of a number that is negative or not finite, or of the sum of its bits and these, the sign is set.
    bits, beyond, sign = history.view(np.uint32), np.uint32(0x00800000), np.uint32(0x80000000)
    weights = np.empty(4, np.float32)
    for i in range(top, bottom):
        invalid[i] = zero
        for j in range(width):
            doubt = np.uint32(0)
            for channel in range(channels):
                doubt |= bits[i, j, channel] | np.uint32(bits[i, j, channel] + beyond)
            if doubt & sign:
                sound = True  # as -0 is
                for channel in range(channels):
                    value = history[i, j, channel]
                    sound &= (value >= zero) & (value <= largest)
                invalid[i] += zero if sound else one
            valid[i, j] = zero
            if not inside[i, j]:
                for channel in range(channels):
                    mean[i, j, channel] = zero
                continue
            left = min(np.int64(x[i, j]), max(width - 2, 0))
            upper = min(np.int64(y[i, j]), max(height - 2, 0))
            right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
            fx, fy = x[i, j] - np.float32(left), y[i, j] - np.float32(upper)
            # Read once: for all that the compiler knows, what is written below may change them.
            if depth is not None:
                right_depth, away = wanted_depth[i, j], tolerance[i, j]
            if ids is not None:
                right_id = wanted_ids[i, j]
            if normal is not None:
                mx, my, mz = wanted_normal[i, j, 0], wanted_normal[i, j, 1], wanted_normal[i, j, 2]
                nowhere = mx == 0 and my == 0 and mz == 0 and threshold < 1
                anything = mx != mx  # NaN, where no normal is wanted
            # The four of the cell. No function tests taps: passing it the arrays would count references, which takes
            # longer than the test.
            mass = zero
            for tap in range(4):
                row, column = lower if tap // 2 else upper, right if tap % 2 else left
                share = (fy if tap // 2 else one - fy) * (fx if tap % 2 else one - fx)
                accepted = True
                if depth is not None:
                    accepted &= abs(depth[row, column, 0] - right_depth) <= away
                if ids is not None:
                    # Any id is right where none is wanted.
                    accepted &= (ids[row, column, 0] == right_id) | (right_id != right_id)
                if normal is not None:
                    nx, ny, nz = normal[row, column, 0], normal[row, column, 1], normal[row, column, 2]
                    # Where there is no surface in both, they are alike.
                    neither = nowhere & (nx == 0) & (ny == 0) & (nz == 0)
                    accepted &= (nx * mx + ny * my + nz * mz > threshold) | neither | anything
                if accepted:
                    doubt = np.uint32(0)
                    for channel in range(channels):
                        doubt |= bits[row, column, channel] | np.uint32(bits[row, column, channel] + beyond)
                    if doubt & sign:
                        for channel in range(channels):
                            value = history[row, column, channel]
                            accepted &= (value >= zero) & (value <= largest)
                weights[tap] = share if accepted else zero
                mass += weights[tap]
            if mass >= least:
                valid[i, j] = one
                for channel in range(channels):
                    total = zero  # what is not sound must not be multiplied
                    if weights[0] > zero:
                        total += weights[0] * history[upper, left, channel]
                    if weights[1] > zero:
                        total += weights[1] * history[upper, right, channel]
                    if weights[2] > zero:
                        total += weights[2] * history[lower, left, channel]
                    if weights[3] > zero:
                        total += weights[3] * history[lower, right, channel]
                    mean[i, j, channel] = total / mass
                continue
            for channel in range(channels):
                mean[i, j, channel] = zero
            if not around:
                continue
            # The nine around the target, which count alike.
            mass, middle_x, middle_y = zero, math.floor(x[i, j] + half), math.floor(y[i, j] + half)
            for row in range(max(middle_y - 1, 0), min(middle_y + 2, height)):
                for column in range(max(middle_x - 1, 0), min(middle_x + 2, width)):
                    accepted = True
                    if depth is not None:
                        accepted &= abs(depth[row, column, 0] - right_depth) <= away
                    if ids is not None:
                        accepted &= (ids[row, column, 0] == right_id) | (right_id != right_id)
                    if normal is not None:
                        nx, ny, nz = normal[row, column, 0], normal[row, column, 1], normal[row, column, 2]
                        neither = nowhere & (nx == 0) & (ny == 0) & (nz == 0)
                        accepted &= (nx * mx + ny * my + nz * mz > threshold) | neither | anything
                    for channel in range(channels):
                        value = history[row, column, channel]
                        accepted &= (value >= zero) & (value <= largest)
                    if accepted:
                        mass += one
                        for channel in range(channels):
                            mean[i, j, channel] += history[row, column, channel]
            if mass >= least:
                valid[i, j] = one
                for channel in range(channels):
                    mean[i, j, channel] /= mass
