"""Errors that a user at a terminal can act on: one message, exit code 2, no traceback."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from rich.console import Console

from jaxdn.commands.pipe import reader_has_gone
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.runtime.interrupt import EXIT_CODE, keep_interrupts
from jaxdn.runtime.optional import find_group, install


@contextmanager
def plain_errors() -> Iterator[None]:
    """Turn errors that a user can fix (wrong input, missing or unwritable file) into one message and exit code 2.

    Anything else is a bug and keeps its traceback. Ctrl-C ends with exit code 130, as shells expect. Warnings are one
    line each, without the place in the code.
    """
    before = warnings.formatwarning
    warnings.formatwarning = _line
    try:
        with keep_interrupts():
            yield
    except (ValueError, RenderError) as error:
        _end(str(error))
    except OSError as error:
        if isinstance(error, BrokenPipeError) and reader_has_gone():
            raise  # nobody is there to read a message: `jaxdn ... | head`
        where = f"{error.filename}: " if error.filename else ""
        _end(f"{where}{error.strerror or error}")
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = find_group(package)
        if extra is None:
            raise
        _end(f"this needs the package {package!r}, which is not installed: {install(extra)}")
    except KeyboardInterrupt:
        Console(stderr=True).print("jaxdn: interrupted; what is finished is kept.", highlight=False)
        sys.exit(EXIT_CODE)
    finally:
        warnings.formatwarning = before


def _line(message: Warning | str, *place: Any, **more: Any) -> str:
    return f"jaxdn: {message}\n"


def _end(message: str) -> NoReturn:
    Console(stderr=True, style="red").print(f"jaxdn: {message}", markup=False, highlight=False, soft_wrap=True)
    sys.exit(2)
