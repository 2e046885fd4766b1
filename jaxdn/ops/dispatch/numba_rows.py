"""How loops are compiled, and functions of whole rows of numbers in them.

Exponential and logarithm are written out: a call of the C library's functions would keep the loop from vectorising.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator

from jaxdn.runtime.program_cache import VARIABLE, cache_folder

_numba: Any = config  # whose names are set while it is imported
# Sums may be done in any order; what is not finite keeps its meaning.
_options: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz"}, "error_model": "numpy"}
# Into the loop itself: passing arrays to a function counts references, which takes longer than a short row.
inlined = njit(**_options, inline="always")


_ROWS = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
"""Of this file: its functions are parts of the loops that call them, and Numba compares a loop's own file alone."""


class KeptLoops(FunctionCache):
    """Numba's files of a loop; those that cannot be read or written cost time alone.

    A machine that crashes leaves half a file, and a disk may be full: Numba's own would end every run there. It locks
    nothing either: two processes that save two signatures at once may give both the same file.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What is kept; None if there is nothing, or nothing that can be read or is right, which is removed."""
        try:
            found = super().load_overload(sig, target_context)
            if found is not None and tuple(found.signature.args) != tuple(sig):
                raise ValueError(f"expected a loop of {sig}, got one of {found.signature.args}")
            return found
        except Exception:  # what pickle and LLVM say of half a file has no common base class
            for file in Path(self.cache_path).glob(f"*.{self._py_func.__name__}-*.nb?"):
                with contextlib.suppress(OSError):
                    file.unlink()
            return None

    def save_overload(self, *which: Any) -> None:
        """What cannot be written is compiled in every process."""
        with contextlib.suppress(OSError):
            super().save_overload(*which)

    def has_any(self) -> bool:
        """Whether there is something of this state of the loop, for whatever arguments."""
        try:
            return any(key[-1] == _ROWS for key in self._cache_file._load_index())
        except Exception:  # half a file: load_overload removes it
            return False

    def _index_key(self, *which: Any) -> tuple[Any, ...]:
        """What is kept is found by, with the functions of rows that it was compiled with."""
        return (*super()._index_key(*which), _ROWS)


class _ReadOnlyLocator(UserProvidedCacheLocator):
    def ensure_cache_path(self) -> None:
        """Numba's own refuses what cannot be written."""


class _ReadOnlyFiles(CompileResultCacheImpl):
    _locator_classes = [_ReadOnlyLocator]  # noqa: RUF012, as the class above has it


class _ReadOnlyCache(KeptLoops):
    _impl_class: Any = _ReadOnlyFiles

    def save_overload(self, *_: Any) -> None:
        """What is missing is compiled in every process."""


def loop(function: Callable[..., None]) -> Callable[..., None]:
    """Compiled when it is first called, without Python's lock; kept on disk.

    It is kept below the folder of :data:`jaxdn.runtime.program_cache.VARIABLE` where that is set, which may be
    read-only later; else beside its file, or in the user's own folder where that cannot be written.
    """
    kept: Any = njit(**_options, nogil=True)(function)
    with _kept_in(_chosen_folder()) as read_only:
        if read_only:
            kept._cache = _ReadOnlyCache(function)
            return kept
        try:
            kept._cache = KeptLoops(function)
        except RuntimeError:  # no folder can be written
            return kept
    return kept


def _chosen_folder() -> Path | None:
    """Where the user wants loops to be kept; None: Numba decides, by its own variable or by itself."""
    return cache_folder() / "loops" if os.environ.get(VARIABLE) and not _numba.CACHE_DIR else None


@contextlib.contextmanager
def _kept_in(folder: Path | None) -> Iterator[bool]:
    """While it is entered, Numba keeps functions in a folder; gives whether that is there and cannot be written."""
    before = _numba.CACHE_DIR
    _numba.CACHE_DIR = before if folder is None else str(folder)
    try:
        yield folder is not None and folder.is_dir() and not os.access(folder, os.W_OK)
    finally:
        _numba.CACHE_DIR = before


Array = np.ndarray


@inlined
def copy(row: Array, other: Array) -> None:
    """In place of ``row[:] = other``, which takes Numba seconds to compile."""
    for x in range(row.shape[0]):
        row[x] = other[x]


@inlined
def mean_of_blocks(row: Array, above: Array, below: Array) -> None:
    """Set to the means of the blocks of 2x2 pixels of two rows."""
    for x in range(row.shape[0]):
        row[x] = np.float32(0.25) * (above[2 * x] + above[2 * x + 1] + below[2 * x] + below[2 * x + 1])


@inlined
def add_product(total: Array, one: Array, other: Array) -> None:
    """In place total + one * other."""
    for x in range(total.shape[0]):
        total[x] += one[x] * other[x]


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
