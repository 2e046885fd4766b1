"""How long a thread of Python goes on while another one waits for its turn."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

TURN_S = 0.0005


@contextmanager
def short_turns() -> Iterator[None]:
    """While it is entered, a thread lets another one in after half a millisecond, where Python has five by itself.

    Programs call loops and libraries from threads of their own, some fifty times a frame. Where a frame is read or
    written meanwhile, or a program traced, each of these calls may wait for a turn.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, TURN_S))
    try:
        yield
    finally:
        sys.setswitchinterval(before)
