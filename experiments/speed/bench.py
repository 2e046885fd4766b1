"""`make bench`: the speed of jaxdn on this machine, compared with its roofline, PyTorch and Open Image Denoise.

    python -m experiments.speed.bench                  # everything, half an hour on two cores
    python -m experiments.speed.bench --only steps     # one group
    python -m experiments.speed.bench --only files --size 256x144    # from file to file, of other frames

Writes ``runs/bench.json`` in the format of docs/results (:mod:`experiments.measurement`), with rows ``{"work",
"implementation", "median_ms", "min_ms", "max_ms", "peak_mib", "against", "ratio"}`` with ``ratio`` = own median over
that of ``against``, and prints a table. Every implementation has a process of its own
(:mod:`experiments.speed.workers`) and runs in turns with those that it is compared with. Large buffers are in huge
pages only in the rows that say so. The peers are optional (`make bench` installs them); the rows of what is missing or
fails are left out with a message.
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
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments.measurement import describe_measurement
from experiments.speed import peers, roofline
from experiments.speed.frames import parsed
from experiments.speed.roofline import Probe
from experiments.speed.timing import Timing, summary
from experiments.speed.workers import Team, WorkerError, apart
from experiments.speed.works import Work, compilation, files, input_share, on_device, operations, steps, train_steps
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json

Row = dict[str, Any]

BUDGET_S = {"steps": 180, "operations": 300, "train": 240, "input": 90, "compile": 60, "files": 300}
"""Seconds for each group, in the order in which they run: a workload starts only while its group has time left, unless
it is asked for alone. Compiling in advance does not count; on two cores it takes about as long as all of this."""
ONE_WORK_S = {"steps": 45, "operations": 6, "train": 60}
"""Seconds for the rounds of one workload; at least two rounds are run."""
COMPILED = ("step-large-720p", "train-large-64")
"""The programs whose compile time is measured."""
STEP_ROUNDS = 7
"""Calls of a step that a frame from file to file is compared with."""
COMPILE_S = 240
"""Time limit of one compilation, in seconds."""


@dataclass
class Settings:
    """Time jaxdn, compared with its roofline, PyTorch and Open Image Denoise; write runs/bench.json."""

    only: Literal["all", "steps", "operations", "train", "compile", "input", "files"] = "all"
    """Run one group of workloads, all of them however long they take."""
    size: str = f"{files.WIDTH}x{files.HEIGHT}"
    """WIDTHxHEIGHT of the frames of the group `files`."""
    frames: int = files.FRAMES
    """Of the long runs of that group; a further frame takes their time less that of one frame."""
    out: Path = Path("runs/bench.json")


class Report:
    """The rows so far, in a file that is complete after every workload."""

    def __init__(self, path: Path, command: str, what: str = "Operations, steps and training.") -> None:
        """``what`` the rows are, in a sentence."""
        self.path, self.command, self.what, self.rows = path, command, what, []  # type: Path, str, str, list[Row]
        path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, rows: Sequence[Row]) -> None:
        """Add the rows and rewrite the file."""
        self.rows.extend(rows)
        write_json(
            self.path,
            describe_measurement(
                *("bench", "Benchmark", "Speed", 310),
                command=self.command,
                what=f"{self.what} Ratios are the time of jaxdn divided by the time of the peer, "
                "measured interleaved, each implementation in a process of its own. Below 1, jaxdn is faster. The "
                "roofline counts each byte once and leaves out exponentials.",
                rows=self.rows,
            ),
        )


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
    ideal_ms: float | None,
) -> list[Row]:
    """Rows of one workload: everything compared with the roofline, and ours with each of the ``others``.

    Args:
      work: its name.
      timings: name -> timing of every implementation.
      peaks: name -> memory in MiB.
      others: names of the peers.
      ideal_ms: the roofline's time; None if it is not known.
    """
    rows = []
    for name, timing in timings.items():
        for other in [] if name in others else others:
            rows.append(row(work, name, timing, peaks[name], other, timings[other].median_ms))
        if ideal_ms is not None:
            rows.append(row(work, name, timing, peaks[name], "roofline", ideal_ms))
    return rows


def run(work: Work, probes: Mapping[str, Probe], *, budget_s: float, say: Callable[[str], None]) -> list[Row]:
    """Time the implementations of a workload in turns with the ceilings, then measure their peak memory."""
    with Team(work.name, say) as team:
        builds = {**work.ours, **work.peers, **{name: probe.build for name, probe in probes.items()}}
        first = team.start(builds, work.huge_pages)
        samples = team.turns(rounds=work.rounds, budget_s=budget_s)
        probed = {name: float(np.median(samples.pop(name))) for name in probes if name in samples}
        timings = {name: summary(values, first[name]) for name, values in samples.items()}
        peaks = {name: team.peak(name, work.alone.get(name)) for name in timings}
    calls = ", ".join(f"{name} {timing.first_ms / 1e3:.1f} s" for name, timing in timings.items())
    rounds = max((timing.rounds for timing in timings.values()), default=0)
    say(f"{work.name}: first calls (with compilation): {calls}; then {rounds} rounds")
    ideal_ms = None
    if len(probed) == len(probes):
        reached = roofline.ceilings(probes, probed)
        ideal_ms = roofline.milliseconds(work.roofline, reached)
        say(
            f"{work.name}: {reached.copy_gb_s:.1f} GB/s copied, {reached.matmul_gflop_s:.0f} GFLOP/s in matrix products"
        )
    return compare(work.name, timings, peaks, [name for name in work.peers if name in timings], ideal_ms)


def compile_rows(
    program: str, cache: Path, taken: dict[compilation.Program, compilation.Seconds], *, say: Callable[[str], None]
) -> list[Row]:
    """Compile time of one program: cold (from ``taken`` or measured now), from the cache, and PyTorch's."""
    work = f"compile-{program}"
    compilers = {"xla-cold": "xla"} | ({} if "torch-compiled" in peers.missing() else {"torch-compiled": "torch"})
    for pair in [(compiler, program) for compiler in compilers.values()]:
        if pair not in taken:
            taken[pair] = compilation.compile_seconds(*pair, cache, limit_s=COMPILE_S)
    seconds = {name: taken[compiler, program] for name, compiler in compilers.items()}
    if isinstance(seconds["xla-cold"], float):
        seconds["xla-cached"] = compilation.compile_seconds("xla", program, cache, limit_s=COMPILE_S)
    timings = {}
    for name, value in seconds.items():
        if isinstance(value, str):
            say(f"{work}: {name} is left out: {value}")
        else:
            timings[name] = summary([1e3 * value], 1e3 * value)
    pairs = (("xla-cold", "torch-compiled"), ("xla-cached", "xla-cold"), ("torch-compiled", "xla-cold"))
    return [
        row(work, name, timings[name], None, against, timings[against].median_ms)
        for name, against in pairs
        if name in timings and against in timings
    ]


