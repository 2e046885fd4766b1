"""Terminals and pipes that cannot show every letter: what is printed never ends a run."""

import sys


def print_any_letter() -> None:
    """Letters that stdout or stderr cannot encode are printed as ``\\u5f71`` or ``\\xfc``, instead of raising.

    A pipe of Windows takes the letters of cp1252, a Linux without a locale those of ASCII; names of files may have any,
    and bytes that are no letters at all (Python's surrogate escapes) nowhere have a code.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # None where the shell has closed it; tests and notebooks have their own
            stream.reconfigure(errors="backslashreplace")
