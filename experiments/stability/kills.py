"""Training that is killed (SIGKILL) at random moments ends with the same weights, bit for bit.

    python -m experiments.stability.kills --kills 60      # counts in runs/kills.json

A tiny network is trained once without interruption, and then by processes that are killed repeatedly: while they start
and compile, between two steps, and while a checkpoint is being written. After each restart, training may lose only the
steps since its last checkpoint, and must end with the weights and the log of the uninterrupted run.
"""

import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json

WIDTHS = ((4,), (4,), (4,), (4,), (4,))


class Sizes(NamedTuple):
    """How long a run is."""

    steps: int = 600
    checkpoint_every: int = 5


@dataclass
class Settings:
    """Kill a training run at random moments and check its result."""

    kills: int = 60
    seed: int = 0
    """Seed of the moments."""
    out: Path = Path("runs/kills.json")


def make_clips(folder: Path) -> None:
    """Three small clips of noise around a slope."""
    from jaxdn.clips import write_clip
    from jaxdn.core.frame import Clip, Frame

    for seed in range(3):
        rng = np.random.default_rng(seed)
        reference = np.broadcast_to(np.linspace(0.1, 0.9, 20, dtype=np.float32)[:, None, None], (5, 20, 20, 3))
        noisy = (reference * rng.exponential(size=(5, 20, 20, 1))).astype(np.float32)
        write_clip(Clip(Frame(noisy, albedo=np.ascontiguousarray(reference)), reference), folder / f"clip-{seed}")


