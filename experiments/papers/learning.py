"""What each choice in training brings: one network per row, each row changes one thing.

    python -m experiments.papers.learning data/train --validation data/validation --tests data/scenes --steps 400

Every row trains SMALL for as many updates, and is scored on the validation clips and on the tests, scenes of another
kind. First each row changes the one before; the later ones each change one thing of an earlier row. The table has
the seconds too. Rows that exist are not trained again, and one that was interrupted goes on, its seconds then those of
the last part. Writes ``runs/learning/ROW`` and a report for each folder of clips. Run nothing else meanwhile.
"""

import itertools
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from experiments.papers.other_clips import every_other, half_reference, three_of_four, without_draws
from jaxdn.candidates import candidate
from jaxdn.clips import find_clips
from jaxdn.commands.compare import compare
from jaxdn.commands.errors import plain_errors
from jaxdn.commands.train import train
from jaxdn.files import write_json
from jaxdn.methods.table import method_named
from jaxdn.objectives import indirect_illumination, unbiased_illumination
from jaxdn.recipe import Recipe
from jaxdn.report import Results, write_report
from jaxdn.report.results import headline_psnr, mean_scores
from jaxdn.variation import STILL, Variation


@dataclass
class Settings:
    """Train one network per choice and compare them."""

    clips: Annotated[Path, tyro.conf.Positional]
    """Folder of clips to train on, with single samples (`jaxdn render --draws`)."""
    validation: Path
    """Folder of clips of the same kind, held out."""
    tests: Path
    """Folder of clips of scenes of another kind."""
    steps: int = 400
    """Parameter updates of each row."""
    crop: int = 64
    batch: int = 4
    frames: int = 10
    rows: list[str] = field(default_factory=list)
    """Names of the rows to train; default: all."""
    out: Path = Path("runs/learning")
    """Folder for the runs and the report."""


class Row(NamedTuple):
    """One change to what another row is trained with."""

    name: str
    options: Mapping[str, Any] = {}
    recipe: Mapping[str, Any] = {}
    on: str = ""
    """The row that it changes."""
    longer: float = 1.0
    """Times as many updates: where an update takes less time."""
    batch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of the number of elements, of their width and of their frames."""
    start: str | None = None
    """Weights to continue from."""
    clips: Callable[[Path, Path], None] | None = None
    """Writes a folder with the clips in another form."""


LADDER = (
    Row(
        "as in version 0.1",
        {"kernels": "plain", "background": "filter", "exposure": "given", "initialization": "xavier"},
        {"objective": indirect_illumination(), "variation": STILL, "average": 0.0},
    ),
    Row("guided kernels", {"kernels": "guided"}),
    Row("background passes", {"background": "pass"}),
    Row("initial weights by He", {"initialization": "he"}),
    Row("mean of weights", recipe={"average": 0.98}),
    Row("exposure measured", {"exposure": "measured"}),
    Row("varied clips", recipe={"variation": Variation()}),
    Row("1 to 16 samples", recipe={"spp": (1, 1, 1, 2, 4, 16)}),
    Row("hidden pixels by visibility", recipe={"objective": unbiased_illumination(squared_from=1.0)}),
    Row("squares in the second half", recipe={"objective": unbiased_illumination(squared_from=0.5)}),
)
"""Each row changes the row before."""

_LAST = LADDER[-1].name
BRANCHES = (
    Row("as in version 0.1, for the time of guided kernels", on=LADDER[0].name, longer=1.4),
    Row("one noisy image a frame", on="varied clips", clips=without_draws),
    Row("squares from the start", recipe={"objective": unbiased_illumination(squared_from=0.0)}, on=_LAST),
    Row(
        "hidden pixels not weighted",
        recipe={"objective": unbiased_illumination(hidden=0.0, squared_from=0.5)},
        on=_LAST,
    ),
    Row("half the clips", on=_LAST, clips=every_other),
    Row("three quarters of the clips", on=_LAST, clips=three_of_four),
    Row("half the samples in references", recipe={"spp": (1, 1, 1, 2, 4)}, on=_LAST, clips=half_reference),
    Row("windows of half as many frames", on=_LAST, batch=(2.0, 1.0, 0.5)),
    Row("smaller crops", on=_LAST, batch=(2.0, 2 / 3, 1.0)),
    Row("half batches, twice the updates", on=_LAST, longer=2.0, batch=(0.5, 1.0, 1.0)),
    Row("materials seen", {"guides": "materials"}, on=_LAST),
    Row("from shipped weights", on=_LAST, start="ntd-small"),
)
"""Each changes one thing of the row that it names."""


def rows() -> dict[str, tuple[Row, dict[str, Any], Recipe]]:
    """Name -> row, options of the method and recipe, the sum of all changes."""
    found: dict[str, tuple[Row, dict[str, Any], Recipe]] = {}
    options: dict[str, Any] = {"size": "small"}
    recipe = method_named("ntd").recipe_named(None)
    for row in (*LADDER, *BRANCHES):
        if row.on:
            _, options, recipe = found[row.on]
        options, recipe = {**options, **row.options}, recipe._replace(**row.recipe)
        found[row.name] = row, options, recipe
    return found


def train_row(settings: Settings, row: Row, options: Mapping[str, Any], recipe: Recipe) -> Path:
    """The row's weights, trained if they do not exist."""
    out = settings.out / folder_name(row.name)
    weights = out / "weights.safetensors"
    if weights.is_file():
        return weights
    clips = settings.clips
    if row.clips is not None:
        clips = out / "clips"
        row.clips(settings.clips, clips)
    elements, width, frames = row.batch
    recipe = recipe._replace(
        steps=round(settings.steps * row.longer),
        batch=max(1, round(settings.batch * elements)),
        crop=round(settings.crop * width),
        frames=round(settings.frames * frames),
    )
    began, held_out = time.monotonic(), [settings.validation]
    method = method_named("ntd")
    train(method, recipe, [clips], out, options=options, validation=held_out, label=row.name, start=row.start)
    write_json(out / "seconds.json", time.monotonic() - began)
    return weights


