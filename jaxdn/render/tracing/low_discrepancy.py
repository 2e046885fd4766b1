"""Points of the unit square that spread over it: each 1, 2, 4 ... samples that belong together lie in different parts.

They are the first two dimensions of Sobol's sequence (1967), a (0, 2)-sequence: of ``2^k`` points whose indices begin
at a multiple of ``2^k``, one lies in each of the ``2^k`` rectangles of every way to halve the square k times. Owen's
scrambling by hashes (Burley 2020, "Practical hash-based Owen scrambling") makes each point uniform, the points of
different pixels independent, and keeps this. Shuffling the indices in the same way makes two such sets of points
independent of each other.

The functions take arrays of 32-bit numbers, of NumPy or of Mitsuba's vectorised variants.
"""

from typing import Any

_MASKS = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF))
_HASH = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)
"""Even factors of the hash by Laine and Karras (2011), as in Burley's paper."""


def scatter_points(index: Any, seeds: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    """The two coordinates of points as 32-bit fractions; the seeds are of the order and of the two coordinates."""
    index = scramble(index, seeds[0])
    return scramble(_reverse_bits(index), seeds[1]), scramble(_fold_bits(index), seeds[2])


def scramble(values: Any, seed: Any) -> Any:
    """Owen's scrambling of 32-bit fractions: whether a bit is flipped depends on all bits above it."""
    values = _reverse_bits(values) + seed
    for factor in _HASH:
        values = values ^ (values * factor)
    return _reverse_bits(values)


def _reverse_bits(values: Any) -> Any:
    """The bits in the opposite order: the first dimension of Sobol's sequence (van der Corput 1935)."""
    for shift, mask in _MASKS:
        values = ((values >> shift) & mask) | ((values & mask) << shift)
    return (values >> 16) | (values << 16)


def _fold_bits(index: Any) -> Any:
    """The second dimension of Sobol's sequence, whose direction numbers are rows of Pascal's triangle modulo 2."""
    direction, value = 1 << 31, index & 0
    for bit in range(32):
        # All ones where the bit is set: 0 - 1 wraps around.
        value = value ^ ((index & 0) - ((index >> bit) & 1) & direction)
        direction ^= direction >> 1
    return value
