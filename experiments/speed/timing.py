"""Relative timing of calls, and the memory of one call.

The speed of a shared machine varies from one minute to the next: compared calls are measured interleaved, and results
are ratios of medians.
"""

import ctypes
import gc
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Call = Callable[[], Any]
"""A call to time; it returns when its work is done (``jax.block_until_ready`` inside)."""

PAUSE_S = 0.01
"""Pause between two calls: threads of the previous one may still be spinning."""


class Timing(NamedTuple):
    """The times of one call, in milliseconds."""

    median_ms: float
    min_ms: float
    max_ms: float
    first_ms: float
    """The first call, with compilation; not part of the others."""
    rounds: int


def measure(calls: Mapping[str, Call], *, rounds: int = 7, budget_s: float = 60.0) -> dict[str, Timing]:
    """Time calls of this process interleaved: each once to compile, then in rounds (:func:`interleave`)."""
    first = {name: milliseconds(call) for name, call in calls.items()}

    def turn(call: Call) -> float:
        time.sleep(PAUSE_S)
        return milliseconds(call)

    samples = interleave({name: partial(turn, call) for name, call in calls.items()}, rounds=rounds, budget_s=budget_s)
    return {name: summary(values, first[name]) for name, values in samples.items()}


def interleave(turns: Mapping[str, Callable[[], float]], *, rounds: int, budget_s: float) -> dict[str, list[float]]:
    """What each turn returns in ``rounds`` rounds, or until ``budget_s`` is spent.

    There are at least two rounds, and all are complete: every turn is taken equally often.
    """
    samples: dict[str, list[float]] = {name: [] for name in turns}
    began = time.perf_counter()
    for done in range(rounds):
        # The next round is expected to take the mean time of a round so far.
        spent = time.perf_counter() - began
        if done >= 2 and spent * (done + 1) / done > budget_s:
            break
        for name, turn in turns.items():
            samples[name].append(turn())
    return samples


def summary(values: Sequence[float], first_ms: float) -> Timing:
    """The timing of these milliseconds."""
    return Timing(float(np.median(values)), min(values), max(values), first_ms, len(values))


def milliseconds(call: Call) -> float:
    """The time of one call."""
    began = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - began)


def peak_mib(call: Call) -> float | None:
    """Growth of the process's resident memory at the call's peak, in MiB; None where the system does not report it
    (only Linux does).

    It includes the results but not what the caller holds already (arguments, weights). Call once before, to exclude
    compilation. Memory that a backend keeps between calls is not counted: pass a call that also builds the backend.
    """
    if sys.platform != "linux":
        return None
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # memory kept by the allocator would hide the growth
    try:
        Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    except OSError:  # some sandboxes forbid it
        return None
    before = status_mib("VmRSS")
    result = call()
    peak = status_mib("VmHWM")
    del result
    return None if before is None or peak is None else max(peak - before, 0.0)


def status_mib(name: str) -> float | None:
    """An entry of /proc/self/status in MiB; None where there is none."""
    if sys.platform != "linux":
        return None
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) / 1024
    raise KeyError(name)
