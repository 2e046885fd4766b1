"""Calls in processes of their own, each of which runs only in its turns.

Engines in one process slow each other down even while they do nothing: their libraries bring pools of threads and
settings of their own. Here each call is built in a new process, which is stopped (SIGSTOP, where there are signals)
until its next turn.
"""

import contextlib
import ctypes
import os
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from experiments.speed.timing import Call, interleave, milliseconds, peak_mib, status_mib

TURN_MS = 100.0
"""Short calls are repeated until a turn has taken this long."""
LIMIT_S = 600.0
"""For one answer; the first call compiles."""
HUGE_PAGES = "glibc.malloc.hugetlb"
"""The setting with which glibc asks for huge pages for large buffers."""
_DEATH_OF_PARENT = 1  # PR_SET_PDEATHSIG


class WorkerError(Exception):
    """Why a worker could not do what it was asked, in one line."""


class Process:
    """A new Python process, stopped except while it answers.

    ``held`` is sent to it at once, so that the modules that it needs are imported while other processes start. Large
    buffers are in huge pages only with ``huge_pages``, whatever this process was started with.
    """

    def __init__(self, held: Any = None, *, huge_pages: bool = False) -> None:
        with _tunables(huge_pages):
            self._pool = ProcessPoolExecutor(1, get_context("spawn"), initializer=_end_with, initargs=(os.getpid(),))
            self._pid: Future[int] = self._pool.submit(_receive, held)  # starts it

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function(*arguments)`` there.

        Raises :class:`WorkerError` where the function raises, or the process has ended or does not answer; it can only
        be closed then.
        """
        with _in_one_line():
            pid = self._pid.result(LIMIT_S)
            _send(pid, "SIGCONT")
            try:
                return self._pool.submit(_safely, function, *arguments).result(LIMIT_S)
            finally:
                _send(pid, "SIGSTOP")

    def close(self) -> None:
        """End it, whatever it is doing."""
        with contextlib.suppress(BrokenProcessPool, TimeoutError):
            self._pool.submit(os.getpid)  # raises where it has ended: another process may have its number now
            _send(self._pid.result(LIMIT_S), "SIGKILL" if hasattr(signal, "SIGKILL") else "SIGTERM")
        self._pool.shutdown()


class Worker(Process):
    """``build()`` in a new process, and calls of what it returns.

    ``build`` is pickled: a function of a module, or a ``functools.partial`` of one.
    """

    def __init__(self, build: Callable[[], Call], *, huge_pages: bool = False) -> None:
        super().__init__(build, huge_pages=huge_pages)

    def ready(self) -> None:
        """Wait until the process has started, which includes its imports."""
        self.ask(os.getpid)

    def first(self) -> tuple[float, float | None]:
        """Build the call and make it once: its milliseconds, with compilation, and the process's peak memory in MiB."""
        return self.ask(_first)

    def turn(self) -> float:
        """Milliseconds of a call; of short ones, the median of several.

        A call before them is not counted: it wakes up the threads, and brings back what the system took of the stopped
        process's memory (a frame of ``steady-balanced`` took 1,329 ms with it, and 1,042 ms without).
        """
        return self.ask(_turn)

    def peak(self, alone: Callable[[], Any] | None = None) -> float | None:
        """Memory of one call, or of ``alone``, in MiB: see :func:`experiments.speed.timing.peak_mib`."""
        return self.ask(_peak, alone)


