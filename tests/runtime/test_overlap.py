"""Reading ahead and writing behind: at the same time, in order, with bounded memory, and nothing left unfinished."""

import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from jaxdn.runtime.overlap import Behind, read_ahead

Log = Callable[[str], None]
WAIT_S = 30


class Item:
    """Something that a weak reference can point to."""

    def __init__(self, number: int) -> None:
        self.number = number


def test_the_next_item_is_made_while_the_caller_has_one() -> None:
    """Else it would wait here until the time is over."""
    begun = [threading.Event() for _ in range(4)]

    def read(log: Log) -> Iterator[int]:
        for number, event in enumerate(begun):
            event.set()
            yield number

    with read_ahead(read, print) as items:
        for number in items:
            assert all(event.wait(WAIT_S) for event in begun[: number + 2])


def test_no_more_than_two_items_are_held() -> None:
    alive: weakref.WeakSet[Item] = weakref.WeakSet()
    most = 0

    def read(log: Log) -> Iterator[Item]:
        nonlocal most
        for number in range(20):
            alive.add(item := Item(number))
            most = max(most, len(alive))
            yield item
            del item

    with read_ahead(read, print) as items:
        numbers = []
        while (item := next(items, None)) is not None:
            numbers.append(item.number)
            del item
    assert numbers == list(range(20))
    assert most == 2
    assert not alive


@pytest.mark.parametrize("beside", [True, False])
def test_lines_and_errors_come_in_the_place_of_their_item(beside: bool) -> None:
    told: list[Any] = []

    def read(log: Log) -> Iterator[int]:
        for number in range(3):
            log(f"about {number}")
            yield number
        log("before the end")
        raise ValueError("broken")

    with read_ahead(read, told.append, beside=lambda first: beside) as items, pytest.raises(ValueError, match="broken"):
        told.extend(items)
    assert told == ["about 0", 0, "about 1", 1, "about 2", 2, "before the end"]


def test_without_room_items_are_made_when_they_are_asked_for() -> None:
    made: list[int] = []
    asked: list[int] = []

    def read(log: Log) -> Iterator[int]:
        for number in range(3):
            made.append(number)
            yield number

    def beside(first: int) -> bool:
        asked.append(first)
        return False

    with read_ahead(read, print, beside=beside) as items:
        for number in items:
            assert made == list(range(number + 1))
            assert not _threads("jaxdn-read")
    assert asked == [0]


def test_what_is_being_read_is_waited_for_where_the_block_ends() -> None:
    go = threading.Event()
    ended: list[str] = []

    def read(log: Log) -> Iterator[int]:
        yield 0
        go.wait(WAIT_S)
        ended.append("read")
        yield 1

    def interrupt() -> None:
        with read_ahead(read, print) as items:
            next(items)
            go.set()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert ended == ["read"]
    assert not _threads("jaxdn-read")


def test_calls_are_made_in_order_beside_the_caller() -> None:
    go, told = threading.Event(), list[Any]()

    def call(number: int) -> int:
        assert go.wait(WAIT_S)
        told.append(f"call {number}")
        return number

    with Behind[int]() as behind:
        behind.start(lambda: call(0), told.append)
        told.append("the caller goes on")
        go.set()
        for number in (1, 2):
            behind.start(lambda number=number: call(number), told.append)
    told_by_calls = [line for line in told if isinstance(line, str)]
    assert told_by_calls == ["the caller goes on", "call 0", "call 1", "call 2"]
    assert [line for line in told if isinstance(line, int)] == [0, 1, 2]
    assert told.index(0) < told.index("call 2")


def test_a_call_that_is_not_made_beside_is_finished_when_it_returns() -> None:
    told: list[int] = []
    with Behind[int]() as behind:
        behind.start(threading.get_ident, told.append, beside=False)
        assert told == [threading.get_ident()]


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_what_is_begun_is_finished_whatever_ends_the_block(kind: type[BaseException]) -> None:
    """Its result is given after an error: a frame that is written counts. After Ctrl-C nobody asks."""
    go, told = threading.Event(), list[str]()

    def call() -> str:
        go.wait(WAIT_S)
        told.append("written")
        return "given"

    def interrupt() -> None:
        with Behind[str]() as behind:
            behind.start(call, told.append)
            go.set()
            raise kind

    with pytest.raises(kind):
        interrupt()
    assert told == (["written", "given"] if kind is ValueError else ["written"])
    assert not _threads("jaxdn-write")


def test_an_error_of_a_call_comes_with_the_next_one_and_that_one_is_not_made() -> None:
    told: list[str] = []

    def fail() -> str:
        raise OSError(28, "No space left on device")

    with Behind[str]() as behind:
        behind.start(fail, told.append)
        with pytest.raises(OSError, match="No space left"):
            behind.start(lambda: "made all the same", told.append)
    assert told == []


def _threads(name: str) -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith(name)]
