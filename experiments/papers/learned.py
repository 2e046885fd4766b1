"""The learned relatives on the same clips with the same number of updates: which of the papers' claims hold here?

    python -m experiments.papers.learned --rooms rooms/*/scene.xml [--scenes scenes]      # resumable

Renders clips with layers of 1, 2, 4, 8 and 16 samples, trains every stage of :data:`STAGES` in its small size at four
samples a pixel, and scores them, with filters and shipped weights, on clips of seeds and scenes that none has seen.
Writes ``runs/learned/table.md``, a report, every method's image, and where ``ntasd`` and ``dasr`` put their samples.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax

from experiments.papers import results, rooms
from experiments.papers.preintegration import save_pictures
from jaxdn import color
from jaxdn.candidates import NOISY, Candidate, candidate
from jaxdn.clips import find_clips, read_clip
from jaxdn.commands.compare import compare
from jaxdn.commands.errors import plain_errors
from jaxdn.commands.render import render
from jaxdn.commands.train import train
from jaxdn.frame import Clip, frame_at, only
from jaxdn.methods.table import method_named
from jaxdn.report import write_report
from jaxdn.report.images import save_png
from jaxdn.report.results import mean_scores
from jaxdn.rollout import sampled

FAMILIES = ("parlour", "fruit", "mobile", "pinkroom", "robot")
LAYERS = [1, 2, 4, 8, 16, 32]
BUDGET = 4
READERS = "ntd,rae,arae,ntasd,dasr,svgf,steady"


class Stage(NamedTuple):
    """One run of training."""

    method: str
    options: dict[str, Any]


STAGES = {
    "ntasd": Stage("ntasd", {"size": "small"}),
    "ntasd, uniform": Stage("ntasd", {"size": "small", "adaptive": False}),
    "ntasd, three scales": Stage("ntasd", {"size": "small", "prediction": "three-scales"}),
    "ntasd, one scale": Stage("ntasd", {"size": "small", "prediction": "one-scale"}),
    "ntasd, direct": Stage("ntasd", {"size": "small", "prediction": "direct"}),
    "dasr": Stage("dasr", {"size": "small"}),
    "dasr, uniform": Stage("dasr", {"size": "small", "adaptive": False}),
    "ntd": Stage("ntd", {"size": "small"}),
    "rae": Stage("rae", {"size": "small"}),
    "arae": Stage("arae", {"size": "small"}),
}
"""Those that ask for samples have the budget in the mean; the others see that many everywhere."""


@dataclass
class Settings:
    """Train the learned relatives alike and compare them."""

    rooms: list[Path] = field(default_factory=list)
    """Mitsuba scenes (.xml) to make tours of, for training."""
    scenes: list[Path] = field(default_factory=list)
    """Folders of rooms to test on: one folder with a scene.xml each."""
    clips: int = 2
    """Training clips of each room and family."""
    stages: list[str] = field(default_factory=lambda: list(STAGES))
    """The runs to train and compare."""
    steps: int = 400
    """Updates of each."""
    frames: int = 5
    """Frames that the gradient is propagated back through."""
    size: int = 96
    """Width and height of the clips in pixels; of rooms that are tested on, twice that and as high."""
    data: Path = Path("data/learned")
    out: Path = Path("runs/learned")
    workers: int | None = None
    """Number of rendering processes; default: the number of cores."""


def render_all(settings: Settings) -> None:
    """Render what is missing: clips to train on, of seeds from 0 on, and to test on, of seed 2000."""
    size = {"width": settings.size, "height": settings.size}
    shared: dict[str, Any] = {"layers": LAYERS, "draws": BUDGET, "max_depth": None, "effects": "auto"}
    shared |= {"denoiser": READERS, "workers": settings.workers, "frames": 8}
    seeds = list(range(settings.clips))
    for source, tours in [*((str(room), True) for room in settings.rooms), *((name, False) for name in FAMILIES)]:
        place = settings.data / "train"
        render(source, place, animation=None, tours=tours, seeds=seeds, reference_spp=64, **size, **shared)
    place = settings.data / "test"
    for family in FAMILIES:
        render(family, place, animation=None, seeds=[2000], reference_spp=128, **size, **shared)
    wide = {"width": 2 * settings.size, "height": settings.size}
    for scene, animation in rooms.scenes_in(settings.scenes) if settings.scenes else []:
        render(str(scene), place, animation=animation, seeds=[2000], reference_spp=128, **wide, **shared)


def trained(name: str, settings: Settings) -> Candidate:
    """A stage, trained if it is not."""
    stage = STAGES[name]
    method = method_named(stage.method)
    asks = method.knows("budget")
    recipe = method.recipe_named(None)._replace(
        steps=settings.steps, frames=settings.frames, average=0.99, spp=(1,) if asks else (BUDGET,)
    )
    out = settings.out / name.replace(", ", "-").replace(" ", "-")
    weights = train(method, recipe, [settings.data / "train"], out, options=stage.options, label=name)
    return candidate(str(weights))._replace(label=name)


def counts_of(one: Candidate, clip: Clip) -> jax.Array:
    """[T, H, W, 1] the numbers of samples that each frame is given."""
    denoiser, params = one.denoiser, one.params
    assert denoiser is not None

    def step(state: Any, given: Any) -> tuple[Any, jax.Array]:
        frame = sampled(denoiser, params, state, *given)
        return denoiser.step(params, state, frame)[0], frame.sample_count

    frames = only(clip.frames, denoiser.reads)
    return lax.scan(step, denoiser.start(params, frame_at(frames, 0)), (frames, clip.layers))[1]


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Of the ranks of two images (Spearman); ties have the order of their pixels."""
    ranks = [np.argsort(np.argsort(each.ravel(), kind="stable"), kind="stable") for each in (first, second)]
    first, second = (each - each.mean() for each in ranks)
    return float((first * second).sum() / np.sqrt((first**2).sum() * (second**2).sum()))


