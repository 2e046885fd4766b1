"""Several processes that train together (``jax.distributed``): which of them writes, and when all of them stop.

A program of several processes waits for all of them in every update. Whatever makes one of them leave the loop, as a
signal or the clock, has to be known to the others before the same update.
"""

import hashlib
import json
import time
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxdn.runtime.interrupt import Interrupt

_AGREE_EVERY = 8
"""Updates between two agreements: each waits for the update before it, and the devices for the next."""


class StopReason(IntEnum):
    """Why a run ends before its last update; of several, the largest holds for all processes."""

    NONE = 0
    TIME = 1
    INTERRUPTED = 2
    TERMINATED = 3


class Stopping:
    """Whether a run ends now: Ctrl-C, SIGTERM or its time limit, in any of its processes."""

    def __init__(self, interrupt: Interrupt, end: float):
        """``end``: when time is over, by ``time.monotonic()``."""
        self._interrupt, self._end = interrupt, end
        self._asked_for, self._reason = 0, StopReason.NONE

    def is_agreed(self) -> bool:
        """To be asked before every update, in all processes. The interrupt is then asked for in all of them."""
        own = self._own()
        if jax.process_count() == 1:
            self._reason = own
        elif self._asked_for % _AGREE_EVERY == 0:
            reasons = multihost_utils.process_allgather(np.int32(own))
            self._reason = StopReason(int(np.max(reasons)))
            if self._reason >= StopReason.INTERRUPTED:
                self._interrupt.ask(terminated=self._reason == StopReason.TERMINATED)
        self._asked_for += 1
        return self._reason != StopReason.NONE

    def _own(self) -> StopReason:
        if self._interrupt.asked:
            return StopReason.TERMINATED if self._interrupt.terminated else StopReason.INTERRUPTED
        return StopReason.TIME if time.monotonic() >= self._end else StopReason.NONE


def check_same(asked: Mapping[str, Any]) -> None:
    """Raise ValueError, in all processes, unless all were asked for the same; ``asked`` has the names of its parts.

    With another learning rate in one of them each would go on from weights of its own, and nobody would see it.
    """
    if jax.process_count() == 1:
        return
    found = {name: _digest(value) for name, value in asked.items()}
    of_all = multihost_utils.process_allgather(np.stack(list(found.values())))
    differing = [name for index, name in enumerate(found) if (of_all[:, index] != of_all[0, index]).any()]
    if differing:
        raise ValueError(
            f"--distributed: expected the same command in all processes, got another {', '.join(differing)} in one of "
            "them; give all of them the same."
        )


def _digest(value: Any) -> np.ndarray:
    text = json.dumps(value, sort_keys=True, default=repr)
    return np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)


def writes() -> bool:
    """Whether this process writes the files of the run, and its lines in the terminal: the first does."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Wait until every process is here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)
