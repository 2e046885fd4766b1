"""What each choice in training brings: one network per row, each row changes one thing more.

    python -m experiments.papers.learning data/train --validation data/validation --tests data/scenes --steps 400

Every row trains SMALL from new weights for as many updates, and is scored on the validation clips and on the tests,
scenes of another kind. The table has the seconds too. Rows that exist are not
trained again, and one that was interrupted goes on, its seconds then those of the last part. Writes
``runs/learning/ROW`` and a report for each folder of clips. Run nothing else meanwhile.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

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
    out: Path = Path("runs/learning")
    """Folder for the runs and the report."""


class Row(NamedTuple):
    """One more change to what the row before is trained with."""

    name: str
    options: Mapping[str, Any] = {}
    recipe: Mapping[str, Any] = {}


ROWS = (
    Row(
        "as in version 0.1",
        {"kernels": "plain", "background": "filter", "exposure": "given", "initialization": "xavier"},
        {"objective": indirect_illumination(), "variation": STILL, "average": 0.0},
    ),
    Row("guided kernels", {"kernels": "guided"}),
    Row("background passes", {"background": "pass"}),
    Row("initial weights by He", {"initialization": "he"}),
    Row("mean of weights", recipe={"average": 0.99}),
    Row("exposure measured", {"exposure": "measured"}),
    Row("varied clips", recipe={"variation": Variation()}),
    Row("1 to 4 samples", recipe={"spp": (1, 1, 2, 4)}),
    Row("hidden pixels by visibility", recipe={"objective": unbiased_illumination(squared_from=1.0)}),
    Row("squares in the second half", recipe={"objective": unbiased_illumination(squared_from=0.5)}),
)


def train_row(settings: Settings, row: Row, options: Mapping[str, Any], recipe: Recipe) -> Path:
    """The row's weights, trained if they do not exist."""
    out = settings.out / row.name.replace(" ", "-")
    weights = out / "weights.safetensors"
    if weights.is_file():
        return weights
    began = time.monotonic()
    train(
        method_named("ntd"),
        recipe,
        [settings.clips],
        out,
        options=options,
        validation=[settings.validation],
        label=row.name,
    )
    write_json(out / "seconds.json", time.monotonic() - began)
    return weights


def main(settings: Settings) -> None:
    """Train, compare, report."""
    options: dict[str, Any] = {"size": "small"}
    recipe = method_named("ntd").recipe_named(None)
    recipe = recipe._replace(crop=settings.crop, batch=settings.batch, steps=settings.steps)
    contestants = []
    for row in ROWS:
        options, recipe = {**options, **row.options}, recipe._replace(**row.recipe)
        weights = train_row(settings, row, options, recipe)
        contestants.append(candidate(str(weights))._replace(label=row.name))
    for place in (settings.validation, settings.tests):
        facts = {"updates": settings.steps, "crop": settings.crop, "batch": settings.batch}
        results = compare(contestants, find_clips(place), title=f"Choices in training, on {place.name}", settings=facts)
        write_report(results, settings.out / place.name)
        print(table(results, settings.out))


def table(results: Results, runs: Path) -> str:
    """One line per row: seconds of training, PSNR and its gain over the row before, temporal PSNR, FLIP."""
    means = mean_scores(results)
    field, before, lines = headline_psnr([clip.scores for clip in results.clips]), float("nan"), [results.title]
    for label in results.methods:
        seconds = json.loads((runs / label.replace(" ", "-") / "seconds.json").read_text())
        one = means[label]
        psnr = getattr(one, field)
        lines.append(
            f"{label:30} {seconds:6.0f} s  {psnr:6.2f} dB {psnr - before:+6.2f}  temporal "
            f"{one.unbiased_temporal_psnr:6.2f}  FLIP {one.flip:.3f}"
        )
        before = psnr
    return "\n".join(lines).replace("+nan", "    ")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
