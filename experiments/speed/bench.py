"""`make bench`: the speed of jaxdn on this machine, compared with its roofline, PyTorch and Open Image Denoise.

    python -m experiments.speed.bench                  # everything, less than 20 minutes on two cores
    python -m experiments.speed.bench --only steps     # one group

Writes ``runs/bench.json``, a list of rows ``{"work", "implementation", "median_ms", "min_ms", "max_ms", "peak_mib",
"against", "ratio"}`` with ``ratio`` = own median over that of ``against``, and prints a table. Compared programs are
measured interleaved in one process. The peers are optional (`make bench` installs them); the rows of a missing one are
left out with a message.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import tyro
from rich.console import Console
from rich.table import Table

from experiments.speed import peers, roofline
from experiments.speed.roofline import Probe
from experiments.speed.timing import Call, Timing, measure, peak_mib
from experiments.speed.works import Work, compilation, input_share, operations, steps, train_steps
from jaxdn.commands.errors import plain_errors
from jaxdn.files import write_json

Row = dict[str, Any]

BUDGET_S = {"steps": 180, "operations": 180, "train": 240, "input": 90, "compile": 60}
"""Seconds for each group, in the order in which they run: a workload starts only while its group has time left.
Compiling in advance does not count; on two cores it takes about as long as all of this."""
ONE_WORK_S = {"steps": 45, "operations": 6, "train": 60}
"""Seconds for the rounds of one workload; at least two rounds are run."""
COMPILED = ("step-large-720p", "train-large-64")
"""The programs whose compile time is measured."""
COMPILE_S = 240
"""Time limit of one compilation, in seconds."""


@dataclass
class Settings:
    """Time jaxdn, compared with its roofline, PyTorch and Open Image Denoise; write runs/bench.json."""

    only: Literal["all", "steps", "operations", "train", "compile", "input"] = "all"
    """Run one group of workloads."""
    out: Path = Path("runs/bench.json")


class Report:
    """The rows so far, in a file that is complete after every workload."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, []  # type: Path, list[Row]
        path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, rows: Sequence[Row]) -> None:
        """Add the rows and rewrite the file."""
        self.rows.extend(rows)
        write_json(self.path, self.rows)


def row(work: str, name: str, timing: Timing, peak: float | None, against: str, other_ms: float) -> Row:
    """One row of the results.

    Args:
      work: its name.
      name: of the implementation.
      timing: of the implementation.
      peak: memory in MiB; None if not measured.
      against: name of the implementation that it is compared with.
      other_ms: median of that one.
    """
    return {
        "work": work,
        "implementation": name,
        "median_ms": timing.median_ms,
        "min_ms": timing.min_ms,
        "max_ms": timing.max_ms,
        "peak_mib": peak,
        "against": against,
        "ratio": timing.median_ms / other_ms,
    }


def compare(
    work: str,
    timings: Mapping[str, Timing],
    peaks: Mapping[str, float | None],
    others: Sequence[str],
    ideal_ms: float,
) -> list[Row]:
    """Rows of one workload: everything compared with the roofline, and ours with each of the ``others``.

    Args:
      work: its name.
      timings: name -> timing of every implementation.
      peaks: name -> memory in MiB.
      others: names of the peers.
      ideal_ms: the roofline's time.
    """
    rows = []
    for name, timing in timings.items():
        for other in [] if name in others else others:
            rows.append(row(work, name, timing, peaks[name], other, timings[other].median_ms))
        rows.append(row(work, name, timing, peaks[name], "roofline", ideal_ms))
    return rows


