"""Errors that a person at a terminal can act on: one message, exit code 2, no traceback."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console


@contextmanager
def told_plainly() -> Iterator[None]:
    """Turn what a user can mend (wrong input, missing or unwritable file) into one message and exit code 2.

    Anything else is a mistake of ours and keeps its traceback. Ctrl-C ends with 130, as shells expect.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        message = str(error) if isinstance(error, ValueError) else _describe(error)
        Console(stderr=True).print(f"jaxdn: {message}", markup=False, highlight=False, style="red", soft_wrap=True)
        sys.exit(2)
    except ModuleNotFoundError as error:
        extra = {"mitsuba": "render", "drjit": "render"}.get((error.name or "").partition(".")[0], "train")
        Console(stderr=True).print(
            f"jaxdn: this needs the package {error.name!r}: pip install 'jaxdn[{extra}]'.",
            markup=False,
            highlight=False,
            style="red",
            soft_wrap=True,
        )
        sys.exit(2)
    except KeyboardInterrupt:
        Console(stderr=True).print("jaxdn: interrupted; what is finished is kept.", highlight=False)
        sys.exit(130)


def _describe(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"
