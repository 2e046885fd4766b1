"""Memory that a process frees and takes again for every frame: kept, or given back to the system."""

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -4, -8
"""Parameters of glibc's ``mallopt``."""
_NEVER = -1


def tune_malloc() -> bool:
    """Let this process keep the memory that it has freed; whether the C library can (glibc on Linux).

    XLA allocates the arrays of a program anew at every call. Large ones come from the system, which clears every page
    of them: with 720p frames that is a sixth of the time. To be called before jax starts its threads.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library
        return False
    return all([option(_MMAP_MAX, 0), option(_TRIM_THRESHOLD, _NEVER), option(_ARENA_MAX, 1)])


def trim_malloc() -> None:
    """Hand freed memory back to the system: small pieces stay with the process otherwise."""
    if sys.platform.startswith("linux"):
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
        if trim is not None:
            trim(0)
