"""What the tables are made from: clips with layers, and networks that are trained on them alike."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from experiments.papers import rooms
from experiments.papers.preintegration import file_name
from jaxdn.clips import find_clips
from jaxdn.denoisers import taa
from jaxdn.methods.registry import is_method, method_named
from jaxdn.recipes.objectives import Objective, unbiased_illumination
from jaxdn.recipes.recipe import Recipe
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import ClipSource, render
from jaxdn.training.train import train
from jaxdn.zoo.ready import Model, find_model

FAMILIES = ("parlour", "fruit", "mobile", "pinkroom", "robot")
HELD_OUT = ("parlour", "mobile", "pinkroom", "robot")
"""The families that :data:`STAGES` leave out of training, one each."""
LAYERS = (1, 2, 4, 8, 16, 32)
REFERENCE_SPP = 64
"""Samples a pixel of the references that networks are trained on."""
BUDGET = 4
"""Samples a pixel: the same everywhere, or in the mean for those who ask for samples. One table has another number."""
TRAINED = "ntd,rae,arae,ntasd,dasr,svgf,steady"
"""The methods whose buffers the training clips have."""
COMPARED = f"{TRAINED},asvgf,trmv"
"""The methods whose buffers the test clips have."""
TEST_SEED = 2000
Clips = Literal["families", "small lights"]
"""What is trained and tested on: rooms and things of :data:`FAMILIES`, of which indirect light is rendered, or what
:mod:`experiments.papers.learned.small_lights` renders."""


class Stage(NamedTuple):
    """One run of training."""

    method: str
    options: dict[str, Any]
    without: str | None = None
    """The family whose clips are left out."""
    only: str | None = None
    """The family whose clips alone are trained on."""
    recipe: str | None = None
    """Of the method; None: the usual one."""
    preset: str = "paper"
    """Of the method, with ``--as-published``."""
    spp: int = BUDGET
    """Samples a pixel of what it is trained on, if it asks for none."""
    start: str | None = None
    """The stage whose weights are its first ones; None: new weights."""
    objective: Objective | None = None
    """Instead of the recipe's."""
    clips: Clips = "families"
    """What it is trained on."""


_EVEN = {"size": "small", "adaptive": False}
BUDGETS = (0.25, 0.5, 1.0, 4.0)
"""Mean samples a pixel of the table of budgets."""
ROTATING = (0.25, 0.5)
"""Those for which pixels can have a pattern that rotates."""


def stage_of_budget(kind: str, budget: float) -> str:
    """The name of a stage of the table of budgets."""
    return f"{kind}, {budget:g} samples"


def _budget_stages() -> Iterator[tuple[str, Stage]]:
    """A network that chooses how many samples, one with pixels at random, and one with a pattern, for each budget.

    Each goes on from that of the next larger budget: new networks of a quarter of a sample stand still for hundreds of
    updates. So at each budget all have had the same number of updates.
    """
    for budget, larger in zip(BUDGETS, [*BUDGETS[1:], None], strict=True):
        fractions = {"size": "small", "budget": budget, "least": 0, "rounding": "stochastic"}
        even = {**fractions, "adaptive": False}
        # Below one sample the pattern alone is better than chance: what a network chooses is rounded by it, too. It
        # places half of the budget: with all of it, it leaves parts of the image without samples for many frames.
        chosen = {**fractions, "least": budget / 2, "pattern": "rotating"}
        kinds = {"ntasd": chosen, "ntasd, uniform": even}
        if budget in ROTATING:
            kinds["ntasd, rotating"] = {**even, "pattern": "rotating"}
        for kind, options in kinds.items():
            before = "ntasd, uniform" if kind == "ntasd, rotating" and larger not in ROTATING else kind
            start = None if larger is None else stage_of_budget(before, larger)
            yield (
                stage_of_budget(kind, budget),
                Stage("ntasd", options, recipe="paper", start=start, clips="small lights"),
            )


CHANGES: dict[str, dict[str, Any]] = {
    "guided kernels": {"options": {"kernels": "guided"}},
    "F_b": {"options": {"demodulate": "brdf"}},
    "our loss": {"objective": unbiased_illumination()},
    "He's weights": {"options": {"initialization": "he"}},
}
"""Where the defaults of ``ntd`` differ from Zeng et al. 2021 -> what of a stage it changes."""


def stage_of_changes(changes: Sequence[str]) -> str:
    """The name of a stage that differs from the paper in these."""
    return ", ".join(["ntd of the paper", *changes])


