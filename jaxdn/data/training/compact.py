"""Codes of a few bytes for the values of buffers, and their compression: what a packed training set is made of.

Each kind of buffer (:data:`jaxdn.core.frame.Kind`) has a code of unsigned integers, with an error far below what
training can tell; noise hardly compresses, so that every bit that is not stored counts. Codes are then compressed
without loss.
"""

import bz2
import lzma
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import FAR

_EXPONENTS = 15
"""The bias of the exponent of RGB9E5."""
_DIRECTION_LEVELS = 511
"""Steps from 0 to 1 of the coordinates of a direction; the code 2 * 511 + 1 of both is the zero vector."""
_VECTOR_STEPS = 64
"""Steps of a motion vector in a pixel."""
_UNKNOWN = 65535
_LOWEST = 95 << 10
"""The code of 2^-32 in the upper 18 bits of a positive float32, from which codes of distances count."""


def encode_light(values: np.ndarray, bits: int = 9) -> np.ndarray:
    """uint32 codes [...] of light [..., 3]: three mantissas and the exponent of the largest channel.

    With 9 bits this is RGB9E5 as in the OpenGL extension EXT_texture_shared_exponent: channel c is
    ``mantissa_c * 2^(exponent - 15 - bits)``, mantissas in the lowest bits (red first), the exponent (5 bits) above.
    The error of each channel is at most 2^-bits of the largest one, and at most 2^-(16 + bits) for small light. With
    fewer bits each mantissa has a byte of its own. Values that are negative or not finite are 0 (as in
    :func:`jaxdn.denoiser.sanitize.sanitize`), those beyond ``2^16 (1 - 2^-bits)``, for RGB9E5 65408, are clamped.
    """
    values = np.clip(np.where(np.isfinite(values), values, 0), 0, 2.0**16 * (1 - 2.0**-bits)).astype(np.float32)
    largest = values.max(axis=-1)
    exponent = np.where(largest > 0, np.maximum(np.frexp(largest)[1], -_EXPONENTS), -_EXPONENTS)

    def mantissas(exponent: np.ndarray) -> np.ndarray:
        return np.floor(np.ldexp(values, (bits - exponent)[..., None]) + np.float32(0.5)).astype(np.uint32)

    exponent += mantissas(exponent).max(axis=-1) >> bits  # rounded up to the next power of two
    red, green, blue = np.moveaxis(mantissas(exponent), -1, 0)
    field = _field(bits)
    above = (exponent + _EXPONENTS).astype(np.uint32) << (3 * field)
    return red | green << field | blue << (2 * field) | above


def decode_light(codes: np.ndarray, bits: int = 9) -> np.ndarray:
    """float16 light [..., 3] of codes [...]; half precision holds each of these values exactly."""
    field = _field(bits)
    mantissas = np.stack([codes >> (field * channel) & ((1 << field) - 1) for channel in range(3)], axis=-1)
    exponent = (codes >> (3 * field)).astype(np.int32) - _EXPONENTS - bits
    return np.ldexp(mantissas.astype(np.float32), exponent[..., None]).astype(np.float16)


def encode_fraction(values: np.ndarray) -> np.ndarray:
    """uint8 codes, ``round(255 x)`` for x in [0, 1]: an error of at most 1 / 510. What is not finite is 1."""
    return np.round(255 * np.clip(np.where(np.isfinite(values), values, 1), 0, 1)).astype(np.uint8)


def decode_fraction(codes: np.ndarray) -> np.ndarray:
    """float16 fractions; 0 and 1 are exact."""
    return (codes / np.float32(255)).astype(np.float16)


def encode_direction(values: np.ndarray) -> np.ndarray:
    """uint16 codes [..., 2] of directions [..., 3]: points of an octahedron unfolded to a square, in 1023 steps a side.

    The error is below 0.26 degrees, and 0 for the axes; the length becomes 1. The zero vector, and with it what is not
    finite, has a code of its own. Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit
    Vectors".
    """
    values = values.astype(np.float32)
    size = np.abs(values).sum(axis=-1, keepdims=True)
    known = np.isfinite(size) & (size > 1e-6)
    x, y, z = np.moveaxis(np.where(known, values, 1) / np.where(known, size, 1), -1, 0)
    folded_x, folded_y = _fold(x, y)
    square = np.stack([np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y)], axis=-1)
    codes = np.round(_DIRECTION_LEVELS * (square + 1)).astype(np.uint16)
    return np.where(known, codes, np.uint16(2 * _DIRECTION_LEVELS + 1))


def decode_direction(codes: np.ndarray) -> np.ndarray:
    """float16 unit vectors [..., 3], or exactly 0."""
    x, y = np.moveaxis(codes.astype(np.float32) / _DIRECTION_LEVELS - 1, -1, 0)
    z = 1 - np.abs(x) - np.abs(y)
    folded_x, folded_y = _fold(x, y)
    values = np.stack([np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y), z], axis=-1)
    values /= np.linalg.norm(values, axis=-1, keepdims=True)
    return np.where(codes[..., :1] > 2 * _DIRECTION_LEVELS, 0, values).astype(np.float16)


def encode_distance(values: np.ndarray) -> np.ndarray:
    """uint16 codes of distances: 6 bits of exponent and 10 of mantissa, an error of at most 2^-11 of the value.

    ``FAR`` and all beyond have the code of ``FAR``, which is exact; NaN, negative and below 2^-32 are 0.
    """
    values = np.where(values > 0, values, 0).astype(np.float32)
    # As integers, positive floats are in the order of their values, and a carry from rounding is right as well.
    upper = (values.view(np.uint32).astype(np.int64) + (1 << 12)) >> 13
    codes = np.maximum(upper - _LOWEST, 0)
    return np.where(values >= FAR, _UNKNOWN, codes).astype(np.uint16)


