"""A compiled loop for :mod:`jaxdn.filters.recall`: the taps of every pixel's target, fetched, tested and averaged."""

import math
from typing import Any

import numpy as np

from jaxdn.compiled.rows import Array, loop

Given = Any
"""An array, or None where there is none."""


@loop
def fetched(
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
    unsound: Array,
    threshold: float,
    least: float,
    around: bool,
) -> None:
    """Rows of ``mean`` [H, W, C], ``valid`` [H, W] (1 or 0) and ``unsound`` [H]: how many pixels of ``history`` are.

    As :func:`jaxdn.filters.recall.fetch` says: accepted taps of the target's cell, renormalised if their weights sum to
    ``least``; else, with ``around``, the mean of those of the 3x3 pixels around the target.
    """
    height, width, channels = history.shape
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    largest = np.float32(np.finfo(np.float32).max)
    total = np.empty(channels, np.float32)
    for i in range(top, bottom):
        unsound[i] = zero
        for j in range(width):
            sound = True
            for channel in range(channels):
                value = history[i, j, channel]
                sound &= (value >= zero) & (value <= largest)
            unsound[i] += zero if sound else one
            valid[i, j] = zero
            for channel in range(channels):
                mean[i, j, channel] = zero
            if not inside[i, j]:
                continue
            left = min(max(math.floor(x[i, j]), 0), max(width - 2, 0))
            upper = min(max(math.floor(y[i, j]), 0), max(height - 2, 0))
            right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
            fx, fy = x[i, j] - np.float32(left), y[i, j] - np.float32(upper)
            middle_x, middle_y = math.floor(x[i, j] + half), math.floor(y[i, j] + half)
            mass = zero
            total[:] = zero
            # Read once: for all that the compiler knows, what is written below may change them.
            if depth is not None:
                right_depth, away = wanted_depth[i, j], tolerance[i, j]
            if ids is not None:
                right_id = wanted_ids[i, j]
            if normal is not None:
                mx, my, mz = wanted_normal[i, j, 0], wanted_normal[i, j, 1], wanted_normal[i, j, 2]
                nowhere = mx == 0 and my == 0 and mz == 0 and threshold < 1
            # The four of the cell, then the nine around the target. No function tests them: passing it the arrays would
            # count references, which takes longer than the test.
            for tap in range(13 if around else 4):
                if tap < 4:
                    row, column = lower if tap // 2 else upper, right if tap % 2 else left
                    share = (fy if tap // 2 else one - fy) * (fx if tap % 2 else one - fx)
                else:
                    if tap == 4:
                        if mass >= least:
                            break
                        mass, share = zero, one
                        total[:] = zero
                    row, column = middle_y + (tap - 4) // 3 - 1, middle_x + (tap - 4) % 3 - 1
                    if row < 0 or row >= height or column < 0 or column >= width:
                        continue
                # Numba leaves out what asks for an absent buffer if nothing else is asked in the same condition.
                if depth is not None:  # noqa: SIM102
                    if not abs(depth[row, column, 0] - right_depth) <= away:
                        continue
                if ids is not None:  # noqa: SIM102
                    # Any id is right where none is wanted.
                    if ids[row, column, 0] != right_id and right_id == right_id:
                        continue
                if normal is not None:
                    nx, ny, nz = normal[row, column, 0], normal[row, column, 1], normal[row, column, 2]
                    # Where there is no surface in both, they are alike.
                    if not nx * mx + ny * my + nz * mz > threshold:  # noqa: SIM102
                        if not (nowhere and nx == 0 and ny == 0 and nz == 0):
                            continue
                sound = True
                for channel in range(channels):
                    value = history[row, column, channel]
                    sound &= (value >= zero) & (value <= largest)
                if not sound:
                    continue
                mass += share
                for channel in range(channels):
                    total[channel] += share * history[row, column, channel]
            if mass < least:
                continue
            valid[i, j] = one
            for channel in range(channels):
                mean[i, j, channel] = total[channel] / mass
