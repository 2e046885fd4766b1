"""Ctrl-C: as a request to stop after the current piece of work, and never lost."""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

EXIT_CODE = 130
"""Of a process that Ctrl-C has ended, as shells expect it."""
_AGAIN_S = 0.05


class Interrupt:
    """While it is entered, the first Ctrl-C only sets :attr:`asked`; a second one raises KeyboardInterrupt at once.

    Python receives signals in the main thread alone: in any other one this changes nothing.
    """

    def __init__(self, on_first: Callable[[], None]):
        """``on_first`` is called at the first Ctrl-C, so that it does not seem to be ignored."""
        self.asked = False
        self._on_first = on_first
        self._before: Any = None

    def __enter__(self) -> "Interrupt":
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        self._on_first()


@contextmanager
def keep_interrupts() -> Iterator[None]:
    """While it is entered, a KeyboardInterrupt that would be dropped, or become another error, arrives all the same.

    No exception leaves functions that Python calls between two lines of a program: callbacks of the garbage collector
    (jax has one) and ``__del__``. Ctrl-C in one of them would be printed as "Exception ignored", and the work go on: it
    is raised again a moment later. In a callback of a jitted program (:mod:`jaxdn.ops.dispatch.numba_call`) it becomes
    an error of XLA that ends with its name.
    """
    before = sys.unraisablehook
    again: threading.Timer | None = None

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        nonlocal again
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            before(dropped)
        elif again is None or not again.is_alive():
            # From a thread, as here it would be dropped again.
            again = threading.Timer(_AGAIN_S, _thread.interrupt_main)
            again.start()

    sys.unraisablehook = hook
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if str(error).rstrip().endswith("KeyboardInterrupt:"):
            raise KeyboardInterrupt from error
        raise
    finally:
        sys.unraisablehook = before


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """At Ctrl-C the process ends where this is left, all blocks inside being cleaned up, and waits for nothing else.

    Threads of XLA may still compile or run a program, which nobody can stop: as Python tears down what they use, one
    interrupt in four would end in a segmentation fault.
    """
    try:
        yield
    except SystemExit as ended:
        if ended.code == EXIT_CODE:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(EXIT_CODE)
        raise
