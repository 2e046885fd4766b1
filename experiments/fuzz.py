"""Broken files: only documented errors, never a crash, a hang, a huge allocation or a file where none was asked for.

    python -m experiments.fuzz --inputs 100000      # resumes nothing: input n is the same in every run
    python -m experiments.fuzz --only exr --first 4711 --inputs 1

Real files (a frame as EXR, a clip's record, an animation, weights and their JSON) are broken in one to eight ways each:
bits flipped, bytes cut, doubled, or replaced by numbers that are often badly handled. Reading happens in processes of
their own with a limit on memory and on time, so that whatever dies is told with the number of the input that killed it.
"""

import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from jaxdn.commands.errors import told_plainly

KINDS = ("exr", "record", "animation", "weights", "description")
DOCUMENTED = (ValueError, OSError)
"""What a broken file may raise: ClipError is a ValueError; a file of nothing may not open."""
SECONDS = 20
MEMORY = 6 << 30
_NUMBERS = (b"-1", b"0", b"1e999", b"NaN", b"99999999999999999999", b"null", b'"x"', b"[]", b"{}", b"true", b"-0.0")


@dataclass
class Settings:
    """Feed broken files to everything that reads files."""

    inputs: int = 100_000
    """How many in all, shared between the kinds."""
    only: Literal["all", "exr", "record", "animation", "weights", "description"] = "all"
    first: int = 0
    """Number of the first input."""
    batch: int = 2000
    """Inputs for each process."""


def good_files(folder: Path) -> dict[str, bytes]:
    """One whole file of each kind."""
    import jax

    from jaxdn.clips import write_clip
    from jaxdn.denoisers import ntd
    from jaxdn.frame import Clip, Frame
    from jaxdn.weights import save_weights

    rng = np.random.default_rng(0)
    light = rng.random((2, 6, 8, 3), np.float32)
    frames = Frame(light, albedo=light, depth=light[..., :1], motion=light[..., :2])
    write_clip(Clip(frames, light), folder / "clip", record={"cameras": [{"x_fov": 60.0}] * 2, "plan": None})
    tiny = {"size": [[1]] * 5}
    params = ntd(size=((1,),) * 5).init(jax.random.key(0), Frame(light[0]))
    save_weights(folder / "weights.safetensors", params, factory="ntd", options=tiny, record={})
    animation = {
        "frames": 4,
        "camera": [{"frame": 0, "origin": [0, 1, 5], "target": [0, 1, 0], "fov": 40}, {"frame": 3, "origin": [1, 1, 5],
                   "target": [0, 1, 0], "fov": 40}],
        "shapes": {"box": {"pivot": [0, 0, 0], "keys": [{"frame": 0, "angle": 10, "axis": [0, 1, 0]}]}},
        "inserted": [{"id": "ball", "type": "sphere", "size": 0.4, "color": [0.8, 0.2, 0.1], "roughness": 0.3}],
        "lights": {"lamp": [{"frame": 0, "scale": 1}]},
    }  # fmt: skip
    return {
        "exr": (folder / "clip" / "frame_0000.exr").read_bytes(),
        "record": (folder / "clip" / "clip.json").read_bytes(),
        "animation": json.dumps(animation).encode(),
        "weights": (folder / "weights.safetensors").read_bytes(),
        "description": (folder / "weights.json").read_bytes(),
    }


def broken(good: bytes, number: int) -> bytes:
    """Input ``number``: the good bytes with one to eight things wrong."""
    draw = random.Random(number)
    data = bytearray(good)
    for _ in range(draw.randint(1, 8)):
        at, length = draw.randrange(len(data) + 1), draw.randint(1, 16)
        how = draw.randrange(6)
        if how == 0 and data:
            data[at % len(data)] ^= 1 << draw.randrange(8)
        elif how == 1:
            del data[at : at + length]
        elif how == 2:
            data[at:at] = data[at : at + length]
        elif how == 3:
            data[at : at + length] = draw.randbytes(length)
        elif how == 4:
            data[at : at + draw.randint(1, 4)] = draw.choice(_NUMBERS)
        elif draw.random() < 0.2:
            del data[at:]
        else:
            data[at : at + 4] = draw.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**24)).to_bytes(4, "little")
    return bytes(data)