def _changed_stages() -> Iterator[tuple[str, Stage]]:
    """The paper's settings, each of our changes on top of them, and all of them."""
    for chosen in ((), *((change,) for change in CHANGES), tuple(CHANGES)):
        options: dict[str, Any] = {"preset": "paper", "size": "small"}
        objective = None
        for change in chosen:
            options |= CHANGES[change].get("options", {})
            objective = CHANGES[change].get("objective", objective)
        yield stage_of_changes(chosen), Stage("ntd", options, recipe="paper-loss", spp=1, objective=objective)


TENTH = ((10,), (20, 20), (26, 26), (34, 34), (34, 34))
"""Widths of both networks of ``ntasd`` with 261,020 weights: Hasselgren et al. 2020 say of their small ones that they
have ten times fewer than RAE, which has 2.6 million there."""
_SINGLE_FRAMES = {**_EVEN, "history": "none"}
_UNIFORM = Stage("ntasd", _EVEN, recipe="paper")
_WITHOUT = "paper-loss-without-occlusion"
STAGES = {
    "ntasd": Stage("ntasd", {"size": "small"}, recipe="paper"),
    "ntasd, large": Stage("ntasd", {"size": "large"}, recipe="paper"),
    "ntasd, tenth": Stage("ntasd", {"size": TENTH}, recipe="paper"),
    "ntasd, uniform": _UNIFORM,
    "ntasd, uniform, 64 features": Stage("ntasd", {**_EVEN, "memory": 64}, recipe="paper"),
    "ntasd, uniform, large": Stage("ntasd", {"size": "large", "adaptive": False}, recipe="paper"),
    "single frames, three scales": Stage("ntasd", {**_SINGLE_FRAMES, "prediction": "three-scales"}, recipe="paper"),
    "single frames, direct": Stage("ntasd", {**_SINGLE_FRAMES, "prediction": "direct"}, recipe="paper"),
    "ntasd, uniform, 1 sample": Stage("ntasd", {**_EVEN, "budget": 1.0}, recipe="paper"),
    "ntd, 1 sample": Stage("ntd", {"size": "small"}, recipe="paper-loss", spp=1),
    "ntd, without occlusion": Stage("ntd", {"size": "small"}, recipe=_WITHOUT, spp=1),
    "ntd, traditional, without occlusion": Stage(
        "ntd", {"size": "small", "motion": "traditional"}, recipe=_WITHOUT, spp=1
    ),
    "dasr": Stage("dasr", {"size": "small"}, recipe="hasselgren"),
    "dasr, uniform": Stage("dasr", _EVEN, recipe="hasselgren"),
    "rae": Stage("rae", {"size": "small"}, recipe="hasselgren", preset="hasselgren"),
    "rae, its own loss": Stage("rae", {"size": "small"}, recipe="paper"),
    "arae, its own loss": Stage("arae", {"size": "small"}, recipe="paper"),
    **{f"ntasd, uniform, without {family}": _UNIFORM._replace(without=family) for family in HELD_OUT},
    **{f"ntasd, uniform, only {family}": _UNIFORM._replace(only=family) for family in HELD_OUT},
    **dict(_budget_stages()),
    **dict(_changed_stages()),
}
"""Each by the loss of its paper; those that Hasselgren et al. compare all by theirs, and with
``--as-published`` ``rae`` as they have it."""


@dataclass
class Settings:
    """Train the learned relatives alike and remake the papers' tables. The defaults are small."""

    rooms: list[Path] = field(default_factory=list)
    """Mitsuba scenes (.xml) to animate at random, for training."""
    scenes: list[Path] = field(default_factory=list)
    """Folders of rooms to test on: one folder with a scene.xml each."""
    clips: int = 2
    """Training clips of each room and family."""
    tables: list[str] = field(default_factory=list)
    """Files of this folder whose tables are made, without .py; none: all of them."""
    steps: int = 100
    """Updates of each network."""
    frames: int = 5
    """Frames that the gradient is propagated back through."""
    size: int = 64
    """Width and height of the clips in pixels; of rooms that are tested on, twice that and as high."""
    data: Path = Path("data/papers")
    out: Path = Path("runs/papers")
    as_published: bool = False
    """Networks, their training and filters by the presets and recipes of their papers. Results are in the folder
    ``as-published`` of ``--out``."""
    curve_frames: int = 0
    """Frames of a clip of its own whose errors are drawn frame by frame (Zeng et al. 2021, fig. 8: 310); 0: none."""
    workers: int | None = None
    """Number of rendering processes; default: the number of cores."""

    @property
    def results(self) -> Path:
        """The folder of this run's networks, tables and pictures."""
        return self.out / "as-published" if self.as_published else self.out

    @property
    def measurements(self) -> Path:
        """The folder of the tables for the page of results, which exists."""
        folder = self.results / "measurements"
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def place_of(clips: Clips, settings: Settings) -> Path:
    """The folder of these clips: those to train on are in ``train``, those to test on in ``test``."""
    return settings.data if clips == "families" else settings.data / file_name(clips)