def input_rows(say: Callable[[str], None]) -> list[Row]:
    """The share of time that training waits for a batch, and the total cost of the input."""
    try:
        timings = apart(input_share.measure_input, train_steps.RECIPE)
    except WorkerError as error:
        say(f"train-input is left out: {error}")
        return []
    wait, loop, alone = (timings[name] for name in ("wait", "loop", "alone"))
    return [
        row("train-input", "waiting", wait, None, "train-loop", loop.median_ms),
        row("train-input", "train-loop", loop, None, "train-step-alone", alone.median_ms),
    ]


def file_rows(methods: Sequence[str], say: Callable[[str], None], **options: Any) -> list[Row]:
    """From command to file, in turns with Open Image Denoise; a further frame is compared with its step as well.

    ``options`` are those of :func:`experiments.speed.works.files.measure`.
    """
    if not files.measurable() or "pyoidn" in peers.missing():
        say("files: left out: expected pyoidn, and a system that tells what a child process took")
        return []
    with tempfile.TemporaryDirectory() as place:
        try:
            taken = files.measure([files.PEER, *methods], Path(place), **options)
            size = options.get("size", (files.HEIGHT, files.WIDTH))
            step_ms = {name: apart(on_device.step_ms, name, *size, STEP_ROUNDS) for name in methods}
        except (RuntimeError, WorkerError) as error:
            say(f"files: {', '.join(methods)} is left out: {error}")
            return []
    rows = []
    for work, found in files.timings(taken, **{k: v for k, v in options.items() if k == "frames"}).items():
        other = found[files.PEER][0]
        rows += [row(work, name, timing, peak, files.PEER, other.median_ms) for name, (timing, peak) in found.items()]
        if work == "files-frame":
            rows += [row(work, name, *found[name], "step", step_ms[name]) for name in methods]
    for each in rows:
        if each["work"] == "files-frame" and each["against"] == files.PEER:
            say(f"{each['implementation']}: {1e3 / each['median_ms']:.2f} frames a second")
    return rows


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
    taken: dict[compilation.Program, compilation.Seconds],
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
        # Programs that call a backend are compiled where they run, as jax's cache does not share them.
        own = [name for name in work.ours if name.startswith("xla") and name not in work.huge_pages]
        programs += [("xla", work.name + name.removeprefix("xla")) for name in own]
    say(f"compiling {', '.join(sorted({name for _, name in programs}))} ...")
    taken |= compilation.warm(programs, cache, limit_s=COMPILE_S)
    for work in listed:
        reason = taken.get(("torch", work.name))
        if isinstance(reason, str):
            say(f"{work.name}: torch-compiled is left out: {reason}")
            work.peers.pop("torch-compiled")
        yield work


