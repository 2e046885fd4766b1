"""Ctrl-C as a request to stop after the current piece of work, instead of an exception in the middle of it."""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


class Interrupt:
    """While it is entered, the first Ctrl-C only sets :attr:`asked`; a second one raises KeyboardInterrupt at once.

    Python receives signals in the main thread alone: in any other one this changes nothing.
    """

    def __init__(self, say: Callable[[], None]):
        """``say`` is called at the first Ctrl-C, so that it does not seem to be ignored."""
        self.asked = False
        self._say = say
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
        self._say()
