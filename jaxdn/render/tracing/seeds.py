"""Random numbers as a function of (seed, frame, stream, pixel, sample): independent of the order of rendering.

A frame rendered alone, again, or in another process gets the same numbers, and the reference never shares a sample
with the noisy layers. The mixing function is TEA (Zafar, Olano and Curtis 2010), nested so that no two inputs of the
same level collide.
"""

from typing import NamedTuple, TypeVar

import numpy as np

NOISY, REFERENCE, DEPTH, DRAWS = range(4)
"""The independent streams of a frame: noisy layers, reference, the few samples that measure the path length, and the
single samples that training draws from."""

_MASK = 0xFFFFFFFF
_Number = TypeVar("_Number", int, np.ndarray)


def tea(first: _Number, second: _Number, rounds: int = 8) -> tuple[_Number, _Number]:
    """A bijection of pairs of 32-bit numbers, or of int64 arrays of them, that removes the structure of its input."""
    first, second, total = first & _MASK, second & _MASK, 0
    for _ in range(rounds):
        total = (total + 0x9E3779B9) & _MASK
        first += ((second << 4) + 0xA341316C) ^ (second + total) ^ ((second >> 5) + 0xC8013EA4)
        first &= _MASK
        second += ((first << 4) + 0xAD90777D) ^ (first + total) ^ ((first >> 5) + 0x7E95761E)
        second &= _MASK
    return first, second


class SampleStream(NamedTuple):
    """The random numbers of one stream of one frame of a clip."""

    seed: int
    """Of the clip."""
    frame: int
    stream: int
    """``NOISY``, ``REFERENCE``, ``DEPTH`` or ``DRAWS``."""

    def key(self) -> tuple[int, int]:
        """The 64-bit key of the stream (:func:`make_frame_key`)."""
        return make_frame_key(*self)


def make_frame_key(seed: int, frame: int, stream: int) -> tuple[int, int]:
    """The 64-bit key of one stream of one frame."""
    first, second = tea(frame, seed)
    return tea(first ^ stream, second)


def make_pass_seed(seed: int, frame: int, stream: int, index: int) -> int:
    """The seed of one whole-image pass of Mitsuba's own integrators.

    Mitsuba multiplies it by the number of pixels modulo 2**32, so only its low bits count: consecutive passes need
    consecutive seeds, and a fixed distance separates the streams.
    """
    return (tea(frame, seed)[0] + (stream << 17) + index) & _MASK
