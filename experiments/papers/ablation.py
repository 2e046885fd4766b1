"""The ablation of Zeng et al. 2021, sec. 6.3: noisy, filters, and ntd as A, B and C, on clips not used in training.

A warps the history with traditional motion vectors, B with dual ones, C adds the motion-occlusion loss; all three share
the network, the data, the seed and the number of steps. The demonstration goes on from shipped weights with the loss
that these were trained with, as a few minutes from nothing lose to every filter; so all three begin with weights
that have learned from dual vectors and hidden pixels, and the rows say little of what dual vectors and the occlusion
loss are worth. The specialist begins with new ones and has the paper's loss, whose occlusion term comes in the second
half of training.

    python -m experiments.papers.ablation  # `make train`: a demonstration, a quarter of an hour on two cores
    python -m experiments.papers.ablation --preset specialist  # trained and tested on different clips of one scene

Everything is kept under ``data/`` and ``runs/``: finished clips and runs are reused, interrupted ones are resumed.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report import Results, TrainingCurve, text_table, write_report
from jaxdn.methods.registry import Method, method_named
from jaxdn.recipes.recipe import Recipe
from jaxdn.render import ClipJob, choose_variant, render_clips
from jaxdn.render.settings import RenderSettings
from jaxdn.training.log import read_curve
from jaxdn.training.train import train
from jaxdn.zoo.ready import NOISY, filter_names, find_model
from jaxdn.zoo.weights import describe, shipped_names

FAMILIES = ("fruit", "robot", "pinkroom", "mobile")
METHOD = "ntd"
"""The method under ablation."""


class ClipSet(NamedTuple):
    """Clips rendered with the same settings."""

    clips: tuple[tuple[str, int, int], ...]
    """(family, seed, first frame) of each clip."""
    size: int
    """Width and height in pixels."""
    frames: int
    reference_spp: int


class Run(NamedTuple):
    """One network to train."""

    label: str
    options: Mapping[str, Any]
    """Options of the method."""
    recipe: str
    """The name of one of the method's recipes."""
    steps: int
    about: str
    """What it is, in a few words."""

    @property
    def folder(self) -> str:
        """The name of its folder."""
        return self.label.replace(" ", "-")


class Preset(NamedTuple):
    """A whole experiment."""

    train: ClipSet
    validation: ClipSet
    tests: tuple[ClipSet, ...]
    runs: tuple[Run, ...]
    learning: Mapping[str, Any]
    """Entries of the runs' recipes that differ from the method's own."""
    start: str | None = None
    """The shipped weights that every run goes on from; None: new ones."""

    def recipe(self, method: Method, run: Run) -> Recipe:
        """How a run is trained."""
        return method.recipe_named(run.recipe)._replace(**self.learning, steps=run.steps)


def _seeds(families: Sequence[str], seeds: range) -> tuple[tuple[str, int, int], ...]:
    return tuple((family, seed, 0) for seed in seeds for family in families)


def _parts(family: str, starts: range) -> tuple[tuple[str, int, int], ...]:
    """Parts of one scene's animation."""
    return tuple((family, 0, start) for start in starts)


def _abc(steps: int, recipes: tuple[str, str]) -> dict[str, Run]:
    """The three runs of the paper's ablation, with the small network; ``recipes``: without the occlusion loss, with."""
    traditional, dual = ({"size": "small", "motion": motion} for motion in ("traditional", "dual"))
    return {
        "A": Run("A", traditional, recipes[0], steps, "ntd, traditional motion vectors"),
        "B": Run("B", dual, recipes[0], steps, "ntd, dual motion vectors"),
        "C": Run("C", dual, recipes[1], steps, "ntd, dual motion vectors and motion-occlusion loss"),
    }


PRESETS = {
    "demo": Preset(
        train=ClipSet(_seeds(FAMILIES, range(2)), size=64, frames=10, reference_spp=32),
        validation=ClipSet((("fruit", 100, 0),), size=64, frames=10, reference_spp=32),
        tests=(ClipSet((*_seeds(FAMILIES[1:], range(200, 201)), ("edge", 200, 0)), 96, 10, reference_spp=256),),
        runs=tuple(_abc(100, ("without-occlusion", "usual")).values()),
        learning={"crop": 48},
        start="ntd-small",
    ),
    "specialist": Preset(
        train=ClipSet(_parts("pinkroom", range(0, 400, 20)), size=96, frames=10, reference_spp=96),
        validation=ClipSet(_parts("pinkroom", range(500, 501)), size=96, frames=10, reference_spp=96),
        tests=(ClipSet(_parts("pinkroom", range(600, 680, 20)), size=96, frames=10, reference_spp=128),),
        runs=tuple(_abc(400, ("paper-loss-without-occlusion", "paper-loss")).values()),
        learning={"learning_rate": 2e-3, "crop": 48},
    ),
}


