"""The platform that a program is traced for: jax's own, or any, for a program that leaves this process.

Which of several formulations of the same maths is fast depends on the platform: on CPUs work runs by strips of rows
that fit into the cache, and the number of strips depends on the image's size. A program that is exported should run
anywhere and for images of any size, so it is traced without all of that.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax

ANY = "any"
"""The platform of portable programs."""


class NotPortableError(ValueError):
    """What was traced inside :func:`portable` runs in this process alone."""


_portable: ContextVar[bool] = ContextVar("portable", default=False)


def platform() -> str:
    """``"cpu"``, ``"gpu"`` or ``"tpu"``, where jax computes; :data:`ANY` inside :func:`portable`."""
    return ANY if _portable.get() else jax.default_backend()


@contextmanager
def portable() -> Iterator[None]:
    """Inside, programs are traced for any platform: reference implementations, and no strips."""
    token = _portable.set(True)
    try:
        yield
    finally:
        _portable.reset(token)
