"""Shows how many frames of many clips are rendered: a bar in a terminal, a line per tenth elsewhere."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any


def open_counter(
    progress: bool | Callable[[int, int], None], total: int
) -> AbstractContextManager[Callable[[int, int], None]]:
    """A function of the frames done and their total: True shows them, False is quiet, a function is given back."""
    if progress is not True:
        return nullcontext(progress if callable(progress) else lambda done, total: None)
    return _Bar(total)


class _Bar:
    """A progress bar: frames done, total, elapsed and remaining time."""

    def __init__(self, total: int) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

        columns: Sequence[Any] = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self._bar = Progress("rendering frames", *columns)
        self._bar.disable = not self._bar.console.is_terminal
        self._task = self._bar.add_task("frames", total=total)
        self._tenths = -1

    def __enter__(self) -> Callable[[int, int], None]:
        self._bar.start()
        return self._show if self._bar.console.is_terminal else self._say

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _show(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total)

    def _say(self, done: int, total: int) -> None:
        """Print a line per tenth where there is no terminal for a bar."""
        self._show(done, total)
        if 10 * done // max(total, 1) > self._tenths:
            self._tenths = 10 * done // max(total, 1)
            print(f"rendered {done} of {total} frames", flush=True)