def train(clips: Path, folder: Path, sizes: Sizes) -> None:
    """Train to the end, resuming from the folder, and write the weights."""
    import jax

    from jaxdn.clips import training_batches
    from jaxdn.methods.registry import method_named
    from jaxdn.training.loop import Every, fit
    from jaxdn.zoo.weights import save_weights

    jax.config.update("jax_compilation_cache_dir", str(clips.parent / "programs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    method = method_named("ntd")
    # By XLA alone: programs that call another library are not kept, and every process would compile them again.
    options = {"size": WIDTHS, "prediction": "direct"}
    denoiser = method.factory(**options)
    recipe = method.recipe_named(None)._replace(steps=sizes.steps, batch=2, crop=16, frames=4)
    batches = training_batches(
        clips, buffers=denoiser.reads, batch=recipe.batch, crop=recipe.crop, frames=recipe.frames, seed=recipe.seed
    )
    every = sizes.checkpoint_every
    state = fit(denoiser, recipe, batches, folder, label="killed", every=Every(1, checkpoint=every))
    save_weights(folder / "weights.safetensors", state.params, factory=method.name, options=options, record={})


def start(clips: Path, folder: Path, sizes: Sizes) -> subprocess.Popen[str]:
    """Training in a separate process."""
    command = [sys.executable, "-m", "experiments.stability.kills", "--child"]
    arguments = map(str, (clips, folder, *sizes))
    return subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def newest(folder: Path) -> int:
    """Steps in the newest checkpoint."""
    steps = [int(path.name) for path in (folder / "checkpoints").glob("*") if path.name.isdecimal()]
    return max(steps, default=0)


def logged(folder: Path) -> int:
    """Steps in the log."""
    log = folder / "log.jsonl"
    return log.read_bytes().count(b"\n") if log.is_file() else 0


def writing(folder: Path) -> bool:
    """Whether a checkpoint is being written, or was when its process died."""
    return any(not path.name.isdecimal() for path in (folder / "checkpoints").glob("*"))


def wait(until: Callable[[], bool], process: subprocess.Popen[str]) -> bool:
    """Poll every millisecond; False if the process ended first."""
    while process.poll() is None:
        if until():
            return True
        time.sleep(0.001)
    return False


def kill(process: subprocess.Popen[str], folder: Path, draw: random.Random) -> str | None:
    """Kill at a random moment of one of three kinds; None if the process ended first."""
    sort = draw.choice(("starting", "training", "training", "writing", "writing"))
    if sort == "starting":
        moment = time.monotonic() + draw.uniform(0.0, 8.0)
        alive = wait(lambda: time.monotonic() > moment, process)
    else:
        # The log of an earlier process may be ahead of its checkpoint: the new one first cuts it there.
        newer = newest(folder)
        first = newer + 1 + draw.randrange(30)
        alive = wait(lambda: logged(folder) == newer, process) and wait(lambda: logged(folder) >= first, process)
        alive = alive and (sort == "training" or wait(lambda: writing(folder), process))
        time.sleep(draw.uniform(0.0, 0.01))
    if not alive or process.poll() is not None:
        return None
    process.kill()
    process.communicate()
    return sort


def main(settings: Settings) -> int:
    """Train without and with kills, and compare."""
    draw, sizes = random.Random(settings.seed), Sizes()
    counts: dict[str, Any] = {"kills": 0, "while writing a checkpoint": 0, "runs": 0, "equal": 0, "each": []}
    with tempfile.TemporaryDirectory() as place:
        clips, whole = Path(place) / "clips", Path(place) / "whole"
        make_clips(clips)
        began = time.monotonic()
        said, _ = start(clips, whole, sizes).communicate()
        if not (whole / "weights.safetensors").is_file():
            print(said)
            return 1
        print(f"uninterrupted: {sizes.steps} steps in {time.monotonic() - began:.0f} s", flush=True)
        while counts["kills"] < settings.kills:
            killed = Path(place) / f"killed-{counts['runs']}"
            if not _killed_run(clips, killed, sizes, draw, counts, settings.kills):
                return 1
            counts["runs"] += 1
            counts["equal"] += same(whole, killed)
            lost = [each["lost"] for each in counts["each"]]
            mean = round(float(np.mean(lost)), 2)
            counts |= {"most steps lost": max(lost), "mean steps lost": mean, **sizes._asdict()}
            settings.out.parent.mkdir(parents=True, exist_ok=True)
            write_json(settings.out, counts)
            print(
                f"{counts['kills']} kills, {counts['while writing a checkpoint']} of them while a checkpoint was being "
                f"written, at most {max(lost)} steps lost; {counts['equal']} of {counts['runs']} runs ended in the "
                f"uninterrupted weights and log ({time.monotonic() - began:.0f} s)",
                flush=True,
            )
    # Saving is asynchronous: the newest checkpoint may not have been complete yet, so one more interval may be lost.
    return int(counts["equal"] < counts["runs"] or counts["most steps lost"] > 2 * sizes.checkpoint_every)


def _killed_run(
    clips: Path, folder: Path, sizes: Sizes, draw: random.Random, counts: dict[str, Any], kills: int
) -> bool:
    """One run to its end, killed until no kills are left; False if it could not resume."""
    while True:
        process = start(clips, folder, sizes)
        before = logged(folder)
        sort = kill(process, folder, draw) if counts["kills"] < kills else None
        if sort is None:
            said, _ = process.communicate()
            if process.returncode == 0:
                return True
            print(f"after {counts['kills']} kills the run did not resume:\n{said}")
            return False
        seen, kept, torn = logged(folder), newest(folder), sort != "starting" and writing(folder)
        counts["kills"] += 1
        counts["while writing a checkpoint"] += torn
        counts["each"].append({"when": sort, "logged": seen, "resumes from": kept, "lost": max(seen - kept, 0)})
        print(f"kill {counts['kills']}, {sort}: step {before} to {seen}, resumes from {kept}", flush=True)


def same(first: Path, second: Path) -> bool:
    """Whether two runs ended with the same bytes."""
    names = ("weights.safetensors", "log.jsonl")
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        train(Path(sys.argv[2]), Path(sys.argv[3]), Sizes(*map(int, sys.argv[4:6])))
    else:
        with plain_errors():
            sys.exit(main(tyro.cli(Settings, description=Settings.__doc__)))
