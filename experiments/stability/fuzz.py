"""Broken files must raise only documented errors: no crash, no hang, no huge allocation, no unexpected file.

    python -m experiments.stability.fuzz --inputs 100000      # some minutes; counts in runs/fuzz.json
    python -m experiments.stability.fuzz --only exr --first 4711 --inputs 1

Input n of a kind is the same in every run (:mod:`experiments.stability.fuzz_inputs`), so ``--first`` repeats a single
one. An interrupted run resumes from its saved counts; without that file it starts over. Files are read in separate
processes with limits on memory and time, so that a crash is reported with the number of the input that caused it.
"""

import contextlib
import faulthandler
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tyro

from experiments.stability.fuzz_inputs import KINDS, broken, good_files
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json

DOCUMENTED = (ValueError, OSError)
"""The errors that a broken file may raise: ClipError is a ValueError; an empty file may not open."""
SECONDS = 20
"""CPU time for one input; the limit of wall time is thirty times as long, as a machine may stall."""
MEMORY = 1 << 30
"""Bytes that reading a file of a few kilobytes may allocate."""


@dataclass
class Settings:
    """Feed broken files to every reader of files."""

    inputs: int = 100_000
    """Total number of inputs, divided among the kinds."""
    only: Literal["all", "exr", "foreign", "record", "animation", "weights", "description"] = "all"
    first: int = 0
    """Number of the first input of each kind."""
    batch: int = 5000
    """Inputs per process."""
    out: Path = Path("runs/fuzz.json")
    """File for the counts, written after every batch."""


class Counts(NamedTuple):
    """Outcomes of inputs."""

    read: int
    refused: int
    """Inputs that raised a documented error."""
    bad: list[tuple[int, str]]
    """The number of each input that was not handled, and what happened."""

    @property
    def inputs(self) -> int:
        """Total number of inputs."""
        return self.read + self.refused + len(self.bad)


def readers(folder: Path) -> dict[str, Callable[[bytes], Any]]:
    """For each kind a function that writes the bytes to the expected path and reads them as a user would."""
    from jaxdn.clips import read_clip, read_frame
    from jaxdn.data.evidence import read_clip_properties
    from jaxdn.data.training.cache import open_cached
    from jaxdn.render.scenes.animation import (
        CameraKeys,
        RigidKeys,
        check_animation,
        interpolate_light_scale,
        read_animation,
    )
    from jaxdn.zoo.weights import load_weights

    clip, foreign, weights = folder / "clip", folder / "foreign", folder / "weights.safetensors"

    def reader(path: Path, read: Callable[[], Any]) -> Callable[[bytes], Any]:
        def run(data: bytes) -> Any:
            path.write_bytes(data)
            return read()

        return run

    def animated() -> None:
        keys = read_animation(folder / "animation.json")
        check_animation(keys, ["box"])
        if "camera" in keys:
            CameraKeys(keys["camera"])(1.5)
        for motion in keys.get("shapes", {}).values():
            RigidKeys(motion["keys"], motion.get("pivot", (0, 0, 0)))(1.5)
        for scales in keys.get("lights", {}).values():
            interpolate_light_scale(scales, 1.5)

    def trained_on() -> None:
        read_clip(clip)
        read_clip_properties(clip)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a non-finite reference gives a warning and counts as 0
            open_cached(clip, cache=folder / "cache")

    return {
        "exr": reader(clip / "frame_0000.exr", lambda: read_frame(clip / "frame_0000.exr")),
        "foreign": reader(foreign / "shot_0001.exr", lambda: read_clip(foreign)),
        "record": reader(clip / "clip.json", trained_on),
        "animation": reader(folder / "animation.json", animated),
        "weights": reader(weights, lambda: load_weights(weights)),
        "description": reader(weights.with_suffix(".json"), lambda: load_weights(weights)),
    }


def child(kind: str, first: int, count: int, source: Path) -> None:
    """Read consecutive inputs; prints one line with the outcome of each."""
    faulthandler.enable()
    good = [file.read_bytes() for file in sorted((source / "good" / kind).iterdir())]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "in"
        shutil.copytree(source / "in", folder)
        read = readers(folder)[kind]
        read(good[0])  # imports what it needs, before memory is counted
        room = _address_space() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (room, room))
        expected = _listing(Path(place))
        for number in range(first, first + count):
            print(f"@{number}", flush=True)
            # Both end the process even where no Python runs.
            resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + SECONDS, resource.RLIM_INFINITY))
            faulthandler.dump_traceback_later(30 * SECONDS, exit=True)
            outcome = _read_one(read, broken(kind, good, number))
            faulthandler.cancel_dump_traceback_later()
            stray = _listing(Path(place)) - expected
            if stray:
                outcome = f"BAD wrote {sorted(map(str, stray))}"
            print(outcome.encode("ascii", "backslashreplace").decode().replace("\n", " "), flush=True)


