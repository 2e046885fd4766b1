"""Python's search for garbage, put off while a program starts: imports and tracing make what stays."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def put_off_collection() -> Iterator[Callable[[], None]]:
    """No search for unused cycles of objects until the function that is given is called, or the block ends.

    Each search looks at all objects, of which jax alone brings half a million. What is there when it begins again is
    taken for needed: it is never looked at again. Nothing changes where searching is off already.
    """
    enabled = gc.isenabled()

    def begin() -> None:
        nonlocal enabled
        if enabled:
            gc.freeze()
            gc.enable()
            enabled = False

    gc.disable()
    try:
        yield begin
    finally:
        begin()
