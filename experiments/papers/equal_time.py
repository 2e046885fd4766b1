"""Training runs of equal time: what one choice brings when all others, and the minutes, stay the same.

A :class:`Study` lists rows, each of which changes one thing of another row. Every row is trained in a process of its
own, from new weights, for the same number of seconds, not counting compilation; the rate is constant and the running
mean of the weights is what is scored, so that no schedule needs to know the number of updates. Rows that exist are not
trained again. To train two rows at once, give every process its core: ``taskset -c 0``, with half of ``--rows`` each.
"""

import contextlib
import json
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import tyro

from experiments.papers.results import indirect
from jaxdn.clips import find_clips
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report.results import mean_scores
from jaxdn.methods.registry import Method, method_named
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.atomic_files import write_json
from jaxdn.training.step import begun, initial_state, make_train_step
from jaxdn.training.train import recipe_batches
from jaxdn.zoo.ready import candidate
from jaxdn.zoo.weights import save_weights, starting_params


@dataclass
class Settings:
    """Train one network for each choice, all for as long, and compare them."""

    clips: Annotated[Path, tyro.conf.Positional]
    """Folder of clips to train on, with single samples (`jaxdn render --draws`)."""
    tests: list[Path]
    """Folders of clips to score on, each a column, with as many single samples as the largest of `spp`."""
    minutes: float = 6.0
    """Minutes of training for each row, not counting compilation."""
    crop: int = 64
    batch: int = 4
    frames: int = 10
    spp: list[int] = field(default_factory=lambda: [1])
    """Samples per pixel to score at."""
    rows: list[str] = field(default_factory=list)
    """Names of the rows to train; default: all."""
    out: Path = Path("runs/choices")
    """Folder for the weights and scores."""


class Row(NamedTuple):
    """One change to what another row is trained with."""

    name: str
    on: str = ""
    """The row that it changes; none for the first."""
    options: Mapping[str, Any] = {}
    """Of the method."""
    recipe: Mapping[str, Any] = {}
    batch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of the number of elements, of their width and of their frames."""
    start: str | None = None
    """Weights to continue from."""
    clips: Callable[[Path, Path], None] | None = None
    """Writes a folder with the clips in another form."""
    change: Callable[[], AbstractContextManager[Any]] = contextlib.nullcontext
    """Inside of it the method's code is another: for what no option changes."""


class Study(NamedTuple):
    """What is measured."""

    method: str
    options: Mapping[str, Any]
    """Of the first row, before its own."""
    recipe: str
    """The name of the first row's recipe, before its own changes."""
    rows: Sequence[Row]

    def resolved(self) -> dict[str, tuple[Row, dict[str, Any], Recipe]]:
        """Name -> row, options of the method and recipe, the sum of all changes."""
        found: dict[str, tuple[Row, dict[str, Any], Recipe]] = {}
        for row in self.rows:
            options: dict[str, Any] = dict(self.options)
            recipe = method_named(self.method).recipe_named(self.recipe)._replace(decay=False)
            if row.on:
                _, options, recipe = found[row.on]
            found[row.name] = row, {**options, **row.options}, recipe._replace(**row.recipe)
        return found


def run(study: Callable[[], Study], settings: Settings) -> None:
    """Train and score the rows, and print the table. Raises ValueError for an unknown row, and for one that is there
    with other settings.

    ``study`` is a function of a module, for the processes to call: objectives cannot be sent to them.
    """
    every = study().resolved()
    if unknown := [name for name in settings.rows if name not in every]:
        raise ValueError(f"--rows: expected some of {', '.join(every)}; got {', '.join(unknown)}.")
    chosen = [name for name in every if not settings.rows or name in settings.rows]
    for name in chosen:
        if not _trained_before(settings, name):
            # A process of its own: a row that changes code must not leave programs behind for the next.
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
                process.submit(_train_and_score, study, settings, name).result()
    print(table(every, settings))


