"""The timed workloads: one file for each kind, with ours and the peers as calls without arguments."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from experiments.speed.roofline import Cost
from experiments.speed.timing import Call


class Work(NamedTuple):
    """One workload with several implementations.

    ``ours`` and ``peers`` build calls, with their arrays, in processes of their own: they are functions of a module, or
    a ``functools.partial`` of one.
    """

    name: str
    ours: dict[str, Callable[[], Call]]
    peers: dict[str, Callable[[], Call]]
    roofline: Sequence[Cost]
    rounds: int = 5
    alone: Mapping[str, Callable[[], Any]] = MappingProxyType({})
    """Calls for measuring the peak memory, where they differ: for backends that keep memory between calls."""
    huge_pages: frozenset[str] = frozenset()
    """Implementations whose large buffers are in huge pages."""