def render_families(settings: Settings) -> list[Path]:
    """Render what is missing: clips to train on, of seeds from 0 on, and to test on, which are returned."""
    own = RenderSettings(settings.size, settings.size, layers=LAYERS, draws=BUDGET, reference_spp=REFERENCE_SPP)
    seeds, place = list(range(settings.clips)), settings.data / "train"
    for scene, randomised in [*((str(room), True) for room in settings.rooms), *((name, False) for name in FAMILIES)]:
        source = ClipSource(scene, seeds, 8, randomised=randomised, denoiser=TRAINED)
        render(source, place, own, workers=settings.workers)
    place, own = settings.data / "test", replace(own, reference_spp=128)
    for family in FAMILIES:
        render(ClipSource(family, [TEST_SEED], 8, denoiser=COMPARED), place, own, workers=settings.workers)
    wide = replace(own, width=2 * settings.size)
    for room, animation in rooms.scenes_in(settings.scenes) if settings.scenes else []:
        source = ClipSource(str(room), [TEST_SEED], 8, animation, denoiser=COMPARED)
        render(source, place, wide, workers=settings.workers)
    return find_clips(place)


def publish(stage: Stage) -> Stage:
    """A stage by its preset, whose values the stage's own options replace, and, of ``ntd``, by the recipe of its paper.

    The recipes of the other stages are those of papers anyway.
    """
    recipe = (stage.recipe or "").replace("paper-loss", "paper") or None
    return stage._replace(options={"preset": stage.preset, **stage.options}, recipe=recipe)


AFTERWARDS = ", then taa"
"""At the end of a row's name: temporal antialiasing follows, as in the comparison of Hasselgren et al. 2020."""


def ready(name: str, settings: Settings) -> Model:
    """A row of a table: a stage, trained if it is not, or what is ready to use."""
    if name.endswith(AFTERWARDS):
        before = ready(name.removesuffix(AFTERWARDS), settings)
        options = {"preset": "paper"} if settings.as_published else {}
        return before._replace(label=name, denoiser=taa(after=before.denoiser, **options))
    if name in STAGES:
        return trained(name, settings)
    presets = method_named(name).presets if is_method(name) else {}
    return find_model(name, preset="paper") if settings.as_published and "paper" in presets else find_model(name)


def trained(name: str, settings: Settings) -> Model:
    """A stage, trained if it is not."""
    return find_model(str(_weights_of(name, settings)))._replace(label=name)


def _weights_of(name: str, settings: Settings) -> Path:
    """The file of a stage's weights, trained if they are not, and before them those that it starts from."""
    stage, recipe = _find_stage(name, settings), recipe_of(name, settings)
    method = method_named(stage.method)
    start = None if stage.start is None else str(_weights_of(stage.start, settings))
    clips = clips_of(stage, find_clips(place_of(stage.clips, settings) / "train"))
    out = settings.results / file_name(name)
    return train(method, recipe, clips, out, options=stage.options, start=start, label=name)


def _find_stage(name: str, settings: Settings) -> Stage:
    return publish(STAGES[name]) if settings.as_published else STAGES[name]


def recipe_of(name: str, settings: Settings) -> Recipe:
    """How a stage is trained."""
    stage = _find_stage(name, settings)
    method = method_named(stage.method)
    recipe = method.recipe_named(stage.recipe)
    recipe = recipe._replace(
        steps=settings.steps,
        frames=settings.frames,
        crop=min(recipe.crop, settings.size),
        spp=(1,) if method.has_option("budget") else (stage.spp,),
        objective=stage.objective or recipe.objective,
    )
    return recipe if settings.as_published else recipe._replace(average=0.99)


def clips_of(stage: Stage, folders: Sequence[Path]) -> list[Path]:
    """Those that a stage is trained on; rendered clips are named after their family and their seed."""
    kept = [folder for folder in folders if stage.only is None or folder.name.startswith(f"{stage.only}-")]
    return [folder for folder in kept if stage.without is None or not folder.name.startswith(f"{stage.without}-")]


def objective_of(name: str) -> str:
    """The name of what a stage is trained by; empty for a method that is not trained here."""
    name = name.removesuffix(AFTERWARDS)
    if name not in STAGES:
        return ""
    stage = STAGES[name]
    return (stage.objective or method_named(stage.method).recipe_named(stage.recipe).objective).name