def decode_distance(codes: np.ndarray) -> np.ndarray:
    """float32 distances."""
    values = ((codes.astype(np.uint32) + np.uint32(_LOWEST)) << 13).view(np.float32)
    return np.where(codes == _UNKNOWN, np.float32(FAR), np.where(codes == 0, np.float32(0), values))


def encode_vector(values: np.ndarray) -> np.ndarray:
    """uint16 codes of motion vectors in pixels: an error of at most 1 / 128 px, 0 for 0.

    What is not finite, or longer than 511 px, and thus outside of any crop, is NaN: there is no history.
    """
    steps = np.round(np.where(np.isfinite(values), values, 1e6) * np.float64(_VECTOR_STEPS))
    inside = np.abs(steps) <= 511 * _VECTOR_STEPS
    return np.where(inside, steps + (1 << 15), _UNKNOWN).astype(np.uint16)


def decode_vector(codes: np.ndarray) -> np.ndarray:
    """float32 vectors."""
    values = (codes.astype(np.float32) - (1 << 15)) / _VECTOR_STEPS
    return np.where(codes == _UNKNOWN, np.float32(np.nan), values)


class Code(NamedTuple):
    """How values of one kind are stored."""

    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]
    dtype: Any
    """Of the codes."""
    channels: int | None = None
    """The last axis of the codes; 0: there is none; None: that of the values."""
    slopes: tuple[int, ...] = ()
    """Axes along which codes change slowly, counted from the end: differences are stored."""


CODES: dict[str, Code] = {
    "light": Code(encode_light, decode_light, np.uint32, 0),
    # The noise of one sample is a hundred times the error of 7 bits.
    "sample": Code(lambda light: encode_light(light, 7), lambda codes: decode_light(codes, 7), np.uint32, 0),
    "fraction": Code(encode_fraction, decode_fraction, np.uint8),
    "direction": Code(encode_direction, decode_direction, np.uint16, 2),
    "distance": Code(encode_distance, decode_distance, np.uint16, slopes=(-2,)),
    "vector": Code(encode_vector, decode_vector, np.uint16, slopes=(-2, -3)),
    "flag": Code(lambda flags: flags.astype(np.uint8), lambda codes: codes.astype(bool), np.uint8),
    "id": Code(lambda ids: ids.view(np.uint32), lambda codes: codes.view(np.int32), np.uint32),
    "count": Code(lambda values: values.view(np.uint32), lambda codes: codes.view(np.float32), np.uint32),
    "signed": Code(lambda values: values.view(np.uint32), lambda codes: codes.view(np.float32), np.uint32),
}
"""Of each kind of buffer, and of single samples of light."""


def compress(codes: np.ndarray, slopes: tuple[int, ...] = ()) -> tuple[str, bytes]:
    """Codes without loss in few bytes, and the name of the way that made them fewest.

    LZMA of the integers as they are, LZMA of all first bytes, then all second ones ... (``planes``), or bzip2: noise,
    gradients and flat surfaces each prefer another.
    """
    for axis in slopes:
        codes = np.diff(codes, axis=axis, prepend=np.zeros_like(codes.take([0], axis)))  # modulo 2^bits
    codes = np.ascontiguousarray(codes)
    whole = codes.tobytes()
    found = {"words": _lzma(whole, codes.itemsize), "bzip2": bz2.compress(whole)}
    if codes.itemsize > 1:
        found["planes"] = _lzma(_bytes_of(codes).T.tobytes(), 1)
    return min(found.items(), key=lambda item: len(item[1]))


def decompress(way: str, data: bytes, dtype: Any, shape: tuple[int, ...], slopes: tuple[int, ...] = ()) -> np.ndarray:
    """The codes that :func:`compress` was given. Raises ValueError or LZMAError if ``data`` is not its result."""
    size = np.dtype(dtype).itemsize
    if way == "bzip2":
        whole = bz2.decompress(data)
    else:
        whole = lzma.decompress(data, lzma.FORMAT_RAW, filters=_filters(size if way == "words" else 1))
    if way == "planes":
        whole = np.frombuffer(whole, np.uint8).reshape(size, -1).T.tobytes()
    codes = np.frombuffer(whole, dtype).reshape(shape)
    for axis in reversed(slopes):
        codes = np.cumsum(codes, axis=axis, dtype=dtype)
    return codes


def _field(bits: int) -> int:
    return 9 if bits == 9 else 8


def _fold(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lower half of the octahedron, folded out to the corners of the square; its own inverse."""
    return (1 - np.abs(y)) * np.where(x < 0, -1, 1), (1 - np.abs(x)) * np.where(y < 0, -1, 1)


def _bytes_of(codes: np.ndarray) -> np.ndarray:
    return codes.reshape(-1, 1).view(np.uint8)


def _filters(size: int) -> list[dict[str, int]]:
    """LZMA for integers of ``size`` bytes: bytes are predicted by their place in the integer, or by the byte before."""
    place = size.bit_length() - 1
    return [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 0 if place else 3, "lp": place, "pb": place}]


def _lzma(data: bytes, size: int) -> bytes:
    return lzma.compress(data, lzma.FORMAT_RAW, filters=_filters(size))
