"""How loops are compiled, and functions of whole rows of numbers in them.

Exponential and logarithm are written out: a call of the C library's functions would keep the loop from vectorising.

Compiled loops are kept on disk, and compiled anew where their own file has changed. Who changes a function of this file
deletes them (``rm jaxdn/compiled/__pycache__/*.nb?``).
"""

from typing import Any

import numpy as np
from numba import njit

# Sums may be done in any order; what is not finite keeps its meaning.
_options: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz"}, "error_model": "numpy"}
# Into the loop itself: passing arrays to a function counts references, which takes longer than a short row.
inlined = njit(**_options, inline="always")
loop = njit(**_options, nogil=True, cache=True)

Array = np.ndarray


@inlined
def exponential(values: Array, factor: float) -> None:
    """In place ``factor * exp(-values)``, for values above -87: a power of two times a polynomial, error 2e-7."""
    for x in range(values.shape[0]):
        power = max(np.float32(-1.44269504) * values[x], np.float32(-126.0))
        whole = np.floor(power + np.float32(0.5))
        rest = power - whole
        result = np.float32(1.54035304e-4)
        result = result * rest + np.float32(1.33335581e-3)
        result = result * rest + np.float32(9.61812911e-3)
        result = result * rest + np.float32(5.55041087e-2)
        result = result * rest + np.float32(2.40226507e-1)
        result = result * rest + np.float32(6.93147181e-1)
        result = result * rest + np.float32(1.0)
        exponent = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23))
        values[x] = factor * (result * exponent.view(np.float32))


@inlined
def logarithm(values: Array) -> None:
    """In place log(values) of normal numbers > 0: an exponent and a series in (m - 1) / (m + 1), error 2e-7."""
    for x in range(values.shape[0]):
        bits = np.int32(np.float32(values[x]).view(np.int32) - np.int32(0x3F3504F3))  # that of the square root of 1/2
        exponent = np.int32(bits >> np.int32(23))
        mantissa = np.int32((bits & np.int32(0x7FFFFF)) + np.int32(0x3F3504F3)).view(np.float32)
        share = (mantissa - np.float32(1.0)) / (mantissa + np.float32(1.0))
        square = share * share
        series = np.float32(1 / 9)
        series = series * square + np.float32(1 / 7)
        series = series * square + np.float32(1 / 5)
        series = series * square + np.float32(1 / 3)
        series = series * square + np.float32(1.0)
        values[x] = np.float32(exponent) * np.float32(0.69314718) + np.float32(2.0) * share * series
