"""Does training wait for its input? Real clips on disk, the real pipeline, the real train step.

The loop waits for the step before it requests the next batch, so that nothing is computed while it waits for input.
Compared with the same step on a batch in memory, the difference is the total cost of the input, including what its
threads take from the step.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.speed.timing import Timing
from experiments.speed.works import scene, steps
from jaxdn.clips import training_batches, write_clip
from jaxdn.recipes.recipe import Recipe
from jaxdn.training.step import init_state, make_train_step

WINDOWS, STEPS = 3, 4
"""Each figure is measured this many times, over this many updates."""


def measure_input(recipe: Recipe) -> dict[str, Timing]:
    """``wait`` and ``loop`` (milliseconds per step in training), and ``alone`` (the step on a batch in memory)."""
    denoiser = steps.METHOD.factory(size="large", **steps.PLAIN)  # its program has been compiled for the train steps
    with tempfile.TemporaryDirectory() as place:
        side = recipe.crop + recipe.crop // 2
        for seed in range(2 * recipe.batch):
            write_clip(scene.clip(recipe.frames + 2, side, side, seed=seed), Path(place) / f"clip-{seed}")
        batches = training_batches(
            place,
            buffers=denoiser.reads,
            batch=recipe.batch,
            crop=recipe.crop,
            frames=recipe.frames,
            seed=recipe.seed,
        )
        held = next(batches)
        state, step = init_state(denoiser, recipe, held), make_train_step(denoiser, recipe)

        def window(next_batch: Callable[[], Any]) -> tuple[float, float]:
            """Milliseconds per step of waiting, and in total."""
            nonlocal state
            waited, began = 0.0, time.perf_counter()
            for _ in range(STEPS):
                asked = time.perf_counter()
                batch = next_batch()
                waited += time.perf_counter() - asked
                state, report = step(state, batch)
                float(report.loss)
            return 1e3 * waited / STEPS, 1e3 * (time.perf_counter() - began) / STEPS

        began = time.perf_counter()
        window(lambda: held)  # compiles
        first = 1e3 * (time.perf_counter() - began)
        samples: dict[str, list[float]] = {"wait": [], "loop": [], "alone": []}
        for _ in range(WINDOWS):
            waited, whole = window(lambda: next(batches))
            samples["wait"].append(waited)
            samples["loop"].append(whole)
            samples["alone"].append(window(lambda: held)[1])
    return {
        name: Timing(float(np.median(values)), min(values), max(values), first, WINDOWS)
        for name, values in samples.items()
    }
