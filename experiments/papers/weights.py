"""The shipped weights: render clips, fit `svgf`, `relax`, train `steady`, `ntd-small`, `ntd-large`, A, B, C.

    python -m experiments.papers.weights --rooms rooms/*/scene.xml    # `make weights`: hours; resumable

Clips: furnished Mitsuba scenes with randomised animations, and the procedural families; 128 x 128 pixels, 10 frames,
references of 32 samples and six more single samples, 16 to 48 seconds of one core each. The rooms that the shipped
weights saw are six of Benedikt Bitterli's rendering resources (bathroom, kitchen, living-room-2, spaceship,
veach-ajar, veach-lamp); without ``--rooms`` the families are all there is. Finished clips and stages are reused,
interrupted ones go on. Each network is trained at a constant rate first, so that it can always be continued, and with a
falling rate at the end; LARGE begins as SMALL grown (:mod:`jaxdn.networks.grow`). A, B and C take the same number of
updates.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.data.clip.folder import is_clip, read_record
from jaxdn.methods.registry import method_named
from jaxdn.recipes.objectives import Objective, unbiased_illumination
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import ClipSource, render
from jaxdn.training.train import train
from jaxdn.zoo.weights import SHIPPED, shipped_names

FAMILIES = {"parlour": 90, "fruit": 14, "mobile": 14, "pinkroom": 14, "robot": 14}
"""Clips of each procedural family."""
CLIP = RenderSettings(width=128, height=128, reference_spp=32, draws=6)
"""How each of them is rendered."""
FRAMES = 10
BLOCK = 4
"""Clips of each kind that are rendered before the next kind has its turn."""


class Stage(NamedTuple):
    """One run of training."""

    name: str
    method: str
    options: Mapping[str, Any]
    steps: int
    start: str = ""
    """The stage to continue from."""
    decay: bool = True
    recipe: str = "usual"
    objective: Objective | None = None
    """Instead of the recipe's."""


SQUARES = unbiased_illumination(squared_from=0.0)
"""For stages whose start has had its L1, which would make images darker again."""

STAGES = (
    Stage("svgf-fitted", "svgf", {}, 300),
    Stage("relax-fitted", "relax", {}, 300),
    Stage("steady-begun", "steady", {"quality": "balanced"}, 8000, decay=False),
    Stage("steady-balanced", "steady", {"quality": "balanced"}, 1000, start="steady-begun", recipe="finish"),
    Stage("high-begun", "steady", {"quality": "high"}, 4000, start="steady-balanced", decay=False),
    Stage("steady-high", "steady", {"quality": "high"}, 1000, start="high-begun", recipe="finish"),
    Stage("fast-begun", "steady", {"quality": "fast"}, 4000, decay=False),
    Stage("steady-fast", "steady", {"quality": "fast"}, 1000, start="fast-begun", recipe="finish"),
    Stage("small-begun", "ntd", {"size": "small"}, 4000, decay=False),
    Stage("ntd-small", "ntd", {"size": "small"}, 1000, start="small-begun", recipe="finish"),
    Stage("large-begun", "ntd", {"size": "large"}, 2000, start="small-begun", decay=False, objective=SQUARES),
    Stage("ntd-large", "ntd", {"size": "large"}, 1000, start="large-begun", recipe="finish"),
    Stage("A", "ntd", {"size": "small", "motion": "traditional"}, 500, recipe="without-occlusion"),
    Stage("B", "ntd", {"size": "small", "motion": "dual"}, 500, recipe="without-occlusion"),
    Stage("C", "ntd", {"size": "small", "motion": "dual"}, 500),
)
"""Those with the name of shipped weights are what is shipped."""


