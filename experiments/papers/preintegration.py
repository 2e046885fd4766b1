"""Zhuang et al. 2021: denoisers that divide light by the albedo, by the pre-integrated BRDF, or by nothing.

    python -m experiments.papers.preintegration CLIP ... [--weights A.safetensors B.safetensors]

Every filter of the table of methods that demodulates is run with each choice on clips that have the buffer
``reflectance`` (``experiments.papers.rooms`` renders some), and next to it the given weights, those that are shipped,
and Open Image Denoise frame by frame where it is installed. Writes ``runs/preintegration/report.html``, every method's
image of every clip as ``pictures/CLIP/METHOD.png``, to be looked at at 100 %, and ``demodulation.json`` in the format
of docs/results.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import tyro

from experiments.measurement import describe_measurement
from jaxdn.clips import find_clips
from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report import Results, text_table, write_report
from jaxdn.evaluation.report.images import save_png
from jaxdn.evaluation.report.results import mean_scores
from jaxdn.methods.demodulation import Demodulation
from jaxdn.methods.registry import method_named
from jaxdn.runtime.atomic_files import write_json
from jaxdn.zoo.ready import NOISY, Model, filter_names, find_model
from jaxdn.zoo.weights import shipped_names


@dataclass
class Settings:
    """Compare ways to demodulate on clips that have the buffer `reflectance`."""

    clips: Annotated[list[Path], tyro.conf.Positional]
    """Clips, or folders of clips."""
    weights: list[str] = field(default_factory=list)
    """Files of weights to compare in addition to those that are shipped."""
    out: Path = Path("runs/preintegration")
    """Folder for the report and the pictures."""


def contestants(weights: list[str]) -> Iterator[Model]:
    """The noisy image, every filter in every way, weights as they were trained, and Open Image Denoise."""
    yield find_model(NOISY)
    for name in filter_names():
        if method_named(name).has_option("demodulate"):
            for by in get_args(Demodulation):
                yield find_model(name, demodulate=by)._replace(label=f"{name}, {by}")
    for name in (*shipped_names(), *weights):
        yield find_model(name)
    if "oidn" in filter_names():
        yield find_model("oidn")


def file_name(label: str) -> str:
    """A label as part of a path."""
    return label.replace(", ", "-").replace(" ", "-")


def save_pictures(results: Results, folder: Path) -> None:
    """Each method's image of the frame that the report shows, and the reference's."""
    for clip in results.clips:
        place = folder / clip.name
        place.mkdir(parents=True, exist_ok=True)
        for label, image in clip.images.items():
            save_png(place / f"{file_name(label)}.png", np.asarray(image))


def main(settings: Settings) -> None:
    """Compare, report, save the pictures."""
    folders = [folder for place in settings.clips for folder in find_clips(place)]
    title = "Divided by the albedo, by the pre-integrated BRDF, by nothing"
    results = compare(list(contestants(settings.weights)), folders, title=title, settings={"clips": len(folders)})
    page = write_report(results, settings.out)
    save_pictures(results, settings.out / "pictures")
    write_json(settings.out / "demodulation.json", record(results, settings))
    print(text_table(results))
    print(f"report: {page}")


def record(found: Results, settings: Settings) -> dict[str, Any]:
    """A row a filter, a column a way to demodulate, as a measurement for the page of results."""
    means, ways = mean_scores(found), get_args(Demodulation)
    places = [place.name if place.is_absolute() else str(place) for place in settings.clips]
    rows = []
    for name in filter_names():
        if f"{name}, {ways[0]}" in means:
            scores = [means[f"{name}, {by}"] for by in ways]
            texts = [f"{one.unbiased_psnr:.2f} / {one.unbiased_temporal_psnr:.2f} / {one.flip:.3f}" for one in scores]
            rows.append([f"`{name}`", *texts])
    about = describe_measurement(
        "table",
        "Demodulation factors",
        "Demodulation",
        100,
        command=" ".join(["python -m experiments.papers.preintegration", *places]),
        what=f"{len(found.clips)} clips, 1 sample. PSNR / temporal PSNR / FLIP by the factor that light is divided by.",
        rows=rows,
    )
    return about | {"columns": [{"name": "method"}, *({"name": f"`{by}`"} for by in ways)]}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
