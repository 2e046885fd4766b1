"""What a frame costs: shipped methods in each of their backends, and Open Image Denoise, at one or several sizes.

Memory is kept between frames as in `jaxdn denoise` (:mod:`jaxdn.runtime.malloc`).

    python -m experiments.speed.frames                                             # 1280 x 720
    python -m experiments.speed.frames --sizes 256x144 1280x720 3840x2160 --methods steady-balanced svgf

Each implementation has a process of its own and runs in turns with the others (:mod:`experiments.speed.workers`).
Prints a table for each size: the median of the turns in milliseconds, its ratio to Open Image Denoise, nanoseconds per
pixel; writes ``runs/frames.json`` in the format of docs/results (:mod:`experiments.measurement`).
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments.measurement import describe_measurement
from experiments.speed import peers
from experiments.speed.timing import Call
from experiments.speed.workers import Team
from experiments.speed.works.steps import frame_of, oidn_high, recurrent
from jaxdn.commands.errors import plain_errors
from jaxdn.networks.backends import BACKENDS
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import REFERENCE, VARIABLE
from jaxdn.runtime.atomic_files import write_json
from jaxdn.runtime.malloc import tune_malloc
from jaxdn.zoo.ready import find_model

OIDN = "Open Image Denoise high"


@dataclass
class Settings:
    """Time single frames of shipped methods, in turns with Open Image Denoise; write runs/frames.json."""

    methods: list[str] = field(default_factory=lambda: ["steady-balanced", "steady-fast", "svgf"])
    sizes: list[str] = field(default_factory=lambda: ["1280x720"])
    """WIDTHxHEIGHT in pixels."""
    rounds: int = 7
    """Turns of each implementation."""
    out: Path = Path("runs/frames.json")


def ours(name: str, backend: str | None, height: int, width: int, *, compiled: bool = True) -> Call:
    """The compiled step of a method, with its own state, on a backend; None is XLA.

    To be called once in a process. Without ``compiled`` every operation is its reference.
    """
    tune_malloc()
    if not compiled:
        os.environ[VARIABLE] = REFERENCE
    found, frame = find_model(name, **({} if backend is None else {"implementation": backend})), frame_of(height, width)
    assert found.denoiser is not None
    return recurrent(found.denoiser, found.params, frame)


def builds(names: list[str], height: int, width: int) -> dict[str, Callable[[], Call]]:
    """Label -> its call, for every backend for inference that a method has and that runs here. Raises ValueError."""
    found: dict[str, Callable[[], Call]] = {}
    # First, as ratios are to it: what is started last may find too little memory.
    if "pyoidn" not in peers.missing():
        found[OIDN] = partial(oidn_high, height, width)
    for name in names:
        one = find_model(name)
        if one.denoiser is None or one.method is None:
            raise ValueError(f"--methods {name}: expected a denoiser, got the noisy image.")
        backends = [each for each in one.method.backends if BACKENDS[each].purpose == "inference"]
        for backend in [None, *(each for each in backends if BACKENDS[each].available())]:
            found[f"{name}, {backend or 'xla'}"] = partial(ours, name, backend, height, width)
        if not numba_call.unavailable():
            found[f"{name}, reference"] = partial(ours, name, None, height, width, compiled=False)
    return found


def measured(names: list[str], height: int, width: int, *, rounds: int, say: Callable[[str], None]) -> dict[str, float]:
    """Label -> milliseconds of a frame, the median of its turns."""
    with Team(f"{width} x {height}", say) as team:
        team.start(builds(names, height, width))
        turns = team.turns(rounds=rounds, budget_s=float("inf"))
    return {label: float(np.median(samples)) for label, samples in turns.items()}


def parsed(size: str) -> tuple[int, int]:
    """Height and width. Raises ValueError for another form."""
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ValueError(f"--sizes {size}: expected WIDTHxHEIGHT in pixels, such as 1280x720.")
    return int(height), int(width)


def table(title: str, found: Mapping[str, float], pixels: int) -> Table:
    """The figures of one size."""
    shown = Table(title=title)
    for column in ("method, backend", "ms", f"of {OIDN}", "ns per pixel"):
        shown.add_column(column, justify="left" if column.startswith("method") else "right")
    for label, ms in found.items():
        ratio = f"{ms / found[OIDN]:.2f}" if OIDN in found else ""
        shown.add_row(label, f"{ms:,.1f}", ratio, f"{1e6 * ms / pixels:,.0f}")
    return shown


def measurement(settings: Settings, rows: Sequence[Mapping[str, str | int | float]]) -> dict[str, Any]:
    """The rows in the format of docs/results."""
    return describe_measurement(
        *("frames", "Time of a frame", "Speed", 300),
        command=f"python -m experiments.speed.frames --methods {' '.join(settings.methods)} --sizes "
        f"{' '.join(settings.sizes)} --rounds {settings.rounds}",
        what=f"Medians of {settings.rounds} interleaved turns of one frame, each implementation in a process of its "
        f"own, in ms. In brackets: the time relative to {OIDN} in the same run.",
        rows=rows,
    )


def main(settings: Settings) -> None:
    """Measure, print, save."""
    console = Console()
    rows: list[dict[str, str | int | float]] = []
    sizes = [parsed(size) for size in settings.sizes]
    for height, width in sizes:
        found = measured(settings.methods, height, width, rounds=settings.rounds, say=console.print)
        console.print(table(f"{width} x {height}", found, height * width))
        rows += [
            {"run": 1, "width": width, "height": height, "implementation": name, "ms": ms} for name, ms in found.items()
        ]
        settings.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(settings.out, measurement(settings, rows))


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