class Team:
    """The workers of one workload, of which one runs at a time. What fails is closed and said, and the rest goes on."""

    def __init__(self, title: str, say: Callable[[str], None]) -> None:
        self._title, self._say = title, say
        self._workers: dict[str, Worker] = {}
        self._most_mib = 0.0

    def __enter__(self) -> "Team":
        return self

    def __exit__(self, *reason: object) -> None:
        for worker in self._workers.values():
            worker.close()

    def start(self, builds: Mapping[str, Callable[[], Call]], huge_pages: Collection[str] = ()) -> dict[str, float]:
        """Start a process for each, all at once, then build and call one after the other: milliseconds of the calls."""
        for name, build in builds.items():
            self._workers[name] = Worker(build, huge_pages=name in huge_pages)
        for name in builds:
            self._ask(name, Worker.ready)
        first = {name: self._ask(name, self._first) for name in builds}
        return {name: ms for name, ms in first.items() if ms is not None}

    def turns(self, *, rounds: int, budget_s: float) -> dict[str, list[float]]:
        """The milliseconds of every turn, of those that never failed."""
        turns = {name: partial(self._ask, name, Worker.turn) for name in self._workers}
        samples = interleave(turns, rounds=rounds, budget_s=budget_s)
        return {name: samples[name] for name in self._workers}

    def peak(self, name: str, alone: Callable[[], Any] | None) -> float | None:
        """Memory of one call of a worker that is left, in MiB; None where it is not known."""
        try:
            return self._workers[name].peak(alone)
        except WorkerError as error:
            self._say(f"{self._title}: the memory of {name} is not known: {error}")
            return None

    def _first(self, worker: Worker) -> float:
        free = available_mib()
        if free is not None and free < self._most_mib:
            raise WorkerError(
                f"{free:.0f} MiB of memory are free, and another implementation took {self._most_mib:.0f}"
            )
        ms, peak = worker.first()
        self._most_mib = max(self._most_mib, peak or 0.0)
        return ms

    def _ask(self, name: str, question: Callable[[Worker], Any]) -> Any:
        """The worker's answer; None where it fails now or failed before."""
        if name not in self._workers:
            return None
        try:
            return question(self._workers[name])
        except WorkerError as error:
            self._say(f"{self._title}: {name} is left out: {error}")
            self._workers.pop(name).close()
            return None


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)`` in a new process; raises :class:`WorkerError`."""
    with contextlib.closing(Process()) as process:
        return process.ask(function, *arguments)


def available_mib() -> float | None:
    """Memory that new programs can use without swapping; None where the system does not report it (only Linux does)."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) / 1024
    return None


@contextlib.contextmanager
def _tunables(huge_pages: bool) -> Iterator[None]:
    """Processes started inside have huge pages or not: glibc reads its settings when a program starts."""
    before = os.environ.get("GLIBC_TUNABLES")
    kept = [each for each in (before or "").split(":") if each and not each.startswith(HUGE_PAGES)]
    os.environ["GLIBC_TUNABLES"] = ":".join([*kept, *([f"{HUGE_PAGES}=1"] if huge_pages else [])])
    try:
        yield
    finally:
        del os.environ["GLIBC_TUNABLES"]
        if before is not None:
            os.environ["GLIBC_TUNABLES"] = before


@contextlib.contextmanager
def _in_one_line() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool:
        raise WorkerError("its process ended, perhaps for want of memory") from None
    except TimeoutError:
        raise WorkerError(f"no answer within {LIMIT_S:.0f} s") from None


def _send(pid: int, name: str) -> None:
    with contextlib.suppress(ProcessLookupError):
        if hasattr(signal, name):
            os.kill(pid, getattr(signal, name))


# What follows runs in the new process.

_own: dict[str, Any] = {}
"""The ``build`` and, once built, the ``call``."""


def _end_with(parent: int) -> None:
    """End this process when its parent ends, even if it is stopped then; the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DEATH_OF_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            sys.exit()


def _safely(function: Callable[..., Any], *arguments: Any) -> Any:
    """Some exceptions of libraries cannot be sent to another process."""
    try:
        return function(*arguments)
    except (ImportError, ValueError) as error:
        raise WorkerError(str(error)) from None
    except Exception as error:
        raise WorkerError(f"{type(error).__name__}: {error}") from None


def _receive(held: Any) -> int:
    _own["build"] = held
    return os.getpid()


def _first() -> tuple[float, float | None]:
    _own["call"] = _own["build"]()
    return milliseconds(_own["call"]), status_mib("VmHWM")


def _turn() -> float:
    milliseconds(_own["call"])
    times, began = [milliseconds(_own["call"])], time.perf_counter()
    while 1e3 * (time.perf_counter() - began) + 2 * times[0] < TURN_MS:
        times.append(milliseconds(_own["call"]))
    return float(np.median(times))


def _peak(alone: Callable[[], Any] | None) -> float | None:
    return peak_mib(alone or _own["call"])
