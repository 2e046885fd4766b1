"""Run all hard cases and write the page: ``make hard-cases``.

    python -m tests.hard_cases                # runs/hard-cases/table.html, table.json and summary.json
    python -m tests.hard_cases svgf relax     # these alone, without the page

An interrupted run goes on where it was, as long as neither the package nor the cases have changed.
"""

import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Annotated, Any

import tyro

from experiments.measurement import find_revision
from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.compare import describe_machine
from jaxdn.runtime.atomic_files import write_json
from tests.hard_cases import run
from tests.hard_cases.invariances import Deviation
from tests.hard_cases.page import write_page
from tests.hard_cases.table import Row


@dataclass
class Settings:
    """Run the hard cases and list what is red; the exit code is 1 if anything is."""

    functions: Annotated[list[str], tyro.conf.Positional] = field(default_factory=list)
    """How the names of denoisers and operations begin; default: all, and the page is written."""
    workers: int = 2
    """Processes that run functions side by side; each needs about 2 GB."""


def main(settings: Settings) -> int:
    """Run the cases, write the page, list what is red. Raises ValueError for a name that no function has."""
    if settings.workers < 1:
        raise ValueError(f"workers: expected at least 1, got {settings.workers}.")
    names = choose(settings.functions)
    state = run.fingerprint()
    jobs = names if settings.functions else [*names, run.INVARIANCES]
    announce(jobs, state, settings.workers)
    began = time.monotonic()
    results = follow(jobs, names, state, settings.workers)
    seconds = time.monotonic() - began
    table = [Row(*row) for name in names for row in results[name]["rows"]]
    red = [row for row in table if row.verdict == "red"]
    for row in red:
        print(f"red: {row.function}, {row.case}, {row.precision}, {row.direction}: {row.reason}")
    end = f"{len(table):,} cells, {len(red)} red, {seconds / 60:.0f} min"
    if not settings.functions:
        deviations = [Deviation(*one) for one in results[run.INVARIANCES]["deviations"]]
        pictures = run.input_pictures()
        for name in names:
            pictures |= {(case, name): address for case, address in results[name]["pictures"].items()}
        page = write_page(table, run.FOLDER, deviations=deviations, pictures=pictures)
        worked = sum(one["seconds"] for one in results.values())
        write_json(run.FOLDER / "summary.json", summarize(table, seconds=seconds, process_seconds=worked))
        end = f"{end}: {page}"
    print(end)
    return 1 if red else 0


def choose(wanted: Sequence[str]) -> list[str]:
    """The names of the functions whose names begin so; all if none is wanted. Raises ValueError for one without any."""
    known = list(run.functions())
    for start in wanted:
        if not any(name.startswith(start) for name in known):
            raise ValueError(f"functions: expected some out of {', '.join(known)}, got {start}.")
    return [name for name in known if not wanted or name.startswith(tuple(wanted))]


def announce(jobs: Sequence[str], state: str, workers: int) -> None:
    """Print what there is to do, what is kept, and what is computed anew."""
    found = [result["state"] == state for name in jobs if (result := run.stored(name)) is not None]
    kept, outdated = sum(found), len(found) - sum(found)
    if kept:
        print(f"{kept} of {len(jobs)} results are kept: they are of this state of the code.")
    if outdated:
        print(f"{outdated} of {len(jobs)} results are of another state of the code: they are computed anew.")
    minutes = run.expected_seconds(jobs, state) / workers / 60
    print(f"{len(jobs) - kept} to run in {workers} processes: about {minutes:.0f} min if as many cores are idle.")


def follow(jobs: Sequence[str], names: Sequence[str], state: str, workers: int) -> dict[str, dict[str, Any]]:
    """The results of all jobs by name; prints each as it is finished, with all cells so far and the time left."""
    results: dict[str, dict[str, Any]] = {}
    cells = reds = 0
    for name, result, left in run.run_all(jobs, state, workers=workers):
        results[name] = result
        found = [Row(*row) for row in result.get("rows", ())]
        red = sum(row.verdict == "red" for row in found)
        cells, reds = cells + len(found), reds + red
        if math.isnan(left):  # known before
            continue
        verdict = f"{red} of {len(found)} red" if red else f"{len(found)} cells without red" if found else "measured"
        print(
            f"[{len(results)}/{len(jobs)}] {name}: {verdict}, {result['seconds']:.0f} s; "
            f"{cells:,} of {len(names) * run.CELLS:,} cells, {reds} red, {left / 60:.0f} min left",
            flush=True,
        )
    return results


def summarize(table: Sequence[Row], *, seconds: float, process_seconds: float) -> dict[str, Any]:
    """What a page of results needs: where and when the table was run, and how many cells had which verdict."""
    verdicts = Counter(row.verdict for row in table)
    return {
        "revision": find_revision(),
        "machine": describe_machine(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "functions": len({row.function for row in table}),
        "cases": len({row.case for row in table}),
        "cells": len(table),
        **{verdict: verdicts[verdict] for verdict in ("green", "input", "none", "red")},
        "red_cells": [
            [row.function, row.case, row.precision, row.direction, row.reason] for row in table if row.verdict == "red"
        ],
        "seconds": round(seconds, 1),
        "process_seconds": round(process_seconds, 1),
    }


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Settings, description=Settings.__doc__)))
