"""How far a command is: a bar with the time left in a terminal, one line per frame in the log of a farm."""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from jaxdn.runtime.terminal import plain_console

_VARIABLE = "JAXDN_PROGRESS"
"""Environment variable: ``openjd`` prints lines for Open Job Description too."""
_RECENT = 9
"""Frames that the time left is estimated from; not the first one, which takes the compiler's time too."""


class Reporter(NamedTuple):
    """What a command tells while it works."""

    on_frame: Callable[[Path, int, int], None]
    """A file was written: the file, how many are done, of how many."""
    log: Callable[[str], None]
    """Any other line."""


@contextmanager
def reporter(title: str, console: Console | None = None) -> Iterator[Reporter]:
    """A bar on the standard error of a terminal; without one, plain lines without any control characters."""
    console = plain_console(stderr=True) if console is None else console
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(title, total=None)

            def advance(path: Path, done: int, total: int) -> None:
                progress.update(task, completed=done, total=total, description=f"{title}: {path.name}")

            yield Reporter(
                advance, lambda line: progress.console.print(line, markup=False, emoji=False, highlight=False)
            )
        return
    took: deque[float] = deque(maxlen=_RECENT)
    last = time.monotonic()

    def line(path: Path, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        seconds, last = now - last, now
        if done > 1:
            took.append(seconds)
        left = f", about {_duration(median(took) * (total - done))} left" if took and done < total else ""
        # Deadline looks for "Progress: 6%" in what a task prints; OpenJD for a line of its own.
        print(f"frame {done} of {total}: {path}, {seconds:.1f} s{left}; Progress: {100 * done // total}%", flush=True)
        if os.environ.get(_VARIABLE) == "openjd":
            print(f"openjd_progress: {100 * done / total:.1f}", flush=True)

    yield Reporter(line, lambda text: print(text, flush=True))


def _duration(seconds: float) -> str:
    """``45 s``, ``12 min``, ``3 h 20 min``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
