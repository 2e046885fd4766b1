"""``jaxdn train``: a learned method, trained on rendered clips."""

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jax

from jaxdn.data.training.dataset import training_batches
from jaxdn.denoiser import Denoiser
from jaxdn.methods.registry import Method
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.cores import count_cores
from jaxdn.runtime.locks import lock_folder
from jaxdn.training.devices import make_mesh
from jaxdn.training.loop import InitialWeights, ResumableBatches, fit, read_resumed_from
from jaxdn.training.processes import check_same, writes
from jaxdn.training.validation import load_validation
from jaxdn.zoo.weights import save_weights, starting_params

_BUSY = "expected a folder in which no other process trains, one does; wait for its end, or take another --out."


def train(
    method: Method,
    recipe: Recipe,
    clips: Sequence[Path],
    out: Path,
    *,
    options: Mapping[str, Any],
    start: str | Path | None = None,
    validation: Sequence[Path] = (),
    implementation: str = "auto",
    time_limit: float | None = None,
    devices: int | None = None,
    label: str | None = None,
    record: Mapping[str, Any] | None = None,
) -> Path:
    """Train a method to the end, unless it is trained already, and return the path of its weights.

    The weights are the running mean that the recipe asks for. A second call resumes from the newest checkpoint in
    ``out``. Raises ValueError for options that the method does not have, unsuitable clips, a backend that cannot run
    here, and a folder in which another process trains.

    Args:
      method: a row of the table of methods.
      recipe: objective, optimiser, batches.
      clips: folders of clips, or packed sets, to train on.
      out: the run's folder: checkpoints, log.jsonl, recipe.json, and finally weights.safetensors with its JSON.
      options: the method's; they are stored with the weights, and so are the defaults of all others.
      start: shipped weights or a .safetensors file to continue from (:func:`jaxdn.zoo.weights.starting_params`); None:
        new ones.
      validation: folders of held-out clips, or packed sets, used whole.
      implementation: the backend for training; "auto" is the method's fastest that is available here.
      time_limit: seconds after which training stops; the weights of that moment are written all the same.
      devices: number of devices, of each process, that each batch is divided among; default: one, or all of each
        process where there are several.
      label: the run's name in messages; default: that of its folder.
      record: further entries of the weights' JSON.
    """
    if time_limit is not None and not time_limit > 0:
        raise ValueError(f"time limit: expected more than 0, got {time_limit:g} s; leave it out for no limit.")
    recipe.check()  # refused before clips are read and a folder is made, as is what follows
    make_mesh(devices, recipe.batch)
    names = [place.name for place in clips]
    check_same(
        {"method": method.name, "options": dict(options), "devices": devices, "start": start, "clips": names}
        | recipe.record()
    )
    label = out.name if label is None else label
    backend = method.backend("training") if implementation == "auto" else implementation
    if backend not in (None, "reference"):
        denoiser, computes = method.factory(**{**options, "implementation": backend}), f"convolutions run on {backend}"
    else:
        denoiser, computes = method.factory(**options), "everything runs on XLA"
    if writes():
        print(f"{label}: {computes}", flush=True)
    batches = recipe_batches(denoiser, recipe, clips)
    held_out = load_validation(denoiser, validation, spp=min(recipe.spp)) if writes() else []
    first = None
    if start is not None:
        first = InitialWeights(str(start), starting_params(start, denoiser, factory=method.name, options=options))
    with lock_folder(out, _BUSY) if writes() else nullcontext():
        state = fit(
            denoiser,
            recipe,
            batches,
            out,
            label=label,
            start=first,
            method={"method": method.name, "options": _list_options(method, options)},
            validation=held_out,
            time_limit=time_limit,
            devices=devices,
        )
    origin: dict[str, Any] = {} if first is None else {"start": first.name}
    if earlier := read_resumed_from(out):
        origin["begun_with"] = earlier
    about = {
        "recipe": recipe.record(),
        "updates": int(state.step),
        "skipped": int(state.skipped),
        **origin,
        **(record or {}),
    }
    path = out / "weights.safetensors"
    if writes():
        save_weights(path, state.average, factory=method.name, options=dict(options), record=about)
    return path


def _list_options(method: Method, options: Mapping[str, Any]) -> dict[str, Any]:
    """All options but the backend, with which a run may go on that began with another."""
    listed = dataclasses.asdict(method.parse_options(options))
    return {name: value for name, value in listed.items() if name != "implementation"}


def recipe_batches(denoiser: Denoiser, recipe: Recipe, clips: Sequence[Path]) -> ResumableBatches:
    """The batches that a recipe asks for, with the buffers that the denoiser and the objective read, without end: of
    each the part of this process.

    ``clips`` are folders of clips, or packed sets.
    """
    return training_batches(
        clips,
        buffers=denoiser.reads | recipe.objective.reads,
        batch=recipe.batch,
        crop=recipe.crop,
        frames=recipe.frames,
        seed=recipe.seed,
        spp=recipe.spp,
        layers=denoiser.samples is not None,
        variation=recipe.variation,
        process=(jax.process_index(), jax.process_count()),
        vary_later=True,
        threads=max(1, count_cores() // 2),  # a GPU takes a hundred elements a second, a thread makes twelve
    )