def folder_name(label: str) -> str:
    """The folder of a row's run."""
    return label.replace(" ", "-").replace(",", "")


def main(settings: Settings) -> None:
    """Train, compare, report. Raises ValueError for an unknown row."""
    contestants, every = [], rows()
    if unknown := [name for name in settings.rows if name not in every]:
        raise ValueError(f"--rows: expected some of {', '.join(every)}; got {', '.join(unknown)}.")
    for row, options, recipe in [every[name] for name in settings.rows or every]:
        weights = train_row(settings, row, options, recipe)
        contestants.append(candidate(str(weights))._replace(label=row.name))
    for place in (settings.validation, settings.tests):
        facts = {"updates": settings.steps, "crop": settings.crop, "batch": settings.batch, "frames": settings.frames}
        results = compare(contestants, find_clips(place), title=f"Choices in training, on {place.name}", settings=facts)
        write_report(results, settings.out / place.name)
        print(table(results, settings.out))


def table(results: Results, runs: Path) -> str:
    """One line per row: seconds of training, PSNR and its gain over the row that it changes, temporal PSNR, FLIP."""
    means = mean_scores(results)
    before = {new.name: old.name for old, new in itertools.pairwise(LADDER)} | {row.name: row.on for row in BRANCHES}
    score, lines = headline_psnr([clip.scores for clip in results.clips]), [results.title]
    for label in results.methods:
        seconds = json.loads((runs / folder_name(label) / "seconds.json").read_text())
        one = means[label]
        psnr = getattr(one, score)
        gain = f"{psnr - getattr(means[before[label]], score):+6.2f}" if before.get(label) in means else ""
        lines.append(
            f"{label:50} {seconds:6.0f} s  {psnr:6.2f} dB {gain:6}  temporal "
            f"{one.unbiased_temporal_psnr:6.2f}  FLIP {one.flip:.3f}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
