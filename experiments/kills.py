"""Training that is killed (SIGKILL) at random moments ends in the same weights, bit for bit.

    python -m experiments.kills --kills 50

A tiny network is trained once in peace, and once by a process that is killed again and again, anywhere: while it
starts, compiles, trains, or writes a checkpoint. Started once more each time, it must lose nothing but the steps since
its last checkpoint, and end with the weights, and the log, of the undisturbed run.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro

from jaxdn.commands.errors import told_plainly

STEPS, EVERY = 600, 3
WIDTHS = ((4,), (4,), (4,), (4,), (4,))


@dataclass
class Settings:
    """Kill a training run at random moments and see what is left."""

    kills: int = 50
    seed: int = 0
    """Decides the moments."""


def make_clips(folder: Path) -> None:
    """Three small clips of noise around a slope."""
    from jaxdn.clips import write_clip
    from jaxdn.frame import Clip, Frame

    for seed in range(3):
        rng = np.random.default_rng(seed)
        reference = np.broadcast_to(np.linspace(0.1, 0.9, 20, dtype=np.float32)[:, None, None], (5, 20, 20, 3))
        noisy = (reference * rng.exponential(size=(5, 20, 20, 1))).astype(np.float32)
        write_clip(Clip(Frame(noisy, albedo=np.ascontiguousarray(reference)), reference), folder / f"clip-{seed}")


def train(clips: Path, folder: Path) -> None:
    """Train to the end, from wherever the folder stands, and write the weights."""
    from jaxdn.clips import training_batches
    from jaxdn.commands.train import fit
    from jaxdn.denoisers import ntd
    from jaxdn.training import Recipe
    from jaxdn.weights import save_weights

    jax.config.update("jax_compilation_cache_dir", str(clips.parent / "programs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    denoiser = ntd(size=WIDTHS)
    recipe = Recipe(steps=STEPS, batch=2, crop=16, frames=4)
    batches = training_batches(clips, buffers=denoiser.reads, batch=2, crop=16, frames=4, seed=0)
    state = fit(denoiser, recipe, batches, folder, label="killed", log_every=1, checkpoint_every=EVERY)
    save_weights(folder / "weights.safetensors", state.params, factory="ntd", options={"size": WIDTHS}, record={})


def start(clips: Path, folder: Path) -> subprocess.Popen[str]:
    """The training as a process of its own."""
    command = [sys.executable, "-m", "experiments.kills", "--child", str(clips), str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def progress(folder: Path) -> int:
    """Steps in the newest checkpoint."""
    steps = [int(path.name) for path in (folder / "checkpoints").glob("*") if path.name.isdecimal()]
    return max(steps, default=0)


def main(settings: Settings) -> int:
    """Train in peace, train under fire, compare."""
    draw = random.Random(settings.seed)
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        make_clips(root / "clips")
        calm, shot = root / "calm", root / "shot"
        began = time.monotonic()
        said, _ = start(root / "clips", calm).communicate()
        if not (calm / "weights.safetensors").is_file():
            print(said)
            return 1
        print(f"undisturbed: {STEPS} steps in {time.monotonic() - began:.0f} s", flush=True)
        began = time.monotonic()
        start(root / "clips", root / "again").communicate()
        alone = time.monotonic() - began  # with the compiled programs at hand, as every restart has them
        kills, restarts, backwards = 0, 0, 0
        while True:
            process = start(root / "clips", shot)
            restarts += 1
            before = progress(shot)
            if kills < settings.kills:
                try:
                    process.wait(timeout=draw.uniform(0.2, 1.0) * alone * (0.6 if kills < settings.kills - 5 else 1.5))
                except subprocess.TimeoutExpired:
                    os.kill(process.pid, signal.SIGKILL)
                    kills += 1
            said, _ = process.communicate()
            after = progress(shot)
            backwards += after < before
            if process.returncode not in (0, -signal.SIGKILL):
                print(said)
                print(f"after {kills} kills the run did not start again")
                return 1
            if process.returncode == 0:
                if kills >= settings.kills:
                    break
                # Finished too early for all the kills: begin again, the count goes on.
                if not same(calm, shot):
                    break
                shot = root / f"shot-{kills}"
        equal = same(calm, shot)
        print(f"{kills} kills, {restarts} starts, {backwards} times fewer steps than before a kill")
        print("weights and log are those of the undisturbed run" if equal else "THE WEIGHTS OR THE LOG DIFFER")
        return 0 if equal and not backwards else 1


def same(first: Path, second: Path) -> bool:
    """Whether two runs ended with the same bytes."""
    names = ("weights.safetensors", "log.jsonl")
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        train(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        with told_plainly():
            sys.exit(main(tyro.cli(Settings, description=Settings.__doc__)))
