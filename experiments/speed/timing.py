"""Relative timing of calls, and the memory of one call.

The speed of a shared machine varies from one minute to the next: compared calls are measured interleaved in one
process, and results are ratios of medians.
"""

import ctypes
import gc
import sys
import time
from collections.abc import Callable, Mapping
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
    """Time calls interleaved: each once to compile, then ``rounds`` times, or until ``budget_s`` is spent.

    There are at least two rounds, and all are complete: every call is timed equally often. The budget counts from the
    end of the first calls.
    """
    first, samples = {}, {name: [] for name in calls}  # type: dict[str, float], dict[str, list[float]]
    for name, call in calls.items():
        first[name] = _milliseconds(call)
    began = time.perf_counter()
    for done in range(rounds):
        # The next round is expected to take the mean time of a round so far.
        spent = time.perf_counter() - began
        if done >= 2 and spent * (done + 1) / done > budget_s:
            break
        for name, call in calls.items():
            time.sleep(PAUSE_S)
            samples[name].append(_milliseconds(call))
    return {
        name: Timing(float(np.median(values)), min(values), max(values), first[name], len(values))
        for name, values in samples.items()
    }


def _milliseconds(call: Call) -> float:
    began = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - began)


def peak_mib(call: Call) -> float | None:
    """Growth of the process's resident memory at the call's peak, in MiB; None where the system does not report it
    (only Linux does).

    It includes the results but not what the caller holds already (arguments, weights). Call once before, to exclude
    compilation. Memory that an engine keeps between calls is not counted: pass a call that also builds the engine.
    """
    if sys.platform != "linux":
        return None
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # memory kept by the allocator would hide the growth
    try:
        Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    except OSError:  # some sandboxes forbid it
        return None
    before = _status("VmRSS")
    result = call()
    peak = _status("VmHWM") - before
    del result
    return max(peak, 0.0)


def _status(name: str) -> float:
    """An entry of /proc/self/status in MiB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) / 1024
    raise KeyError(name)
