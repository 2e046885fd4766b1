"""Text on terminals and pipes: as it is, and also where they cannot show every letter."""

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


def plain_console(**options: Any) -> "Console":
    """A console that prints text as it is: ``[red]`` and ``:cat:`` in names of files and layers are no markup."""
    from rich.console import Console

    return Console(markup=False, emoji=False, highlight=False, **options)


def print_any_letter() -> None:
    """Letters that stdout or stderr cannot encode are printed as ``\\u5f71`` or ``\\xfc``, instead of raising.

    A pipe of Windows takes the letters of cp1252, a Linux without a locale those of ASCII; names of files may have any,
    and bytes that are no letters at all (Python's surrogate escapes) nowhere have a code.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # None where the shell has closed it; tests and notebooks have their own
            stream.reconfigure(errors="backslashreplace")
