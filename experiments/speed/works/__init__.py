"""What is timed: one file for each kind of work, each with ours and its peers behind calls without arguments."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from experiments.speed.roofline import Cost
from experiments.speed.timing import Call


class Work(NamedTuple):
    """One piece of work done in several ways. ``ours`` and ``peers`` make a call when asked: arrays live that long."""

    name: str
    ours: dict[str, Callable[[], Call]]
    peers: dict[str, Callable[[], Call]]
    roofline: Sequence[Cost]
    rounds: int = 5
    alone: Mapping[str, Callable[[], Any]] = MappingProxyType({})
    """What to take the peak memory of where it is not the call: an engine that keeps memory between calls."""
