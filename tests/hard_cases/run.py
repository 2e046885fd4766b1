"""Runs the cells of many functions in worker processes, each function once in each state of the code.

The results of a function are one file, ``runs/hard-cases/results/<function>.json``, complete or absent: an interrupted
run goes on where it was. Results of another state of the code, jax or device are computed anew.
"""

import gc
import hashlib
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdn import color
from jaxdn.evaluation.report.images import data_address, encode_png
from jaxdn.runtime.atomic_files import write_atomically
from jaxdn.runtime.parent import end_with_parent
from tests.compiling import IN_ONE_PIECE, join_flags
from tests.hard_cases.cases import CASES
from tests.hard_cases.functions import Function, list_denoisers, list_operations
from tests.hard_cases.inputs import good
from tests.hard_cases.invariances import measure_deviations
from tests.hard_cases.table import DIRECTIONS, PRECISIONS, rows

FOLDER = Path("runs/hard-cases")
INVARIANCES = "invariances"
"""The name of the results that belong to no function."""
CELLS = len(CASES) * len(PRECISIONS) * len(DIRECTIONS)
"""Cells of each function."""
TYPICAL = {"denoiser": 200.0, "operation": 6.0, INVARIANCES: 60.0}
"""Seconds on one idle core, for a function that was never run here."""


class Finished(NamedTuple):
    """One function's results, just made or found."""

    name: str
    result: dict[str, Any]
    left: float
    """Seconds that the rest is expected to take, from this run's pace."""


def fingerprint() -> str:
    """Changes with the package, the cases, jax and the device: results of another state are not reused."""
    here = Path(__file__).parent
    package = (here.parent.parent / "jaxdn").rglob("*.py")
    presentation = {"page.py", "__main__.py"}
    sources = sorted([*(path for path in here.glob("*.py") if path.name not in presentation), *package])
    state = [jax.__version__, jax.default_backend(), *(path.read_text() for path in sources)]
    return hashlib.sha256("\0".join(state).encode()).hexdigest()


@cache
def functions() -> dict[str, Function]:
    """Every function under test, by its name."""
    return {one.name: one for one in (*list_denoisers(), *list_operations())}


def place(name: str) -> Path:
    """The file of a function's results."""
    return FOLDER / "results" / f"{name.replace(' ', '-').replace(',', '')}.json"


def stored(name: str) -> dict[str, Any] | None:
    """The results of a function, of whatever state; None if there are none."""
    path = place(name)
    return json.loads(path.read_text()) if path.is_file() else None


def keep(name: str, state: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The result of ``make()``, read from its file if that has the same state, else computed and written."""
    known = stored(name)
    if known is not None and known["state"] == state:
        return known
    began = time.monotonic()
    made = {"state": state, **make()}
    made["seconds"] = time.monotonic() - began
    place(name).parent.mkdir(parents=True, exist_ok=True)
    write_atomically({place(name): json.dumps(made)})
    return made


def run_all(names: Sequence[str], state: str, *, workers: int) -> Iterator[Finished]:
    """The results of every name, in the order in which they are finished; what is known already comes first.

    The longest are begun first. At most one function is given to each worker, so that nothing waits in a queue when
    the run is interrupted. Raises what a function raises, and OSError if a worker is killed.
    """
    known = {name: result for name in names if (result := stored(name)) is not None}
    expected = {name: known[name]["seconds"] if name in known else TYPICAL[_kind(name)] for name in names}
    waiting = []
    for name in names:
        if name in known and known[name]["state"] == state:
            yield Finished(name, known[name], float("nan"))
        else:
            waiting.append(name)
    waiting.sort(key=lambda name: -expected[name])
    begun = time.monotonic()
    finished, total = 0.0, sum(expected[name] for name in waiting)
    running: dict[Future[dict[str, Any]], str] = {}
    # Spawned: a forked process would share the state of jax's threads.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_prepare) as pool:
        while waiting or running:
            while waiting and len(running) < workers:
                running[pool.submit(_work, waiting[0], state)] = waiting[0]
                del waiting[0]
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                name = running.pop(future)
                finished += expected[name]
                pace = (time.monotonic() - begun) / finished
                yield Finished(name, _result(name, future), pace * (total - finished))


def _result(name: str, future: Future[dict[str, Any]]) -> dict[str, Any]:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise OSError(
            f"{name}: its process ended without a result, perhaps for lack of memory; run again with --workers 1: "
            "what is finished is kept."
        ) from error


def expected_seconds(names: Sequence[str], state: str) -> float:
    """Seconds of one core for the names whose results are not known: what they took before, else what is typical."""
    seconds = 0.0
    for name in names:
        known = stored(name)
        if known is None:
            seconds += TYPICAL[_kind(name)]
        elif known["state"] != state:
            seconds += known["seconds"]
    return seconds


def _kind(name: str) -> str:
    return INVARIANCES if name == INVARIANCES else functions()[name].kind


def _prepare() -> None:
    """A worker keeps its compiled programs, so that a run after a fix compiles only what the fix has changed."""
    end_with_parent()
    os.environ["XLA_FLAGS"] = join_flags(os.environ.get("XLA_FLAGS"), IN_ONE_PIECE)
    jax.config.update("jax_compilation_cache_dir", str(FOLDER.resolve() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def _work(name: str, state: str) -> dict[str, Any]:
    """In a worker: one function's results."""
    if name == INVARIANCES:
        return keep(name, state, lambda: {"deviations": list(measure_deviations())})
    made = keep(name, state, lambda: _test(functions()[name]))
    # Each program maps some twenty pieces of memory, of which Linux allows a process 65,530.
    jax.clear_caches()
    gc.collect()
    return made


def _test(function: Function) -> dict[str, Any]:
    """All rows of one function, and its pictures."""
    images: dict[tuple[str, str], np.ndarray] = {}
    table = list(rows(CASES.values(), [function], pictures=images))
    pictures = {case: picture(image, exposure_of(case)) for (case, _), image in images.items()}
    return {"rows": table, "pictures": pictures}


def picture(image: np.ndarray, exposure: float) -> str:
    """The data address of linear radiance [H, W, 3], exposed and encoded for a display; magenta is NaN."""
    return data_address(encode_png(np.asarray(color.tonemap(np.asarray(image, np.float32) * exposure))))


def exposure_of(case: str) -> float:
    """The exposure that maps the median of a case's reference to middle grey, so that dark and bright cases show."""
    middle = float(np.median(CASES[case].make(good()).clip.reference))
    return 0.3 / middle if middle > 0 else 1.0


def input_pictures() -> dict[tuple[str, str], str]:
    """The inputs: the last noisy frame of each case, and its reference."""
    shown = {}
    for name, case in CASES.items():
        clip = case.make(good()).clip
        shown[name, "noisy"] = picture(clip.frames.radiance[-1], exposure_of(name))
        shown[name, "reference"] = picture(clip.reference[-1], exposure_of(name))
    return shown
