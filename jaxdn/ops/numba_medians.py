"""A Numba loop of :mod:`jaxdn.ops.medians`."""

import numpy as np

from jaxdn.ops.dispatch.numba_rows import Array, inlined, loop

_HALF = 16
"""Bits that are counted at a time."""


@inlined
def _bits(value: float) -> np.int32:
    """Of a number >= 0 in float32."""
    return np.float32(value).view(np.int32) & np.int32(0x7FFFFFFF)


@loop
def find_median(top: int, bottom: int, values: Array, counted: Array, out: Array) -> None:
    """Set ``out[0]`` to the median of the numbers >= 0 that count: how often their upper halves are there, and then the
    lower halves of those with the median's upper one. Not in tiles."""
    often, seldom = np.zeros(1 << 15, np.int32), np.zeros(1 << _HALF, np.int32)
    number = 0
    for place in range(values.shape[0]):
        if counted[place]:
            often[_bits(values[place]) >> _HALF] += 1
            number += 1
    out[0] = np.float32(0.0)
    if number == 0:
        return
    rank, upper = (number - 1) // 2, 0
    while rank >= often[upper]:
        rank -= often[upper]
        upper += 1
    for place in range(values.shape[0]):
        bits = _bits(values[place])
        if counted[place] and bits >> _HALF == upper:
            seldom[bits & ((1 << _HALF) - 1)] += 1
    lower = 0
    while rank >= seldom[lower]:
        rank -= seldom[lower]
        lower += 1
    low = np.int32((upper << _HALF) | lower).view(np.float32)
    high = low
    if number % 2 == 0 and rank + 1 == seldom[lower]:
        high = np.float32(np.inf)
        for place in range(values.shape[0]):
            if counted[place] and values[place] > low:
                high = min(high, values[place])
    out[0] = low if low == high else np.float32(0.5) * low + np.float32(0.5) * high
