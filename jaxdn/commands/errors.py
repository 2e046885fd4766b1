"""How a command ends: with one message and exit code 2 where a user can act on an error, and never with a traceback.

A reader that takes less than all (``jaxdn inspect CLIP | head``) ends it too, and without a word.
"""

import os
import select
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TextIO

from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.runtime.interrupt import EXIT_CODE, TERMINATED_EXIT_CODE, Terminated, keep_interrupts
from jaxdn.runtime.optional import find_group, install
from jaxdn.runtime.terminal import plain_console

NO_READER = 141
"""Of a process whose reader has gone, as shells expect it: 128 and the number of SIGPIPE."""
_FULL = "RESOURCE_EXHAUSTED"
"""What XLA's message has where memory is full, of a GPU or of the machine."""
_OIDN = "Open Image Denoise: "
"""What the message of that library begins with (:mod:`jaxdn.ops.oidn`)."""
_RICH = 1
"""What rich exits with where it has caught the error itself."""


@contextmanager
def plain_errors() -> Iterator[None]:
    """Turn errors that a user can fix (wrong input, missing or unwritable file) into one message and exit code 2.

    Anything else is a bug and keeps its traceback. Ctrl-C ends with exit code 130, as shells expect, and SIGTERM, where
    it is handled, with 143. Warnings are one line each, without the place in the code.
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
        named = error.filename2 or error.filename  # of a rename the new name: the old one may be a hidden file of ours
        where = f"{named}: " if named else ""
        _end(f"{where}{error.strerror or error}")
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = find_group(package)
        if extra is None:
            raise
        _end(f"this needs the package {package!r}, which is not installed: {install(extra)}")
    except KeyboardInterrupt as interrupt:
        plain_console(stderr=True).print("jaxdn: interrupted; what is finished is kept.")
        sys.exit(TERMINATED_EXIT_CODE if isinstance(interrupt, Terminated) else EXIT_CODE)
    finally:
        warnings.formatwarning = before


@contextmanager
def computing_errors(remedy: str) -> Iterator[None]:
    """Raise ValueError, with what to change, for full memory and for a failure of Open Image Denoise.

    ``remedy`` names the options by which a command needs less memory, or another method. XLA raises RuntimeError for
    both: of a failure in a callback the message holds that of the library.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        lines = str(error).splitlines() or [type(error).__name__]
        if isinstance(error, MemoryError) or _FULL in str(error):
            full = next((line for line in lines if _FULL in line), lines[0])
            raise ValueError(f"memory is full ({full[:200]}); give {remedy}.") from error
        failed = next((line[line.index(_OIDN) :] for line in lines if _OIDN in line), None)
        if failed is None:
            raise
        raise ValueError(f"{failed}; give {remedy}.") from error


def _line(message: Warning | str, *place: Any, **more: Any) -> str:
    return f"jaxdn: {message}\n"


def _end(message: str) -> NoReturn:
    plain_console(stderr=True, style="red").print(f"jaxdn: {message}", soft_wrap=True)
    sys.exit(2)


@contextmanager
def end_with_reader() -> Iterator[None]:
    """Where the reader of stdout or stderr has gone, the process ends with exit code 141 at what is written next.

    All of stdout is written when this is left: Python would write the rest at the end of the process, and print what
    fails there. Other failures keep their exit code.
    """
    try:
        try:
            yield
        except SystemExit as ended:
            if ended.code:
                raise
        _flush()
    except BrokenPipeError:
        if not _without_reader():
            raise
        _end_silently()
    except SystemExit as ended:
        if ended.code == _RICH and isinstance(ended.__context__, BrokenPipeError):
            _end_silently()
        raise


def _flush() -> None:
    """Raises BrokenPipeError alone: Python tells of other failures, as a full disk, at the end of the process."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError:
        pass


def reader_has_gone() -> bool:
    """Whether a BrokenPipeError can come from stdout or stderr, and not from a pipe to another process of ours.

    Always False on Windows, where Python cannot tell.
    """
    return bool(_without_reader())


def _without_reader() -> list[TextIO]:
    """Streams are None where the shell has closed them (``>&-``)."""
    return [stream for stream in (sys.stdout, sys.stderr) if stream is not None and _has_no_reader(stream)]


def _has_no_reader(stream: TextIO) -> bool:
    if not hasattr(select, "poll"):
        return False
    poll = select.poll()
    poll.register(stream.fileno(), 0)  # asks for no event: that nobody reads is told unasked
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _end_silently() -> None:
    """What such streams still hold goes nowhere: Python writes it at the end of the process."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in _without_reader():
        os.dup2(nowhere, stream.fileno())
    sys.exit(NO_READER)