def groups(settings: Settings, cache: Path, say: Callable[[str], None]) -> dict[str, Iterator[Callable[[], list[Row]]]]:
    """Group -> its workloads as calls that return rows."""
    probes = roofline.probes()

    def timed(group: str, works: Iterator[Work]) -> Iterator[Callable[[], list[Row]]]:
        for work in works:
            yield partial(run, work, probes, budget_s=ONE_WORK_S[group], say=say)

    taken: dict[compilation.Program, compilation.Seconds] = {}
    return {
        "steps": timed("steps", compiled(steps.works, cache, taken, say=say)),
        "operations": timed("operations", operations.works()),
        "train": timed("train", compiled(train_steps.works, cache, taken, say=say)),
        "input": iter([partial(input_rows, say)]),
        "compile": (partial(compile_rows, program, cache, taken, say=say) for program in COMPILED),
        "files": (
            partial(file_rows, (method,), say, size=parsed(settings.size), frames=settings.frames)
            for method in files.METHODS
        ),
    }


def describe_rows(settings: Settings) -> str:
    """What the rows are, in a sentence."""
    whole = f"`files`: `jaxdn denoise` of {settings.frames} frames of {settings.size}, from the command to the files."
    return {"all": f"Operations, steps and training. {whole}", "files": whole}.get(settings.only, f"`{settings.only}`.")


def main(settings: Settings) -> None:
    """Run the groups, write the file after each workload, print the table."""
    began = time.monotonic()
    if settings.frames < 2:
        raise ValueError(f"--frames: expected at least 2, as a further frame is timed; got {settings.frames}.")
    command = "make bench" if settings.only == "all" else f"python -m experiments.speed.bench --only {settings.only}"
    if settings.only == "files":
        command += f" --size {settings.size} --frames {settings.frames}"
    console, report = Console(width=max(Console().width, 160)), Report(settings.out, command, describe_rows(settings))

    def say(line: str) -> None:
        console.print(f"[{time.monotonic() - began:5.0f} s] {line}", highlight=False, markup=False)

    for reason in dict.fromkeys(peers.missing().values()):
        say(reason)
    # Several processes share a GPU: none may reserve most of its memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    say(f"{os.cpu_count()} cores, jax {jax.__version__} on {jax.default_backend()}")
    with tempfile.TemporaryDirectory() as place:
        # Programs that several groups use are compiled once.
        os.environ |= compilation.environment(Path(place))
        for group, calls in groups(settings, Path(place), say).items():
            if settings.only not in ("all", group):
                continue
            with console.status(f"{group}: preparing ..."):
                call = next(calls, None)
            started = time.monotonic()
            while call is not None:
                if settings.only == "all" and time.monotonic() - started > BUDGET_S[group]:
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