@dataclass
class Settings:
    """Render the training clips, train the shipped weights and the paper's ablation."""

    rooms: list[Path] = field(default_factory=list)
    """Mitsuba scenes (.xml) to animate at random."""
    tours: int = 30
    """Clips of each of them."""
    stages: list[str] = field(default_factory=lambda: [stage.name for stage in STAGES])
    """The runs to train."""
    data: Path = Path("data/weights")
    """Folder for the clips."""
    out: Path = Path("runs/weights")
    """Folder for the runs."""
    workers: int | None = None
    """Number of rendering processes; default: the number of cores."""
    ship: bool = False
    """Put the weights into the package."""


def render_all(settings: Settings) -> None:
    """Render what is missing: training clips of seeds from 0 on, and a validation clip of seed 1000 of each kind.

    In clips of odd seeds mirrors and glass are seen through, so that networks know both kinds of guides.
    """
    sources = [(str(room), settings.tours, True) for room in settings.rooms]
    sources += [(family, clips, False) for family, clips in FAMILIES.items()]
    blocks = [
        ("train", range(first, first + BLOCK)) for first in range(0, max(clips for _, clips, _ in sources), BLOCK)
    ]
    # Block by block, so that what is there is a mixture of all kinds at any time.
    for part, seeds in [*blocks, ("validation", range(1000, 1001))]:
        for (scene, clips, randomised), odd in itertools.product(sources, (False, True)):
            wanted = replace(CLIP, see_through=odd)
            out, name = settings.data / part, SceneFile.name_of(scene) if randomised else scene
            chosen = [seed for seed in seeds if seed % 2 == odd and (seed < clips or part == "validation")]
            # A clip that is there is not opened again to plan it: that takes 20 seconds each.
            chosen = [seed for seed in chosen if not _is_rendered(out / f"{name}-{seed}", wanted)]
            if not chosen:
                continue
            denoisers = ",".join({stage.method: None for stage in STAGES})
            source = ClipSource(scene, chosen, FRAMES, randomised=randomised, denoiser=denoisers)
            render(source, out, wanted, workers=settings.workers)


def _is_rendered(folder: Path, wanted: RenderSettings) -> bool:
    """Whether a folder is a finished clip that was rendered as wanted, whatever its seed and its plan."""
    if not is_clip(folder):
        return False
    record = read_record(folder)
    own = RenderSettings.from_record(record)
    return record["frames"] == FRAMES and wanted == replace(own, seed=0, plan=None, variant=None, max_depth=None)


def train_stage(stage: Stage, settings: Settings) -> Path:
    """The weights of a stage, trained if they do not exist."""
    method = method_named(stage.method)
    recipe = method.recipe_named(stage.recipe)
    # The few numbers of a filter are at rest sooner, and "finish" is as it was when the shipped weights were trained:
    # their own recipes say over how many updates the mean is taken.
    average = recipe.average if method.filter or stage.recipe == "finish" else 0.99
    recipe = recipe._replace(steps=stage.steps, decay=stage.decay, average=average, spp=(1, 1, 1, 2, 4, 16))
    if stage.objective is not None:
        recipe = recipe._replace(objective=stage.objective)
    return train(
        method,
        recipe,
        [settings.data / "train"],
        settings.out / stage.name,
        options=stage.options,
        start=str(settings.out / stage.start / "weights.safetensors") if stage.start else None,
        validation=[settings.data / "validation"],
        label=stage.name,
    )


def main(settings: Settings) -> None:
    """Render, train, ship. Raises ValueError for an unknown stage."""
    known = [stage.name for stage in STAGES]
    if unknown := [name for name in settings.stages if name not in known]:
        raise ValueError(f"--stages: expected some of {', '.join(known)}, got {', '.join(unknown)}.")
    render_all(settings)
    for stage in STAGES:
        if stage.name in settings.stages:
            weights = train_stage(stage, settings)
            if settings.ship and stage.name in shipped_names():
                for suffix in (".safetensors", ".json"):
                    (SHIPPED / stage.name).with_suffix(suffix).write_bytes(weights.with_suffix(suffix).read_bytes())


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
