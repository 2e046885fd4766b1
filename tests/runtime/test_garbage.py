"""When Python looks for garbage."""

import gc
import weakref
from collections.abc import Iterator

import pytest

from jaxdn.runtime.garbage import put_off_collection


class Cycle:
    """An object that only a search finds."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    yield
    gc.enable()


def make_garbage() -> weakref.ref[Cycle]:
    """A cycle without a user, and enough objects that Python would look for it."""
    found = weakref.ref(Cycle())
    kept: list[list[int]] = []
    while len(kept) < 2 * gc.get_threshold()[0]:
        kept.append([])
    return found


def test_nothing_is_searched_until_it_is_asked_for() -> None:
    with put_off_collection() as begin:
        early = make_garbage()
        assert early() is not None
        begin()
        assert gc.isenabled()
        late = make_garbage()
        assert late() is None, "searched again"
    assert early() is not None, "not looked at again"


def test_the_end_of_the_block_is_enough_also_by_an_error() -> None:
    with pytest.raises(ValueError, match="stop"), put_off_collection():
        raise ValueError("stop")
    assert gc.isenabled()


def test_what_is_off_stays_off() -> None:
    gc.disable()
    with put_off_collection() as begin:
        begin()
    assert not gc.isenabled()
