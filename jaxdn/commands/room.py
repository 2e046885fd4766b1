"""How a frame fits into memory: whole, or in parts whose image is the same."""

import math
import os

from jaxdn.parts import GRID

HELD = 300
"""Bytes a pixel of a frame, however it is denoised: its buffers, the state before and after, the image, the file."""
STEP = 900
"""Bytes a pixel of what is denoised at once, in addition: a window, or the whole frame."""
PROGRAM = 0.6 * 2**30
"""Bytes of the program itself, with XLA and what it compiles. All three are upper bounds for the shipped methods on two
cores, by `python -m experiments.stability.memory`."""


def memory_of_machine() -> float:
    """Bytes of memory of this machine; infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # not on Unix
        return math.inf


def needed(height: int, width: int) -> float:
    """Bytes that denoising whole frames needs."""
    return PROGRAM + (HELD + STEP) * height * width


def side_within(limit: float, height: int, width: int) -> int | None:
    """The side of square windows with which frames are denoised within ``limit`` bytes; None: whole frames fit.

    It is 0 where even what windows leave out does not fit.
    """
    if needed(height, width) <= limit:
        return None
    left = limit - PROGRAM - HELD * height * width
    return int(math.sqrt(max(left, 0) / STEP)) // GRID * GRID
