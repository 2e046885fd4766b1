"""Table 2 and the ablation of Zeng et al. 2021: noisy, svgf, and ntd as A, B and C, on clips none was trained on.

A warps the history with traditional motion vectors, B with dual ones, C adds the motion-occlusion loss in the second
half of training; all three share the network, the data, the seed and the number of steps.

    python -m experiments.papers.ablation                  # `make train`: a demonstration, about a quarter of an hour
    python -m experiments.papers.ablation --preset full    # `make weights`: the shipped weights and the table of the README

Everything is kept under ``data/`` and ``runs/``: what was rendered or trained is used again, and what was interrupted
continues where it stopped.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tyro

from jaxdn.clips import training_batches
from jaxdn.clips.folder import is_clip, read_record
from jaxdn.commands.compare import Method, compare
from jaxdn.commands.errors import told_plainly
from jaxdn.commands.train import fit, load_validation, read_curve, training_engine
from jaxdn.denoisers import ntd, svgf
from jaxdn.recipe import Recipe
from jaxdn.render import ClipJob, choose_variant, render_clips
from jaxdn.report import Results, TrainingCurve, text_table, write_report
from jaxdn.weights import SHIPPED, load_weights, save_weights

FAMILIES = ("fruit", "robot", "pinkroom", "mobile")
FAILURES = ("edge", "dash")


class ClipSet(NamedTuple):
    """Clips rendered with the same settings."""

    clips: tuple[tuple[str, int], ...]
    """(family, seed) of each."""
    size: int
    """Width and height in pixels."""
    frames: int
    reference_spp: int
    layers: tuple[int, ...] = (1,)


class Run(NamedTuple):
    """One network to train."""

    label: str
    size: Literal["small", "large"]
    motion: Literal["dual", "traditional"]
    occlusion: bool
    steps: int


class Preset(NamedTuple):
    """A whole experiment."""

    train: ClipSet
    validation: ClipSet
    tests: tuple[ClipSet, ...]
    runs: tuple[Run, ...]
    recipe: Recipe


def _seeds(families: Sequence[str], seeds: range) -> tuple[tuple[str, int], ...]:
    return tuple((family, seed) for seed in seeds for family in families)


PRESETS = {
    "demo": Preset(
        train=ClipSet(_seeds(FAMILIES, range(2)), size=64, frames=10, reference_spp=32),
        validation=ClipSet((("fruit", 100),), size=64, frames=10, reference_spp=32),
        tests=(ClipSet((*_seeds(FAMILIES[1:], range(200, 201)), ("edge", 200)), 64, 10, reference_spp=64),),
        runs=(
            Run("A", "small", "traditional", occlusion=False, steps=100),
            Run("B", "small", "dual", occlusion=False, steps=100),
            Run("C", "small", "dual", occlusion=True, steps=100),
        ),
        recipe=Recipe(learning_rate=2e-3, crop=48),
    ),
    "full": Preset(
        train=ClipSet(_seeds(FAMILIES, range(6)), size=96, frames=10, reference_spp=96),
        validation=ClipSet(_seeds(FAMILIES, range(100, 101)), size=96, frames=10, reference_spp=96),
        tests=(
            ClipSet(
                (*_seeds(FAMILIES, range(200, 204)), *_seeds(FAILURES, range(200, 202))), 96, 8, 128, layers=(1, 2, 4)
            ),
            ClipSet((("mobile", 300),), size=96, frames=110, reference_spp=64),
        ),
        runs=(
            Run("C large", "large", "dual", occlusion=True, steps=1200),
            Run("C", "small", "dual", occlusion=True, steps=1200),
            Run("B", "small", "dual", occlusion=False, steps=1200),
            Run("A", "small", "traditional", occlusion=False, steps=1200),
        ),
        recipe=Recipe(learning_rate=2e-3, crop=48),
    ),
}

SHIPPED_RUNS = {"C large": "ntd-large", "C": "ntd-small"}
"""The runs of the full preset whose weights come with the package, and their names there."""


@dataclass
class Settings:
    """Render clips, train the denoiser and its ablations, evaluate them on clips never seen, write a report."""

    preset: Literal["demo", "full"] = "demo"
    """demo: SMALL networks and a dozen small clips, to see that it learns. full: the shipped weights."""
    name: str | None = None
    """Folder under runs/ for weights, logs and the report; default: the preset's name."""
    only: Literal["all", "render", "train", "report"] = "all"
    """Do one part of the work alone (on what the parts before it left)."""
    runs: tuple[str, ...] = ()
    """Labels of the runs to train; default: all of the preset."""
    workers: int | None = None
    """Processes that render; default: the cores."""
    ship: bool = False
    """Put the weights of the full preset into the package."""