def _read_one(read: Callable[[bytes], Any], data: bytes) -> str:
    try:
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            read(data)
        return "read"
    except DOCUMENTED as error:
        greedy = isinstance(error.__cause__ or error.__context__, MemoryError)
        return f"BAD more than {MEMORY >> 20} MiB: {str(error)[:300]}" if greedy else "refused"
    except BaseException as error:
        return f"BAD {type(error).__name__}: {str(error)[:300]}"


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _listing(folder: Path) -> set[Path]:
    """Every file under a folder except those of the training cache."""
    found = {path.relative_to(folder) for path in folder.rglob("*")}
    return {path for path in found if path.parts[:2] != ("in", "cache")}


def prepare(source: Path) -> Path:
    """Write the valid files into the folder of the reading processes; returns it."""
    (source / "in").mkdir(parents=True)
    for kind, files in good_files(source / "in").items():
        (source / "good" / kind).mkdir(parents=True)
        for index, data in enumerate(files):
            (source / "good" / kind / f"{index:02d}").write_bytes(data)
    return source


def run_kind(kind: str, first: int, count: int, source: Path, *, repeat: bool = True) -> Counts:
    """Feed inputs of one kind; a process that dies affects only its current input.

    With ``repeat`` that input is tried a second time: a stalled machine is not a hang.
    """
    found, bad = {"read": 0, "refused": 0}, []
    done = first
    while done < first + count:
        numbers = map(str, (done, first + count - done))
        command = [sys.executable, "-m", "experiments.stability.fuzz", "--child", kind, *numbers, str(source)]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        process = subprocess.run(
            command, capture_output=True, text=True, errors="replace", env=environment, check=False
        )
        last, open_input = done - 1, False
        for line in process.stdout.splitlines():
            if line.startswith("@"):
                last, open_input = int(line[1:]), True
            elif open_input and (line in found or line.startswith("BAD ")):
                open_input = False
                if line in found:
                    found[line] += 1
                else:
                    bad.append((last, line[4:]))
        if last < done:
            raise RuntimeError(f"the fuzzer's own process failed: {process.stderr[-2000:]}")
        if open_input and repeat:
            again = run_kind(kind, last, 1, source, repeat=False)
            bad += again.bad
            found["read"], found["refused"] = found["read"] + again.read, found["refused"] + again.refused
        elif open_input:
            bad.append((last, f"the process died ({process.returncode}): {process.stderr[-600:]}"))
        done = last + 1
    return Counts(found["read"], found["refused"], bad)


def main(settings: Settings) -> int:
    """Feed all kinds, print the counts and every input that was not handled; the exit code says whether any was."""
    kinds = KINDS if settings.only == "all" else (settings.only,)
    each = -(-settings.inputs // len(kinds))
    report: dict[str, Any] = {"first": settings.first, "inputs": 0, "read": 0, "refused": 0, "bad": 0, "kinds": {}}
    if settings.out.is_file():
        before = json.loads(settings.out.read_text())
        report = before if before["first"] == settings.first else report
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        source = prepare(Path(place) / "source")
        for kind in kinds:
            began, counts = time.monotonic(), Counts(0, 0, [])
            if kind in report["kinds"]:
                counts = Counts(*(report["kinds"][kind][name] for name in Counts._fields))
                began -= report["kinds"][kind]["seconds"]
            while counts.inputs < each:
                size = min(settings.batch, each - counts.inputs)
                new = run_kind(kind, settings.first + counts.inputs, size, source)
                counts = Counts(counts.read + new.read, counts.refused + new.refused, counts.bad + new.bad)
                seconds = time.monotonic() - began
                report["kinds"][kind] = {"inputs": counts.inputs, **counts._asdict(), "seconds": round(seconds, 1)}
                for name in ("inputs", "read", "refused"):
                    report[name] = sum(entry[name] for entry in report["kinds"].values())
                report["bad"] = sum(len(entry["bad"]) for entry in report["kinds"].values())
                write_json(settings.out, report)
                print(
                    f"{kind}: {counts.inputs} of {each} inputs, {counts.read} read, {counts.refused} refused, "
                    f"{len(counts.bad)} bad ({seconds:.0f} s)",
                    flush=True,
                )
                for number, reason in new.bad[:20]:
                    print(f"  input {number}: {reason}", flush=True)
    print(f"{report['inputs']} inputs, {report['bad']} not handled: {settings.out}")
    return int(report["bad"] > 0)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5]))
    else:
        with plain_errors():
            sys.exit(main(tyro.cli(Settings, description=Settings.__doc__)))
