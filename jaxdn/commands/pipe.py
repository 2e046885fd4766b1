"""A reader that takes less than all (``jaxdn inspect CLIP | head``) ends the command, and without a word."""

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

EXIT_CODE = 141
"""Of a process whose reader has gone, as shells expect it: 128 and the number of SIGPIPE."""
_RICH = 1
"""What rich exits with where it has caught the error itself."""


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
        _end()
    except SystemExit as ended:
        if ended.code == _RICH and isinstance(ended.__context__, BrokenPipeError):
            _end()
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


def _end() -> None:
    """What such streams still hold goes nowhere: Python writes it at the end of the process."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in _without_reader():
        os.dup2(nowhere, stream.fileno())
    sys.exit(EXIT_CODE)
