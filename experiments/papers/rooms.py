"""The table on real rooms that no network was trained on, with a moving camera and an inserted moving object.

    python -m experiments.papers.rooms SCENES ... [--runs runs/full]

SCENES are folders with Benedikt Bitterli's scenes for Mitsuba (``living-room/scene.xml``, ``staircase2``, ``kitchen``
...); their animations are the files in ``experiments/papers/rooms/``. Writes clips to ``data/rooms`` and
``runs/rooms/report.html``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report import text_table, write_report
from jaxdn.render import ClipJob, choose_variant, render_clips
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from jaxdn.zoo.ready import NOISY, Model, all_names, filter_names, find_model

ANIMATIONS = Path(__file__).parent / "rooms"


@dataclass
class Settings:
    """Render the rooms, compare the methods on them, write a report."""

    scenes: Annotated[list[Path], tyro.conf.Positional]
    """Folders of rooms: one folder with a scene.xml each."""
    runs: Path | None = None
    """Folder of the ablation's runs, which are compared in place of the shipped weights."""
    width: int = 128
    height: int = 72
    frames: int = 8
    layers: tuple[int, ...] = (1,)
    """Independent noisy layers, in samples per pixel; the report is on the one with the fewest."""
    reference_spp: int = 128
    workers: int | None = None
    """Number of rendering processes; default: the number of cores."""


def scenes_in(folders: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Scene file and animation file of every room that is there. Raises ValueError if none is."""
    found = []
    for animation in sorted(ANIMATIONS.glob("*.json")):
        scene = Path(animation.stem) / "scene.xml"
        path = next((folder / scene for folder in folders if (folder / scene).is_file()), None)
        if path is None:
            print(f"{scene} does not exist in any of the folders: this room is left out")
        else:
            found.append((path, animation))
    if not found:
        names = ", ".join(path.stem for path in sorted(ANIMATIONS.glob("*.json")))
        places = ", ".join(map(str, folders))
        raise ValueError(f"{places}: expected folders out of {names} with a scene.xml each, found none.")
    return found


def jobs(settings: Settings) -> list[ClipJob]:
    """What to render: every room whose scene is there. Raises ValueError if none is."""
    return [
        ClipJob(
            SceneFile(path, animation).record,
            str(Path("data/rooms") / animation.stem),
            settings.frames,
            RenderSettings(
                width=settings.width,
                height=settings.height,
                layers=settings.layers,
                reference_spp=settings.reference_spp,
            ),
        )
        for path, animation in scenes_in(settings.scenes)
    ]


def contestants(runs: Path | None) -> list[Model]:
    """The noisy image, every filter, and the weights in a folder of runs, or else those that are shipped."""
    if runs is None:
        return [find_model(name) for name in all_names()]
    weights = [str(path) for path in sorted(runs.glob("*/weights.safetensors"))]
    return [find_model(name) for name in (NOISY, *filter_names(), *weights)]


def main(settings: Settings) -> None:
    """Render, compare, report."""
    rooms = jobs(settings)
    choice = choose_variant()
    print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
    try:
        render_clips(rooms, workers=settings.workers)
    except RenderError as error:  # a room with something that is not supported is left out of the table, not hidden
        print(error)
    folders = [Path(job.folder) for job in rooms if len(list(Path(job.folder).glob("*.exr"))) == settings.frames]
    facts = {"rooms": len(rooms), "reference spp": settings.reference_spp, "frames": settings.frames}
    results = compare(contestants(settings.runs), folders, title="Rooms that no network was trained on", settings=facts)
    page = write_report(results, Path("runs/rooms"))
    print(text_table(results))
    print(f"report: {page}")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
