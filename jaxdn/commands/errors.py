"""Errors that a person at a terminal can act on: one message, exit code 2, no traceback."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from rich.console import Console


@contextmanager
def told_plainly() -> Iterator[None]:
    """Turn what a user can mend (wrong input, missing or unwritable file) into one message and exit code 2.

    Anything else is a mistake of ours and keeps its traceback. Ctrl-C ends with 130, as shells expect.
    """
    try:
        yield
    except ValueError as error:
        _tell(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _tell(f"{where}{error.strerror or error}")
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = "render" if package in ("mitsuba", "drjit") else "train"
        _tell(f"this needs the package {package!r}: pip install 'jaxdn[{extra}]'.")
    except RuntimeError as error:
        from jaxdn.render.clip import RenderError

        if not isinstance(error, RenderError):
            raise
        _tell(str(error))
    except KeyboardInterrupt:
        Console(stderr=True).print("jaxdn: interrupted; what is finished is kept.", highlight=False)
        sys.exit(130)


def _tell(message: str) -> NoReturn:
    Console(stderr=True, style="red").print(f"jaxdn: {message}", markup=False, highlight=False, soft_wrap=True)
    sys.exit(2)
