"""How a frame fits into memory: whole, or in tiles whose image is the same."""

import math
import os

from jaxdn.denoiser.tiles import GRID

GIB = 2**30
PROGRAM = 0.6 * GIB
"""Bytes of the program itself, with XLA and what it compiles."""
HELD = 140
"""Bytes a pixel of what is there however a frame is denoised: its buffers, the state before and after, the image."""
CHANNEL = 8
"""Bytes a pixel of each channel of a file while it is written and read back."""
STEP = 1100
"""Bytes a pixel of what is denoised at once, a window or the whole frame. All four are upper bounds for the shipped
methods on two cores, by ``python -m experiments.stability.memory``."""


def measure_machine_memory() -> float:
    """Bytes of memory of this machine; infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # not on Unix
        return math.inf


def estimate_bytes(height: int, width: int, channels: int) -> float:
    """Bytes that denoising whole frames needs, of files with so many channels."""
    return _beside_step(height, width, channels) + STEP * height * width


def choose_tile_side(limit: float, height: int, width: int, channels: int) -> int | None:
    """The side of square tiles with which frames are denoised within ``limit`` bytes; None: whole frames fit.

    It is 0 where even what tiles leave out does not fit.
    """
    if estimate_bytes(height, width, channels) <= limit:
        return None
    left = limit - _beside_step(height, width, channels)
    return int(math.sqrt(max(left, 0) / STEP)) // GRID * GRID


def _beside_step(height: int, width: int, channels: int) -> float:
    return PROGRAM + (HELD + CHANNEL * channels) * height * width
