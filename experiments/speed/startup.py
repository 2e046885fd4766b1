"""The startup profile: what `jaxdn denoise` of one frame computes until the file is there, stage by stage.

    python -m experiments.speed.startup                                            # runs/startup.json
    python -m experiments.speed.startup --out docs/results/startup-2-cores.json    # for the results page

Processor seconds of all threads, not wall time: a machine with other work gives the same figures. Each run has a
process of its own, and programs are kept by one before. Medians of the runs, in turns.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from experiments.measurement import describe_measurement
from experiments.speed.frames import parsed
from experiments.speed.works import files
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json

LEAST = 0.005
"""Processor seconds from which on a stage has a row."""


@dataclass
class Settings:
    """Profile the first frame of a method, with programs kept."""

    methods: list[str] = field(default_factory=lambda: ["oidn", "steady-balanced", "combiner-high"])
    size: str = "1280x720"
    """WIDTHxHEIGHT of the frame."""
    runs: int = 5
    out: Path = Path("runs/startup.json")


def profile(method: str, source: Path, place: Path) -> dict[str, float]:
    """Stage -> processor seconds of one run. Raises RuntimeError, with its last words, where the command fails."""
    out = place / "stages.json"
    arguments = ["denoise", str(source), "-o", str(place / "out"), "--method", method]
    done = subprocess.run(
        [sys.executable, "-m", "experiments.speed.sampler", str(out), *arguments],
        env=files.environment(place / "programs"),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{method} ended with status {done.returncode}: {done.stderr[-300:]}")
    found: dict[str, float] = json.loads(out.read_text())
    return found


def rows(taken: Mapping[str, Sequence[Mapping[str, float]]]) -> list[tuple[str, list[float]]]:
    """Stage, and its median seconds for each method, the largest first; the sums last."""
    stages = dict.fromkeys(stage for runs in taken.values() for run in runs for stage in run)
    medians = {
        stage: [float(np.median([run.get(stage, 0.0) for run in runs])) for runs in taken.values()] for stage in stages
    }
    sums = [float(np.median([sum(run.values()) for run in runs])) for runs in taken.values()]
    shown = sorted((stage for stage in stages if max(medians[stage]) >= LEAST), key=lambda stage: -max(medians[stage]))
    return [*((stage, medians[stage]) for stage in shown), ("all (the median run)", sums)]


def main(settings: Settings) -> None:
    """Profile, print, save."""
    size = parsed(settings.size)
    taken: dict[str, list[dict[str, float]]] = {method: [] for method in settings.methods}
    with tempfile.TemporaryDirectory() as folder:
        source = files.write_shot(Path(folder) / "one", 1, *size)
        for turn in range(1 + settings.runs):
            for method, runs in taken.items():
                found = profile(method, source, Path(folder))
                if turn:  # the first one keeps the programs
                    runs.append(found)
                    print(f"{method}: {sum(found.values()):.2f} processor seconds", flush=True)
    shown = rows(taken)
    for stage, seconds in shown:
        print(f"{stage:24}", *(f"{each:8.3f}" for each in seconds))
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    found = describe_measurement(
        *("table", "Startup profile", "Speed", 340),
        command="python -m experiments.speed.startup",
        what=f"One frame of {settings.size.replace('x', ' x ')} by `jaxdn denoise`, from the command to the file, "
        "programs kept: processor seconds of all threads, by what the main thread does. "
        f"Medians of {settings.runs} runs.",
        rows=[[stage, *seconds] for stage, seconds in shown],
    )
    columns = [{"name": "stage"}, *({"name": f"`{method}`", "decimals": 2} for method in taken)]
    write_json(settings.out, {**found, "columns": columns})


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