def run(work: Work, probe: Probe, *, budget_s: float, say: Callable[[str], None]) -> list[Row]:
    """Build the programs of a workload, time them interleaved with the ceilings, then measure their peak memory."""
    calls: dict[str, Call] = {}
    for name, build in {**work.ours, **work.peers}.items():
        try:
            calls[name] = build()
        except (ImportError, ValueError) as error:  # an engine that is not installed or cannot run here
            say(f"{work.name}: {name} is left out: {error}")
    ceilings = {"copy": probe.copy, "matrix product": probe.matmul}
    timings = measure({**calls, **ceilings}, rounds=work.rounds, budget_s=budget_s)
    reached = probe.ceilings(*(timings.pop(name).median_ms for name in ceilings))
    first = ", ".join(f"{name} {timing.first_ms / 1e3:.1f} s" for name, timing in timings.items())
    say(
        f"{work.name}: first calls (with compilation): {first}; then {next(iter(timings.values())).rounds} rounds; "
        f"{reached.copy_gb_s:.1f} GB/s copied, {reached.matmul_gflop_s:.0f} GFLOP/s in matrix products"
    )
    peaks = {name: peak_mib(work.alone.get(name, call)) for name, call in calls.items()}
    others = [name for name in work.peers if name in calls]
    return compare(work.name, timings, peaks, others, roofline.milliseconds(work.roofline, reached))


def compile_rows(
    program: str, cache: Path, taken: dict[compilation.Program, float | None], *, say: Callable[[str], None]
) -> list[Row]:
    """Compile time of one program: cold (from ``taken`` or measured now), from the cache, and PyTorch's."""
    work, seconds = f"compile-{program}", {}
    compilers = ["xla"] if "torch-compiled" in peers.missing() else ["xla", "torch"]
    for pair in [(compiler, program) for compiler in compilers]:
        if pair not in taken:
            taken[pair] = compilation.compile_seconds(*pair, cache, limit_s=COMPILE_S)
    seconds["xla-cold"], seconds["torch-compiled"] = (taken.get((compiler, program)) for compiler in ("xla", "torch"))
    if seconds["xla-cold"] is not None:
        seconds["xla-cached"] = compilation.compile_seconds("xla", program, cache, limit_s=COMPILE_S)
    timings = {}
    for name, value in seconds.items():
        if value is not None:
            timings[name] = Timing(1e3 * value, 1e3 * value, 1e3 * value, 1e3 * value, 1)
        elif name.split("-")[0] in compilers:
            say(f"{work}: {name} did not finish within {COMPILE_S} s; its rows are left out")
    pairs = (("xla-cold", "torch-compiled"), ("xla-cached", "xla-cold"), ("torch-compiled", "xla-cold"))
    return [
        row(work, name, timings[name], None, against, timings[against].median_ms)
        for name, against in pairs
        if name in timings and against in timings
    ]


def input_rows() -> list[Row]:
    """The share of time that training waits for a batch, and the total cost of the input."""
    timings = input_share.measure_input(train_steps.RECIPE)
    wait, loop, alone = (timings[name] for name in ("wait", "loop", "alone"))
    return [
        row("train-input", "waiting", wait, None, "train-loop", loop.median_ms),
        row("train-input", "train-loop", loop, None, "train-step-alone", alone.median_ms),
    ]


def table(rows: Sequence[Row]) -> Table:
    """One line for each workload and implementation, a column for each peer."""
    against = list(dict.fromkeys(row["against"] for row in rows))
    shown = Table(title="ratios: own median over the peer's (below 1 is faster)")
    for title in ("work", "implementation", "median ms", "min - max ms", "peak MiB", *against):
        shown.add_column(title, justify="left" if title in ("work", "implementation") else "right", overflow="fold")
    lines: dict[tuple[str, str], dict[str, Row]] = {}
    for each in rows:
        lines.setdefault((each["work"], each["implementation"]), {})[each["against"]] = each
    previous = ""
    for (work, name), ratios in lines.items():
        one = next(iter(ratios.values()))
        peak = "" if one["peak_mib"] is None else f"{one['peak_mib']:.0f}"
        cells = [f"{ratios[other]['ratio']:.2f}" if other in ratios else "" for other in against]
        span = f"{one['min_ms']:.1f} - {one['max_ms']:.1f}"
        shown.add_row("" if work == previous else work, name, f"{one['median_ms']:.1f}", span, peak, *cells)
        previous = work
    return shown


