"""The table on real rooms that no network was trained on, with a moving camera and an inserted moving object.

    python -m experiments.papers.rooms SCENES [--runs runs/full]

SCENES is a folder with Benedikt Bitterli's scenes for Mitsuba (``living-room/scene.xml``, ``staircase2``,
``cornell_box_picture``); their animations are the files in ``experiments/papers/rooms/``. Writes ``runs/rooms/report.html``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxdn.commands.compare import Method, compare, method_named
from jaxdn.commands.errors import told_plainly
from jaxdn.render import ClipJob, choose_variant, render_clips
from jaxdn.render.clip import RenderError
from jaxdn.render.scene_file import SceneFile
from jaxdn.report import text_table, write_report
from jaxdn.weights import load_weights

ANIMATIONS = Path(__file__).parent / "rooms"


@dataclass
class Settings:
    """Render the rooms, compare the methods on them, write a report."""

    scenes: Annotated[Path, tyro.conf.Positional]
    """Folder of the rooms: one folder with a scene.xml each."""
    runs: Path | None = None
    """Folder of the ablation's runs: its A, B and C are compared as well as the shipped weights."""
    width: int = 128
    height: int = 72
    frames: int = 8
    reference_spp: int = 128


def main(settings: Settings) -> None:
    """Render, compare, report."""
    jobs = []
    for animation in sorted(ANIMATIONS.glob("*.json")):
        path = settings.scenes / animation.stem / "scene.xml"
        if not path.is_file():
            print(f"{path} is not there: this room is left out")
            continue
        scene = SceneFile(path, animation)
        jobs.append(
            ClipJob(
                scene.record,
                str(Path("data/rooms") / animation.stem),
                width=settings.width,
                height=settings.height,
                frames=settings.frames,
                reference_spp=settings.reference_spp,
            )
        )
    if not jobs:
        names = ", ".join(path.stem for path in sorted(ANIMATIONS.glob("*.json")))
        raise ValueError(f"{settings.scenes}: expected folders out of {names} with a scene.xml each, found none.")
    choice = choose_variant()
    print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
    try:
        render_clips(jobs)
    except RenderError as error:  # a room with something that is not supported is left out of the table, not hidden
        print(error)
    folders = [Path(job.folder) for job in jobs if len(list(Path(job.folder).glob("*.exr"))) == settings.frames]
    methods = [method_named("noisy"), method_named("svgf")]
    if settings.runs is not None:
        for path in sorted(settings.runs.glob("*/weights.safetensors"), key=lambda path: ("large" in str(path), path)):
            methods.append(Method(path.parent.name, *load_weights(path)))
    else:
        methods += [method_named("ntd-small"), method_named("ntd-large")]
    told = {"rooms": len(jobs), "reference spp": settings.reference_spp, "frames": settings.frames}
    results = compare(methods, folders, title="Rooms that no network was trained on", settings=told)
    page = write_report(results, Path("runs/rooms"))
    print(text_table(results))
    print(f"report: {page}")


if __name__ == "__main__":
    with told_plainly():
        main(tyro.cli(Settings, description=Settings.__doc__))
