"""The cost of back-propagation through time: memory and time of a train step for clips of 2, 5 and 10 frames.

    python -m experiments.speed.backpropagation [--size large]

Rematerialisation works if memory grows by one frame's state per frame, not by one network's activations.
"""

import time
from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
import tyro

from jaxdn.core.frame import Clip, Frame
from jaxdn.methods.registry import method_named
from jaxdn.training.step import initial_state, make_train_step


@dataclass
class Settings:
    """Compile and time the train step of ntd for several clip lengths, with and without rematerialisation."""

    size: Literal["small", "large"] = "small"
    crop: int = 64
    batch: int = 4
    repeats: int = 3


def random_batch(settings: Settings, frames: int) -> Clip:
    """Noise in the shape of a training batch: costs do not depend on values."""
    rng = np.random.default_rng(0)

    def noise(channels: int) -> np.ndarray:
        return rng.random((settings.batch, frames, settings.crop, settings.crop, channels), dtype=np.float32)

    motion = 4 * noise(2) - 2
    buffers = Frame(noise(3), noise(3), noise(3), noise(1), motion=motion, dual_motion=motion)
    return Clip(buffers, noise(3))


def main(settings: Settings) -> None:
    """Measure and print a table."""
    method = method_named("ntd")
    usual = method.recipe_named(None)._replace(batch=settings.batch, crop=settings.crop)
    print(f"ntd {settings.size}, batch {settings.batch}, {settings.crop} px, on {jax.devices()[0].device_kind}")
    print(f"{'frames':>6} {'rematerialised':>15} {'temporary MiB':>14} {'ms / step':>10} {'compile s':>10}")
    for rematerialize in (False, True):
        before = None
        for frames in (2, 5, 10):
            recipe = usual._replace(frames=frames, rematerialize=rematerialize)
            batch = random_batch(settings, frames)
            denoiser = method.factory(size=settings.size)
            state = initial_state(denoiser, recipe, batch)
            began = time.perf_counter()
            step = make_train_step(denoiser, recipe).lower(state, batch).compile()  # type: ignore[attr-defined]
            compiled = time.perf_counter() - began
            memory = step.memory_analysis().temp_size_in_bytes / 2**20
            state, report = step(state, batch)
            seconds = []
            for _ in range(settings.repeats):
                began = time.perf_counter()
                state, report = step(state, batch)
                jax.block_until_ready(report)
                seconds.append(time.perf_counter() - began)
            growth = "" if before is None else f"  (+{(memory - before[1]) / (frames - before[0]):.2f} MiB per frame)"
            print(
                f"{frames:6} {rematerialize!s:>15} {memory:14.1f} {1e3 * float(np.median(seconds)):10.0f} "
                f"{compiled:10.1f}{growth}",
                flush=True,
            )
            before = (frames, memory)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=Settings.__doc__))
