"""One update of training: batch 4, 10 frames, back-propagation through all of them, ours and PyTorch's."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import peers, roofline
from experiments.speed.timing import Call
from experiments.speed.works import Work, scene
from experiments.speed.works.steps import METHOD, PLAIN, WIDTHS, implementations
from jaxdn.core.frame import Clip
from jaxdn.networks.backends import BACKENDS
from jaxdn.recipes.recipe import Recipe
from jaxdn.training.step import init_state, make_train_step

RECIPE = METHOD.recipe_named(None)._replace(decay=False)
CASES = (("large", 64), ("large", 128))
"""(size, crop in pixels). The slowest to compile, rematerialised and PyTorch's, are compared only at the first."""


def batch_of(crop: int, recipe: Recipe = RECIPE) -> Clip:
    """A batch of clips [B, T, H, W, C] as NumPy arrays."""
    clips = [scene.clip(recipe.frames, crop, crop, seed=seed) for seed in range(recipe.batch)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *clips)


def ours(size: str, crop: int, *, rematerialize: bool = False, **options: Any) -> Call:
    """A call that makes one update; state and batch are on the device, the old state's memory is donated."""
    recipe, batch = RECIPE._replace(rematerialize=rematerialize), batch_of(crop)
    denoiser = METHOD.factory(size=size, **PLAIN, **options)
    state = [init_state(denoiser, recipe, batch)]
    step, there = make_train_step(denoiser, recipe), jax.tree.map(jnp.asarray, batch)

    def call() -> float:
        state[0], report = step(state[0], there)
        return float(report.loss)

    return call


def pytorch(size: str, crop: int, recipe: Recipe = RECIPE, *, compiled: bool) -> Call:
    """The same in PyTorch."""
    from experiments.speed.peers import pytorch as peer
    from experiments.speed.peers.pytorch_training import Trainer, batch_tensors

    peer.prepare_process()
    batch = batch_of(crop, recipe)
    params = init_state(METHOD.factory(size=size, **PLAIN), recipe, batch).params
    trainer = Trainer(WIDTHS[size], params, recipe, compiled=compiled)
    tensors = batch_tensors(batch)
    return lambda: trainer(*tensors)


def works() -> Iterator[Work]:
    """``train-large-64`` and so on: plain, with each backend for training available here, rematerialised, and with huge
    pages, which ``make train`` asks for."""
    lacking = peers.missing()
    forms = implementations("training").items()
    for size, crop in CASES:
        mine: dict[str, Callable[[], Call]] = {
            name: partial(ours, size, crop, **options)
            for name, options in forms
            if name not in BACKENDS or BACKENDS[name].available()
        }
        pages: dict[str, Callable[[], Call]] = {}
        others: dict[str, Callable[[], Call]] = {}
        if "torch" not in lacking:
            others["torch-eager"] = partial(pytorch, size, crop, compiled=False)
        if (size, crop) == CASES[0]:
            pages = {f"{name}-huge-pages": build for name, build in mine.items()}
            mine["xla-remat"] = partial(ours, size, crop, rematerialize=True)
            if "torch-compiled" not in lacking:
                others["torch-compiled"] = partial(pytorch, size, crop, compiled=True)
        yield Work(
            f"train-{size}-{crop}",
            mine | pages,
            others,
            roofline.train_step(WIDTHS[size], crop, batch=RECIPE.batch, frames=RECIPE.frames),
            rounds=4 if crop < 128 else 3,
            huge_pages=frozenset(pages),
        )