@dataclass
class Settings:
    """Render clips, train the denoiser and its ablations, evaluate them on held-out clips, write a report."""

    preset: Literal["demo", "specialist"] = "demo"
    """demo: SMALL networks that go on from shipped weights on eight small clips. specialist: trained and
    tested on different clips of one scene, as in one row of Hasselgren et al. 2020, table 2; the loss and the
    optimiser's kind are those of Zeng et al."""
    name: str | None = None
    """Folder under runs/ for weights, logs and the report; default: the preset's name."""
    only: Literal["all", "render", "train", "report"] = "all"
    """Run only one stage, with the results of the earlier stages."""
    runs: tuple[str, ...] = ()
    """Labels of the runs to train; default: all of the preset."""
    workers: int | None = None
    """Number of rendering processes; default: the number of cores."""


def jobs(clips: ClipSet, folder: Path) -> list[ClipJob]:
    """What to render for a set of clips."""
    return [
        ClipJob(
            {"family": family, "seed": seed, **({"start": start} if start else {})},
            str(place),
            clips.frames,
            RenderSettings(width=clips.size, height=clips.size, reference_spp=clips.reference_spp, seed=seed + start),
        )
        for (family, seed, start), place in zip(clips.clips, folders(clips, folder), strict=True)
    ]


def folders(clips: ClipSet, folder: Path) -> list[Path]:
    """The folders of a set's clips."""
    return [folder / f"{family}-{seed}{f'-{start}' if start else ''}" for family, seed, start in clips.clips]


def render(preset: Preset, data: Path, workers: int | None) -> dict[str, Any]:
    """Render the missing clips of a preset; returns the report's entry for the renderer."""
    choice = choose_variant()
    print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
    parts = [(preset.train, "train"), (preset.validation, "validation"), *((each, "test") for each in preset.tests)]
    render_clips([job for clips, part in parts for job in jobs(clips, data / part)], workers=workers)
    return {"renderer": f"Mitsuba, {choice.variant}"}


def train_run(run: Run, preset: Preset, data: Path, folder: Path) -> Path:
    """Train one network to the end, unless it is trained already; returns the path of its weights."""
    method = method_named(METHOD)
    families = ", ".join(dict.fromkeys(family for family, _, _ in preset.train.clips))
    origin = {"trained_on": f"{len(preset.train.clips)} clips of {families}", "run": run.label}
    return train(
        method,
        preset.recipe(method, run),
        folders(preset.train, data / "train"),
        folder / run.folder,
        options=run.options,
        start=preset.start,
        validation=folders(preset.validation, data / "validation"),
        label=run.label,
        record={"data": origin},
    )


def _after(start: str | None) -> str:
    return "" if start is None else f", from {start} on"


def evaluate(preset: Preset, settings: Settings, data: Path, folder: Path, machine: dict[str, Any]) -> Results:
    """Score the noisy image, every filter, every run that has weights, and shipped weights on the test clips."""
    contestants = [find_model(name) for name in (NOISY, *filter_names())]
    curves, about = {}, {}
    for run in sorted(preset.runs, key=lambda run: run.label):
        path = folder / run.folder / "weights.safetensors"
        if path.is_file():
            contestants.append(find_model(str(path))._replace(label=run.label))
            about[run.label] = f"{run.about}: {run.steps} steps here{_after(preset.start)}"
            curves[run.label] = TrainingCurve(*read_curve(path.parent))
    for name in shipped_names():
        contestants.append(find_model(name))
        about[name] = f"{method_named(describe(name)['factory']).title}: shipped with jaxdn"
    tests = [place for clips in preset.tests for place in folders(clips, data / "test")]
    recipe = preset.recipe(method_named(METHOD), preset.runs[0]).record()
    facts = {
        "preset": settings.preset,
        "training clips": len(preset.train.clips),
        "test clips (held out)": len(tests),
        "training steps": ", ".join(f"{run.label} {run.steps}" for run in preset.runs) + _after(preset.start),
        **{key.replace("_", " "): value for key, value in recipe.items() if key not in ("steps", "objective")},
    }
    title = "Neural temporal denoising: the ablation"
    results = compare(contestants, tests, title=title, settings=facts, training=curves, about=about)
    return results._replace(machine={**results.machine, **machine})


def main(settings: Settings) -> None:
    """Render, train, evaluate, report."""
    began = time.monotonic()
    preset = PRESETS[settings.preset]
    data, folder = Path("data") / settings.preset, Path("runs") / (settings.name or settings.preset)
    machine: dict[str, Any] = {}
    if settings.only in ("all", "render"):
        machine = render(preset, data, settings.workers)
        print(f"rendered: {time.monotonic() - began:.0f} s so far", flush=True)
    if settings.only in ("all", "train"):
        for run in preset.runs:
            if not settings.runs or run.label in settings.runs:
                train_run(run, preset, data, folder)
        print(f"trained: {time.monotonic() - began:.0f} s so far", flush=True)
    if settings.only in ("all", "report"):
        results = evaluate(preset, settings, data, folder, machine)
        page = write_report(results, folder)
        print(text_table(results))
        print(f"metrics: {folder / 'metrics.json'}\nreport:  {page}  ({time.monotonic() - began:.0f} s in all)")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
