"""Ctrl-C and SIGTERM: as requests to stop after the current piece of work; and Ctrl-C never lost."""

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
TERMINATED_EXIT_CODE = 143
"""Of a process that SIGTERM has ended: a batch system that takes its machine back, or its time is over."""
_AGAIN_S = 0.05


class Stopped(KeyboardInterrupt):
    """Ctrl-C, where the work has stopped for it after the current piece."""


class Terminated(Stopped):
    """SIGTERM, where it is handled as Ctrl-C is."""


class Interrupt:
    """While it is entered, the first Ctrl-C only sets :attr:`asked`; a second one raises KeyboardInterrupt at once.

    SIGTERM is a first Ctrl-C, however often it comes. Python receives signals in the main thread alone: in any other
    one this changes nothing.
    """

    def __init__(self, on_first: Callable[[], None]):
        """``on_first`` is called at the first signal, so that it does not seem to be ignored."""
        self.asked = False
        self.terminated = False
        """Whether it was SIGTERM that asked."""
        self._on_first = on_first
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Interrupt":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not Python's own

    def raise_if_asked(self) -> None:
        """Raise Stopped where the work stops, or Terminated if SIGTERM asked for it."""
        if self.asked:
            raise Terminated if self.terminated else Stopped

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.ask(terminated=number == signal.SIGTERM)

    def ask(self, *, terminated: bool) -> None:
        """What a first signal does; also of one that another process was sent."""
        if not self.asked:
            self.asked, self.terminated = True, terminated
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
        if ended.code in (EXIT_CODE, TERMINATED_EXIT_CODE):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(ended.code)
        raise