def _train_and_score(study: Callable[[], Study], settings: Settings, name: str) -> None:
    row, options, recipe = study().resolved()[name]
    method, out = method_named(study().method), settings.out / folder_name(name)
    clips = settings.clips
    if row.clips is not None:
        clips = out / "clips"
        row.clips(settings.clips, clips)
    elements, width, frames = row.batch
    recipe = recipe._replace(
        batch=max(1, round(settings.batch * elements)),
        crop=round(settings.crop * width),
        frames=round(settings.frames * frames),
    )
    with row.change():
        weights, about = _trained(method, options, recipe, clips, out, row.start, 60.0 * settings.minutes)
        contestant = candidate(str(weights))._replace(label=name)
        scores: dict[str, dict[str, dict[str, float]]] = {}
        for place in settings.tests:
            for spp in settings.spp:
                results = compare(
                    [contestant], find_clips(place), title=name, settings={"spp": spp}, spp=spp, read=indirect
                )
                mean = mean_scores(results)[name]
                found = {"psnr": mean.unbiased_psnr, "temporal": mean.unbiased_temporal_psnr, "flip": mean.flip}
                scores.setdefault(place.name, {})[str(spp)] = found
    write_json(_scores_of(settings, name), {**about, "settings": _asked(settings), "scores": scores})


def _trained(
    method: Method,
    options: Mapping[str, Any],
    recipe: Recipe,
    clips: Path,
    out: Path,
    start: str | None,
    seconds: float,
) -> tuple[Path, dict[str, float]]:
    """The weights after so many seconds of updates, and how many updates and seconds there were."""
    engine = method.engine("training", options)
    denoiser = method.factory(**options) if engine is None else method.factory(**options, implementation=engine)
    batches = recipe_batches(denoiser, recipe, [clips])
    state = initial_state(denoiser, recipe, next(batches))
    if start is not None:
        state = begun(jax.tree.map(jax.numpy.array, starting_params(start, denoiser)), recipe)
    update = make_train_step(denoiser, recipe)
    state, _ = jax.block_until_ready(update(state, next(batches)))  # compiled by now
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        state, _ = jax.block_until_ready(update(state, next(batches)))
    about = {"updates": int(state.step), "skipped": int(state.skipped), "seconds": time.monotonic() - began}
    print(f"{out.name}: {about}", flush=True)
    record = {"recipe": recipe.record(), **about}
    path = out / "weights.safetensors"
    return save_weights(path, state.average, factory=method.name, options=dict(options), record=record), about


def folder_name(label: str) -> str:
    """The folder of a row's run."""
    return label.replace(" ", "-").replace(",", "")


def _scores_of(settings: Settings, name: str) -> Path:
    return settings.out / folder_name(name) / "scores.json"


def _asked(settings: Settings) -> dict[str, Any]:
    """What rows must have in common to be compared."""
    places = {"clips": str(settings.clips), "tests": [str(place) for place in settings.tests]}
    numbers = {name: getattr(settings, name) for name in ("minutes", "crop", "batch", "frames", "spp")}
    return {**places, **numbers}


def _trained_before(settings: Settings, name: str) -> bool:
    path = _scores_of(settings, name)
    if not path.is_file():
        return False
    there = json.loads(path.read_text()).get("settings")
    if there != _asked(settings):
        raise ValueError(f"{path}: expected a row of {_asked(settings)}, got one of {there}; give another --out.")
    return True


def table(every: Mapping[str, tuple[Row, Any, Any]], settings: Settings) -> str:
    """One line of Markdown per row: updates, then PSNR / temporal PSNR of each place and sample count, and the gain."""
    done = {
        name: json.loads(_scores_of(settings, name).read_text()) for name in every if _trained_before(settings, name)
    }
    columns = [(place.name, str(spp)) for place in settings.tests for spp in settings.spp]
    titles = ["row", "changes", "updates", *(f"{place}, {spp} spp | gain" for place, spp in columns)]
    lines = [f"| {' | '.join(titles)} |", "|---" * (3 + 2 * len(columns)) + "|"]
    for name, found in done.items():
        before = done.get(every[name][0].on)
        cells = [name, every[name][0].on, str(found["updates"])]
        for place, spp in columns:
            new = found["scores"][place][spp]
            cells.append(f"{new['psnr']:.2f} / {new['temporal']:.2f}")
            old = before["scores"][place][spp] if before else None
            gains = [new[key] - old[key] for key in ("psnr", "temporal")] if old else []
            cells.append(" / ".join(f"{gain:+.2f}" for gain in gains))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