def readers(folder: Path) -> dict[str, Callable[[bytes], Any]]:
    """For each kind a function that writes the bytes where they belong and reads them as a user would."""
    from jaxdn.clips import read_clip, read_frame
    from jaxdn.render.animation import check_animation, read_animation
    from jaxdn.weights import load_weights

    def reader(path: Path, read: Callable[[], Any]) -> Callable[[bytes], Any]:
        def run(data: bytes) -> Any:
            path.write_bytes(data)
            return read()

        return run

    def animated() -> None:
        check_animation(read_animation(folder / "animation.json"), ["box"])

    clip, weights = folder / "clip", folder / "weights.safetensors"
    return {
        "exr": reader(clip / "frame_0000.exr", lambda: read_frame(clip / "frame_0000.exr")),
        "record": reader(clip / "clip.json", lambda: read_clip(clip)),
        "animation": reader(folder / "animation.json", animated),
        "weights": reader(weights, lambda: load_weights(weights)),
        "description": reader(weights.with_suffix(".json"), lambda: load_weights(weights)),
    }


def child(kind: str, first: int, count: int) -> None:
    """Read a run of inputs; a line for each that raised what it should not, with its number."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.signal(signal.SIGALRM, _too_long)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "in"
        folder.mkdir()
        good = good_files(folder)
        read = readers(folder)[kind]
        expected = _listing(Path(place)) | {Path("in/animation.json")}
        for number in range(first, first + count):
            print(f"@{number}", flush=True)
            signal.alarm(SECONDS)
            try:
                with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
                    read(broken(good[kind], number))
                outcome = "read"
            except DOCUMENTED:
                outcome = "refused"
            except BaseException as error:
                outcome = f"BAD {type(error).__name__}: {str(error)[:200]}"
            signal.alarm(0)
            stray = _listing(Path(place)) - expected
            if stray:
                outcome = f"BAD wrote {sorted(map(str, stray))}"
            print(outcome.replace("\n", " "), flush=True)


def _too_long(*_: Any) -> None:
    raise TimeoutError(f"more than {SECONDS} s")


def _listing(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*")}


def run_kind(kind: str, first: int, count: int, batch: int) -> dict[str, Any]:
    """Feed one kind in processes of ``batch`` inputs; a process that dies loses its own input, not the ones after."""
    told: dict[str, Any] = {"read": 0, "refused": 0, "bad": []}
    done = first
    while done < first + count:
        wanted = min(batch, first + count - done)
        command = [sys.executable, "-m", "experiments.fuzz", "--child", kind, str(done), str(wanted)]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        process = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        last = done - 1
        for line in process.stdout.splitlines():
            if line.startswith("@"):
                last = int(line[1:])
            elif line.startswith("BAD"):
                told["bad"].append((last, line[4:]))
            elif line in told:
                told[line] += 1
        finished = told["read"] + told["refused"] + len(told["bad"]) == last + 1 - first
        if process.returncode and not (finished and last == done + wanted - 1):
            if last < done:
                raise RuntimeError(f"the fuzzer's own process failed: {process.stderr[-2000:]}")
            told["bad"].append((last, f"the process died ({process.returncode}): {process.stderr[-200:]}"))
        done = last + 1
    return told


def main(settings: Settings) -> int:
    """Feed all kinds, print the counts and every input that was not handled; the exit code says whether any was."""
    kinds = KINDS if settings.only == "all" else (settings.only,)
    worst = 0
    for kind in kinds:
        start = time.monotonic()
        told = run_kind(kind, settings.first, -(-settings.inputs // len(kinds)), settings.batch)
        bad = told["bad"]
        count = told["read"] + told["refused"] + len(bad)
        print(
            f"{kind}: {count} inputs, {told['read']} read, {told['refused']} refused, {len(bad)} bad "
            f"({time.monotonic() - start:.0f} s)",
            flush=True,
        )
        for number, reason in bad[:20]:
            print(f"  input {number}: {reason}", flush=True)
        worst |= bool(bad)
    return worst


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        with told_plainly():
            sys.exit(main(tyro.cli(Settings, description=Settings.__doc__)))
