"""Loops compiled by processes of their own, side by side, while a program that calls them is traced and compiled.

Numba compiles one loop at a time in a process, and each takes half a second to two: a first run waits for twenty of
them. Here each process compiles into Numba's own files, and whoever calls a loop waits until its file is there. A
process that ends early costs time alone: a loop without a file is compiled where it is called.

Only inside :func:`loops_compiled_apart`, which commands enter: a library does not start processes unasked.
"""

import contextlib
import importlib.util
import os
import pickle
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from importlib.machinery import PathFinder
from typing import Any

import numpy as np

from jaxdn.runtime.cores import count_cores

_MOST = 4
"""Processes: a first frame has some twenty loops, and each process imports Numba first."""


class LoopCompiler:
    """A process that compiles the loops that it is told, in that order."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            # -P: the folder where a command runs may hold a pickle.py.
            [sys.executable, "-P", "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._to, self._from = self.process.stdin, self.process.stdout
        self._lock, self._waiting, self._ended = threading.Lock(), deque[Future[None]](), False
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()
        self.given = 0

    def compile(self, loop: tuple[str, str], signature: tuple[Any, ...]) -> Future[None]:
        """Have a loop (module, name) compiled; done with that, or with the end of the process."""
        done: Future[None] = Future()
        self.given += 1
        with self._lock:
            if self._ended:
                done.set_result(None)
                return done
            self._waiting.append(done)
        with contextlib.suppress(OSError):  # it has just ended: the reader says so
            pickle.dump((loop, signature), self._to)
            self._to.flush()
        return done

    def _read(self) -> None:
        """A byte for each loop; then the end."""
        while self._from.read(1):
            with self._lock:
                self._waiting.popleft().set_result(None)
        with self._lock:
            self._ended = True
            while self._waiting:
                self._waiting.popleft().set_result(None)

    def end(self) -> None:
        """End the process, whatever it does; what it has not finished is not kept."""
        self.process.kill()
        self.process.wait()
        self.reader.join()
        for pipe in (self._to, self._from):
            with contextlib.suppress(OSError):  # what the process has not read
                pipe.close()


class LoopCompilers:
    """Processes, started when they are needed, and what they were told."""

    def __init__(self) -> None:
        self.most = min(_MOST, count_cores())
        self.compilers: list[LoopCompiler] = []
        self._told: dict[tuple[tuple[str, str], tuple[Any, ...]], Future[None]] = {}
        self.places: dict[tuple[str, str], LoopCompiler] = {}
        self._lock = threading.Lock()

    def compile(self, loop: tuple[str, str], signature: tuple[Any, ...]) -> Future[None]:
        """Have a loop (module, name) compiled, once for a signature. Threads may call it at once."""
        with self._lock:
            if (loop, signature) not in self._told:
                try:
                    self._told[loop, signature] = self._compiler(loop).compile(loop, signature)
                except OSError:  # no further process may be started: the loop is compiled where it is called
                    self._told[loop, signature] = Future()
                    self._told[loop, signature].set_result(None)
            return self._told[loop, signature]

    def _compiler(self, loop: tuple[str, str]) -> LoopCompiler:
        """The one that has the fewest; the same for all signatures of a loop, as two cannot add to one file."""
        if loop not in self.places:
            if len(self.compilers) < self.most:
                self.compilers.append(LoopCompiler())
            self.places[loop] = min(self.compilers, key=lambda compiler: compiler.given)
        return self.places[loop]

    def end(self) -> None:
        """End all processes."""
        for compiler in self.compilers:
            compiler.end()


_active: LoopCompilers | None = None


@contextlib.contextmanager
def loops_compiled_apart() -> Iterator[LoopCompilers]:
    """While it is entered, loops that are not on disk are compiled by other processes, which end with it."""
    global _active
    if _active is not None:
        yield _active
        return
    _active = compilers = LoopCompilers()
    try:
        yield compilers
    finally:
        _active = None
        compilers.end()


def compile_apart(loop: Any, arguments: Sequence[Any]) -> Future[None] | None:
    """Have a loop compiled for such arguments by another process, if one may and there is no file of it.

    Returns what is done when that is; None where there is nothing to wait for. Of arrays only the types count.
    """
    if _active is None or not _is_left_to_compile(loop):
        return None
    from numba.core.typing.typeof import Purpose, typeof

    signature = tuple(typeof(argument, Purpose.argument) for argument in arguments)
    return _active.compile((loop.py_func.__module__, loop.py_func.__qualname__), signature)


def example(kind: Any, *, written: bool) -> np.ndarray:
    """An empty array of the type and the number of axes of ``kind``, as a loop gets it."""
    array = np.empty((0,) * len(kind.shape), kind.dtype)
    array.flags.writeable = written
    return array


def _is_left_to_compile(loop: Any) -> bool:
    """Whether files of a loop can be written, and there are none."""
    from jaxdn.ops.dispatch.numba_rows import KeptLoops

    cache = getattr(loop, "_cache", None)
    return type(cache) is KeptLoops and not cache.has_any()


def _compile_what_comes() -> None:
    """In a process of its own: a byte on standard output for each loop that standard input names, compiled or not."""
    replies = os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0)
    with open(os.devnull, "wb") as nowhere:  # what Numba prints is no reply
        os.dup2(nowhere.fileno(), sys.stdout.fileno())
    while True:
        try:
            (module, name), signature = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        # What cannot be compiled fails where it is called, with its own words.
        with contextlib.suppress(Exception):
            getattr(_import_alone(module), name).compile(signature)
        replies.write(b".")


def _import_alone(name: str) -> Any:
    """A module, without running the packages that it is in: some import jax, which takes as long as two loops."""
    folders = None
    for end in (at for at, letter in enumerate(name) if letter == "."):
        spec = PathFinder.find_spec(name[:end], folders)
        if spec is None:  # in an archive, or of another finder
            break
        sys.modules.setdefault(name[:end], importlib.util.module_from_spec(spec))
        folders = spec.submodule_search_locations
    return importlib.import_module(name)


if __name__ == "__main__":
    _compile_what_comes()
