"""From the command to the file: `jaxdn denoise` of a shot, each run in a process of its own.

A run of one frame has the start of Python, imports, tracing and loading or compiling in it. What each further frame
takes is the difference between a long run and that one, divided by the frames between them. Cold is an empty folder of
compiled programs. Open Image Denoise reads and writes in the same way (:mod:`experiments.speed.peers.oidn_files`).
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.speed.timing import Timing, summary
from experiments.speed.works import scene
from jaxdn.data.exr.exr import write_exr
from jaxdn.runtime.program_cache import VARIABLE

HEIGHT, WIDTH, FRAMES = 720, 1280, 9
PEER = "oidn-files"
METHODS = ("oidn", "svgf", "steady-balanced", "combiner-high")
_KEEPING_NOTHING = (
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "PYTHONDONTWRITEBYTECODE",
)
"""Variables with which the command keeps less than users' runs do: programs, or the bytecode of imported modules."""


class Run(NamedTuple):
    """What one command took."""

    wall_ms: float
    processor_ms: float
    """Of all its threads, user and system: it depends less on what else a machine does."""
    peak_mib: float


def measurable() -> bool:
    """Whether this system tells what a child process took; Windows does not."""
    return importlib.util.find_spec("resource") is not None


def write_shot(folder: Path, count: int, height: int = HEIGHT, width: int = WIDTH) -> Path:
    """So many frames with Blender's passes: noisy light, and guides that compress as well as those of a scene."""
    folder.mkdir(parents=True)
    frames = scene.clip(count, height, width).frames
    vectors = np.concatenate([frames.motion, -frames.motion], axis=-1)
    layers = {"Combined": ("RGB", frames.radiance), "Denoising Albedo": ("RGB", frames.albedo)}
    layers |= {"Denoising Normal": ("XYZ", frames.normal), "Depth": ("Z", frames.depth), "Vector": ("XYZW", vectors)}
    for index in range(count):
        channels = {
            f"ViewLayer.{name}.{letter}": np.ascontiguousarray(pixels[index, ..., at], np.float32)
            for name, (letters, pixels) in layers.items()
            for at, letter in enumerate(letters)
        }
        write_exr(folder / f"shot.{index + 1:04d}.exr", channels)
    return folder


def command(method: str, source: Path, out: Path) -> list[str]:
    """What a user types, for a method or for the peer."""
    if method == PEER:
        return [sys.executable, "-m", "experiments.speed.peers.oidn_files", str(source), str(out)]
    return [sys.executable, "-m", "jaxdn.commands.main", "denoise", str(source), "-o", str(out), "--method", method]


def environment(programs: Path) -> dict[str, str]:
    """Of a command as users run it, with a folder for compiled programs."""
    return {name: value for name, value in os.environ.items() if name not in _KEEPING_NOTHING} | {
        VARIABLE: str(programs)
    }


def run_apart(arguments: Sequence[str], programs: Path) -> Run:
    """Run a command with a folder for compiled programs. Raises RuntimeError, with its last words, where it fails."""
    done = subprocess.run(
        [sys.executable, "-c", _LAUNCHER, *arguments],
        env=environment(programs),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments[2:5])} ended with status {done.returncode}: {done.stderr[-300:]}")
    wall, processor, peak = map(float, done.stdout.splitlines()[-1].split())
    return Run(1e3 * wall, 1e3 * processor, peak / (1024 if sys.platform != "darwin" else 1024**2))


# The memory of the process that starts another one counts as that one's on Linux: a small one has to start it.
_LAUNCHER = """
import resource, subprocess, sys, time
began = time.perf_counter()
status = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
wall, used = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
print(wall, used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(status)
"""


class Taken(NamedTuple):
    """The runs of one method."""

    cold: Run | None
    """One frame, with nothing kept; None for the peer, which compiles nothing."""
    first: list[Run]
    """One frame."""
    all: list[Run]
    """:data:`FRAMES` frames."""

    def frame(self, of: Callable[[Run], float], frames: int) -> list[float]:
        """What each further frame took, round by round."""
        return [(of(long) - of(one)) / (frames - 1) for one, long in zip(self.first, self.all, strict=True)]


def measure(
    methods: Sequence[str],
    place: Path,
    *,
    rounds: int = 2,
    frames: int = FRAMES,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> dict[str, Taken]:
    """Run all methods in turns, after a cold run of each. Results of earlier runs are removed before each one."""
    one, all_ = write_shot(place / "one", 1, *size), write_shot(place / "all", frames, *size)
    programs, out = place / "programs", place / "out"

    def run(method: str, source: Path) -> Run:
        shutil.rmtree(out, ignore_errors=True)
        return run_apart(command(method, source, out), programs / method)

    taken = {method: Taken(None if method == PEER else run(method, one), [], []) for method in methods}
    for method in methods if rounds > 1 else ():
        run(method, all_)  # later frames of a shot need programs that the first does not
    for _ in range(rounds):
        for method in methods:
            taken[method].first.append(run(method, one))
            taken[method].all.append(run(method, all_))
    return taken


def timings(taken: Mapping[str, Taken], frames: int = FRAMES) -> dict[str, dict[str, tuple[Timing, float]]]:
    """Work -> implementation -> its milliseconds and peak memory in MiB."""
    works: dict[str, dict[str, tuple[Timing, float]]] = {"files-first-frame": {}, "files-frame": {}, "files-cpu": {}}
    for method, runs in taken.items():
        peak = max(run.peak_mib for run in runs.all)
        suffix = "" if method == PEER else "-warm"
        if runs.cold is not None:
            cold = summary([runs.cold.wall_ms], runs.cold.wall_ms)
            works["files-first-frame"][f"{method}-cold"] = cold, runs.cold.peak_mib
        walls = [run.wall_ms for run in runs.first]
        one_peak = float(np.max([run.peak_mib for run in runs.first]))
        works["files-first-frame"][f"{method}{suffix}"] = summary(walls, walls[0]), one_peak
        for work, of in (("files-frame", _wall), ("files-cpu", _processor)):
            values = runs.frame(of, frames)
            works[work][method] = summary(values, values[0]), peak
    return works


def _wall(run: Run) -> float:
    return run.wall_ms


def _processor(run: Run) -> float:
    return run.processor_ms