def jobs(clips: ClipSet, folder: Path) -> list[Any]:
    """What to render for a set of clips."""
    return [
        ClipJob(
            {"family": family, "seed": seed},
            str(folder / f"{family}-{seed}"),
            width=clips.size,
            height=clips.size,
            frames=clips.frames,
            layers=clips.layers,
            reference_spp=clips.reference_spp,
            seed=seed,
            variant=_variant_of(folder / f"{family}-{seed}"),
        )
        for family, seed in clips.clips
    ]


def _variant_of(folder: Path) -> str | None:
    """The variant that a clip was begun with: it is finished, and used again, with the same one."""
    return read_record(folder)["variant"] if is_clip(folder) else None


def folders(clips: ClipSet, folder: Path) -> list[Path]:
    """Where a set's clips lie."""
    return [folder / f"{family}-{seed}" for family, seed in clips.clips]


def train(run: Run, preset: Preset, data: Path, folder: Path) -> None:
    """Train one network to the end (or find it trained) and write its weights."""
    options = {"size": run.size, "motion": run.motion}
    recipe = preset.recipe._replace(steps=run.steps, occlusion=run.occlusion)
    engine = training_engine()
    denoiser = ntd(**options, implementation=engine)  # type: ignore[arg-type]
    print(f"{run.label}: convolutions run on {engine}", flush=True)
    batches = training_batches(
        folders(preset.train, data / "train"),
        buffers=denoiser.reads,
        batch=recipe.batch,
        crop=recipe.crop,
        frames=recipe.frames,
        seed=recipe.seed,
    )
    state = fit(
        denoiser,
        recipe,
        batches,
        folder,
        label=run.label,
        validation=load_validation(folders(preset.validation, data / "validation")),
    )
    how = {"trained_on": f"{len(preset.train.clips)} clips of {', '.join(FAMILIES)}", "run": run.label}
    record = {"recipe": recipe._asdict(), "data": how}
    save_weights(folder / "weights.safetensors", state.params, factory="ntd", options=options, record=record)


def evaluate(preset: Preset, settings: Settings, data: Path, folder: Path, machine: dict[str, Any]) -> Results:
    """Score every method on the test clips."""
    methods = [Method("noisy", None, {}), Method("svgf", svgf(), {})]
    curves = {}
    for run in sorted(preset.runs, key=lambda run: (run.size == "large", run.label)):
        path = folder / _folder_name(run) / "weights.safetensors"
        if path.is_file():
            methods.append(Method(run.label, *load_weights(path)))
            curves[run.label] = TrainingCurve(*read_curve(path.parent))
    tests = [place for clips in preset.tests for place in folders(clips, data / "test")]
    told = {
        "preset": settings.preset,
        "training clips": len(preset.train.clips),
        "test clips (never seen)": len(tests),
        "training steps": ", ".join(f"{run.label} {run.steps}" for run in preset.runs),
        **{key.replace("_", " "): value for key, value in preset.recipe._asdict().items() if key != "steps"},
    }
    results = compare(methods, tests, title="Neural temporal denoising: the ablation", settings=told, training=curves)
    return results._replace(machine={**results.machine, **machine})


def _folder_name(run: Run) -> str:
    return run.label.replace(" ", "-")


def main(settings: Settings) -> None:
    """Render, train, evaluate, report."""
    began = time.monotonic()
    preset = PRESETS[settings.preset]
    data, folder = Path("data") / settings.preset, Path("runs") / (settings.name or settings.preset)
    machine: dict[str, Any] = {}
    if settings.only in ("all", "render"):
        choice = choose_variant()
        machine["renderer"] = f"Mitsuba, {choice.variant}"
        print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
        parts = [(preset.train, "train"), (preset.validation, "validation"), *((each, "test") for each in preset.tests)]
        render_clips([job for clips, part in parts for job in jobs(clips, data / part)], workers=settings.workers)
        print(f"rendered: {time.monotonic() - began:.0f} s so far", flush=True)
    if settings.only in ("all", "train"):
        for run in preset.runs:
            if not settings.runs or run.label in settings.runs:
                train(run, preset, data, folder / _folder_name(run))
        print(f"trained: {time.monotonic() - began:.0f} s so far", flush=True)
    if settings.ship:
        ship(folder)
    if settings.only in ("all", "report"):
        results = evaluate(preset, settings, data, folder, machine)
        page = write_report(results, folder)
        print(text_table(results))
        print(f"metrics: {folder / 'metrics.json'}\nreport:  {page}  ({time.monotonic() - began:.0f} s in all)")


def ship(folder: Path) -> None:
    """Copy the weights of the full preset into the package."""
    for label, name in SHIPPED_RUNS.items():
        for suffix in (".safetensors", ".json"):
            source = folder / label.replace(" ", "-") / f"weights{suffix}"
            (SHIPPED / f"{name}{suffix}").write_bytes(source.read_bytes())


if __name__ == "__main__":
    with told_plainly():
        main(tyro.cli(Settings, description=Settings.__doc__))
