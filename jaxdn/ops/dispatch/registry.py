"""Selects the implementation of an operation: the fastest on the platform, or the named one."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxdn.core.platform import platform


class _Implementation(NamedTuple):
    function: Callable[..., Any]
    preferred_on: tuple[str, ...]
    requires: Callable[[], None]


_IMPLEMENTATIONS: dict[str, dict[str, _Implementation]] = {}


def register(
    operation: str, name: str, *, preferred_on: tuple[str, ...] = (), requires: Callable[[], None] = lambda: None
) -> Callable[[Any], Any]:
    """Decorator: make a function the implementation ``name`` of ``operation``.

    ``preferred_on`` are the platforms (``"cpu"``, ``"gpu"``, ``"tpu"``) on which None selects it. ``requires`` raises
    ValueError, with what is missing, if the implementation cannot run.
    """

    def keep(function: Callable[..., Any]) -> Callable[..., Any]:
        _IMPLEMENTATIONS.setdefault(operation, {})[name] = _Implementation(function, preferred_on, requires)
        return function

    return keep


def implementations(operation: str) -> tuple[str, ...]:
    """The names of an operation's implementations; ``"reference"`` is always one."""
    return tuple(_IMPLEMENTATIONS[operation])


def resolve(operation: str, implementation: str | None) -> Callable[..., Any]:
    """The function that runs: the named one, or with None the one preferred on :func:`jaxdn.core.platform.platform`.

    Resolved during tracing, so the choice costs nothing at run time. There is no fallback: ValueError for a name that
    does not exist or cannot run.
    """
    known = _IMPLEMENTATIONS[operation]
    if implementation is None:
        here = platform()
        preferred = (candidate.function for candidate in known.values() if here in candidate.preferred_on)
        return next(preferred, known["reference"].function)
    if implementation not in known:
        raise ValueError(
            f"implementation of {operation}: expected None or one of {', '.join(map(repr, known))}, got "
            f"{implementation!r}."
        )
    known[implementation].requires()
    return known[implementation].function
