"""Reading ahead and writing behind: the disk and its compression beside the work, in threads, with bounded memory.

Both keep the order of everything that is told or raised: only time differs from doing one thing after the other.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

_T = TypeVar("_T")
_END: Any = object()


@contextmanager
def read_ahead(
    read: Callable[[Callable[[str], None]], Iterator[_T]],
    log: Callable[[str], None],
    *,
    beside: Callable[[_T], bool] = lambda first: True,
) -> Iterator[Iterator[_T]]:
    """What ``read`` gives, where each next item is made in a thread while the caller works on one.

    There are never more than two items: the caller's and the next. What ``read`` logs about an item, and an exception
    that it raises in place of one, come when the caller asks for that item. Where the block ends, the item that is
    being made is waited for, and dropped.

    Args:
      read: gives the items; called with a function for lines.
      log: called with these lines, in the caller's thread.
      beside: asked with the first item; where it says no, all others are made when they are asked for.
    """
    with ThreadPoolExecutor(1, "jaxdn-read") as pool:
        yield _Ahead(read, log, beside, pool)


class _Ahead(Iterator[_T]):
    """The items, each started as soon as the one before it is there."""

    def __init__(
        self,
        read: Callable[[Callable[[str], None]], Iterator[_T]],
        log: Callable[[str], None],
        beside: Callable[[_T], bool],
        pool: ThreadPoolExecutor,
    ) -> None:
        self._lines: list[str] = []
        self._items = read(self._lines.append)
        self._log, self._ask, self._pool = log, beside, pool
        self._beside: bool | None = None
        self._next: Future[_T] | None = None

    def __next__(self) -> _T:
        waiting, self._next = self._next, None
        try:
            item = next(self._items) if waiting is None else waiting.result()
        finally:
            lines = self._lines.copy()
            self._lines.clear()
            for line in lines:
                self._log(line)
        if item is _END:
            raise StopIteration
        if self._beside is None:
            self._beside = self._ask(item)
        if self._beside:
            self._next = self._pool.submit(next, self._items, _END)
        return item


class Behind(Generic[_T]):
    """Makes calls in a thread, one at a time, while the caller goes on with what comes next.

    As a context, it leaves none unfinished: the last call is waited for, and its result given, unless Ctrl-C ends the
    block. Then it is only waited for, so that it cleans up.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "jaxdn-write")
        self._pending: tuple[Future[_T], Callable[[_T], None]] | None = None

    def __enter__(self) -> "Behind[_T]":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None or issubclass(kind, Exception):
                self.finish()
        finally:
            self._pool.shutdown()

    def start(self, call: Callable[[], _T], done: Callable[[_T], None], *, beside: bool = True) -> None:
        """Make a call when the one before is finished; ``done`` gets its result, in the caller's thread, later.

        Without ``beside`` the call is made at once, in the caller's thread too.
        """
        self.finish()
        if beside:
            self._pending = self._pool.submit(call), done
        else:
            done(call())

    def finish(self) -> None:
        """Wait for the call that was started last, if its result has not been given yet. Raises what it raised."""
        if self._pending is not None:
            (future, done), self._pending = self._pending, None
            done(future.result())