def save_maps(asking: list[Candidate], folders: list[Path], out: Path) -> str:
    """The map of the last frame of each clip as a picture, and its rank correlation with the noise, as Markdown.

    The noise is that of compressed radiance (:func:`variance_of`).
    """
    lines = ["| clip | " + " | ".join(one.label for one in asking) + " |", "|---" * (len(asking) + 1) + "|"]
    for folder in folders:
        clip = jax.tree.map(jnp.asarray, read_clip(folder, layers=True))
        noise = variance_of(clip)
        cells = []
        for one in asking:
            counts = np.asarray(jax.jit(partial(counts_of, one))(clip))[-1, ..., 0]
            save_png(out / folder.name / f"{one.label}-samples.png", np.sqrt(counts / counts.max()))
            cells.append(f"{correlation(counts, noise):.2f}, 1 to {counts.max():.0f}")
        lines.append(f"| {folder.name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def variance_of(clip: Clip) -> np.ndarray:
    """[H, W] the noise of the last frame at 4 samples and more, as the losses see it, in the mean over 5 x 5 pixels.

    The variance of compressed radiance, of the layers of at least 4 samples: of fewer, the curve hides most of it.
    """
    wanted, layers = color.compress(clip.reference[-1]), clip.layers or {}
    noisy = {n: color.compress(layer[-1]) for n, layer in layers.items() if n >= BUDGET}
    errors = [n * np.square(np.asarray(layer - wanted)).mean(-1) for n, layer in noisy.items()]
    padded = np.pad(np.mean(errors, axis=0), 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    return windows.mean((-1, -2))


def main(settings: Settings) -> None:
    """Render, train, compare. Raises ValueError for an unknown stage."""
    if unknown := [name for name in settings.stages if name not in STAGES]:
        raise ValueError(f"--stages: expected some of {', '.join(STAGES)}, got {', '.join(unknown)}.")
    render_all(settings)
    runs = [trained(name, settings) for name in settings.stages]
    folders = find_clips(settings.data / "test")
    methods = [candidate(NOISY), candidate("svgf"), candidate("steady-balanced"), *runs]
    title = f"Learned relatives after {settings.steps} updates, {BUDGET} samples a pixel"
    found = compare(methods, folders, title=title, settings={"clips": len(folders), "spp": BUDGET}, spp=BUDGET)
    write_report(found, settings.out)
    save_pictures(found, settings.out / "pictures")
    errors = {label: f"{one.unbiased_relative_mse:.4f}" for label, one in mean_scores(found).items()}
    text = results.table(found, {"relative MSE": errors})
    asking = [one for one in runs if one.denoiser is not None and one.denoiser.samples is not None]
    maps = save_maps([one for one in asking if "uniform" not in one.label], folders, settings.out / "pictures")
    (settings.out / "table.md").write_text(f"{text}\n\n{maps}\n")
    print(f"{text}\n\n{maps}")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