def compiled(
    works: Callable[[], Iterator[Work]],
    cache: Path,
    taken: dict[compilation.Program, float | None],
    *,
    say: Callable[[str], None],
) -> Iterator[Work]:
    """The workloads, after the programs that take long to compile are compiled into the caches, one process per core.

    Compilers use one core, and PyTorch's may have to be stopped, which needs a separate process. The seconds that each
    took are stored in ``taken``.
    """
    listed = list(works())
    programs: list[compilation.Program] = [("torch", work.name) for work in listed if "torch-compiled" in work.peers]
    for work in listed:
        # Programs that call an engine are compiled where they run, as jax's cache does not share them.
        programs += [("xla", work.name + name.removeprefix("xla")) for name in work.ours if name.startswith("xla")]
    say(f"compiling {', '.join(sorted({name for _, name in programs}))} ...")
    taken |= compilation.warm(programs, cache, limit_s=COMPILE_S)
    for work in listed:
        if taken.get(("torch", work.name), 0.0) is None:
            say(f"{work.name}: torch-compiled is left out: it did not compile within {COMPILE_S} s")
            work.peers.pop("torch-compiled")
        yield work


def groups(cache: Path, probe: Probe, say: Callable[[str], None]) -> dict[str, Iterator[Callable[[], list[Row]]]]:
    """Group -> its workloads as calls that return rows."""

    def timed(group: str, works: Iterator[Work]) -> Iterator[Callable[[], list[Row]]]:
        for work in works:
            yield partial(run, work, probe, budget_s=ONE_WORK_S[group], say=say)

    taken: dict[compilation.Program, float | None] = {}
    return {
        "steps": timed("steps", compiled(steps.works, cache, taken, say=say)),
        "operations": timed("operations", operations.works()),
        "train": timed("train", compiled(train_steps.works, cache, taken, say=say)),
        "input": iter([input_rows]),
        "compile": (partial(compile_rows, program, cache, taken, say=say) for program in COMPILED),
    }


def main(settings: Settings) -> None:
    """Run the groups, write the file after each workload, print the table."""
    began = time.monotonic()
    console, report = Console(width=max(Console().width, 160)), Report(settings.out)

    def say(line: str) -> None:
        console.print(f"[{time.monotonic() - began:5.0f} s] {line}", highlight=False, markup=False)

    for reason in dict.fromkeys(peers.missing().values()):
        say(reason)
    if "torch" not in peers.missing():
        from experiments.speed.peers import pytorch

        pytorch.prepare_process()
    pages = "on" if "hugetlb=1" in os.environ.get("GLIBC_TUNABLES", "") else "off"
    say(f"{os.cpu_count()} cores, jax {jax.__version__} on {jax.default_backend()}, huge pages {pages}")
    probe = roofline.probe()
    with tempfile.TemporaryDirectory() as place:
        # Programs that several groups use are compiled once.
        jax.config.update("jax_compilation_cache_dir", str(Path(place) / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(Path(place) / "torch")
        for group, calls in groups(Path(place), probe, say).items():
            if settings.only not in ("all", group):
                continue
            with console.status(f"{group}: preparing ..."):
                call = next(calls, None)
            started = time.monotonic()
            while call is not None:
                if time.monotonic() - started > BUDGET_S[group]:
                    say(f"{group}: its {BUDGET_S[group]} s are used up; the remaining workloads are left out")
                    break
                with console.status(f"{group} ..."):
                    rows = call()
                report.add(rows)
                for each in rows:
                    say(f"{each['work']}: {each['implementation']} {each['ratio']:.2f} of {each['against']}")
                call = next(calls, None)
    console.print(table(report.rows))
    print(f"raw numbers: {settings.out}  ({time.monotonic() - began:.0f} s in total)")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
