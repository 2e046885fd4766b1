"""`make compare`: the filters side by side, next to shipped weights and Open Image Denoise, in error and in time.

    python -m experiments.papers.classical [SCENES ...]

Renders one test clip of each family, of a seed that nothing was trained on, and the rooms that are found in the folders
SCENES (as :mod:`experiments.papers.rooms`), with everything that a filter reads: indirect light, and all light that
surfaces reflect, whose shadows are noisy too. Writes ``runs/compare/LIGHT/report.html``, every method's image of every
clip as ``pictures/CLIP/METHOD.png``, and ``table.md``: errors without the noise of the references, and the time of a
720p frame, in processes of their own that take turns. ``quality-filters.json`` and ``speed-filters.json`` are these in
the format of docs/results. Rendered clips are used again.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.cycles.reference import decibels
from experiments.measurement import describe_measurement, round_finite
from experiments.papers import results, rooms
from experiments.papers.preintegration import save_pictures
from experiments.speed.timing import Call
from experiments.speed.workers import Team
from experiments.speed.works import steps
from jaxdn.clips import read_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import frame_at
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report import Results, write_report
from jaxdn.evaluation.report.results import Scores, mean_scores
from jaxdn.planning.catalogue import NoisyLight
from jaxdn.render import ClipJob, RenderSettings, render_clips
from jaxdn.runtime.atomic_files import write_json
from jaxdn.sequence.render_jobs import ClipSource, plan_jobs
from jaxdn.zoo.ready import NOISY, filter_names, find_model
from jaxdn.zoo.weights import shipped_names

FAMILIES = ("fruit", "robot", "mobile", "pinkroom", "parlour")
SEED = 2000
LIGHTS: tuple[NoisyLight, ...] = ("indirect", "reflected")
AGAINST = "svgf"
"""The filter that the times of all others are compared with."""
_WARM = 6
"""Frames before those that are timed."""


@dataclass
class Settings:
    """Compare all filters on test clips and rooms."""

    scenes: Annotated[list[Path], tyro.conf.Positional] = field(default_factory=list)
    """Folders of rooms: one folder with a scene.xml each."""
    families: tuple[str, ...] = FAMILIES
    """Families of test clips."""
    size: int = 128
    """Width and height of the families' clips in pixels."""
    frames: int = 10
    reference_spp: int = 128
    timed: tuple[int, int] = (720, 1280)
    """Height and width of the frame that is timed."""
    rounds: int = 5
    """Turns of each method; 0: nothing is timed."""
    data: Path = Path("data/compare")
    """Folder for the clips."""
    out: Path = Path("runs/compare")
    """Folder for the reports."""
    workers: int | None = None
    """Number of rendering processes; default: the number of cores."""


def clips(settings: Settings, light: NoisyLight) -> list[ClipJob]:
    """The clips with this noisy light."""
    place = settings.data / light
    square = RenderSettings(settings.size, settings.size, reference_spp=settings.reference_spp, light=light)
    wide = replace(square, width=320, height=180)
    jobs: list[ClipJob] = []
    for family in settings.families:
        jobs += plan_jobs(ClipSource(family, [SEED], settings.frames, denoiser=_all_methods()), place, square)
    for scene, animation in rooms.scenes_in(settings.scenes) if settings.scenes else []:
        jobs += plan_jobs(ClipSource(str(scene), [SEED], 8, animation, denoiser=_all_methods()), place, wide)
    return jobs


def timed_clip(settings: Settings) -> ClipJob:
    """A clip of the size that is timed, with all light that surfaces reflect and its shadows: the most work."""
    height, width = settings.timed
    source = ClipSource(settings.families[-1], [SEED], 2, effects="all", denoiser=_all_methods())
    return plan_jobs(source, settings.data / "timed", RenderSettings(width, height, light="reflected"))[0]


def _all_methods() -> str:
    return ",".join([*filter_names(), *shipped_names()])


def step(folder: Path, name: str) -> Call:
    """The call that is timed, made in its own process: another step on the second frame of a clip.

    It has run before, so that histories are as long as in the middle of a clip: short ones take longer.
    """
    frame = jax.tree.map(jnp.asarray, frame_at(read_clip(folder).frames, 1))
    method = find_model(name)
    backend = method.backend()
    if backend is not None:
        method = find_model(name, implementation=backend)
    assert method.denoiser is not None
    call = steps.recurrent(method.denoiser, method.params, frame)
    for _ in range(_WARM):
        call()
    return call


def milliseconds(
    folder: Path, names: list[str], *, rounds: int, say: Callable[[str], None] = print
) -> dict[str, float]:
    """Median milliseconds of a frame of each method; those that fail are said and left out."""
    with Team("time of a frame", say) as team:
        team.start({name: partial(step, folder, name) for name in names})
        turns = team.turns(rounds=rounds, budget_s=600.0)
    return {name: float(np.median(samples)) for name, samples in turns.items()}


def main(settings: Settings) -> None:
    """Render, compare, time, report."""
    methods = list(map(find_model, [NOISY, *filter_names(), *shipped_names()]))
    jobs = {light: clips(settings, light) for light in LIGHTS}
    timed = [timed_clip(settings)] if settings.rounds else []
    render_clips([*(job for own in jobs.values() for job in own), *timed], workers=settings.workers)
    names = [*filter_names(), *shipped_names()]
    times = milliseconds(Path(timed[0].folder), names, rounds=settings.rounds) if timed else {}
    own_ms = times.get(AGAINST, float("nan"))
    shown = {name: f"{ms:.0f} ({ms / own_ms:.2f})" for name, ms in times.items()}
    height, width = settings.timed
    head = f"Milliseconds of a frame of {width} x {height} pixels, and in brackets against {AGAINST}."
    lines = [head] if times else []
    errors: dict[str, Results] = {}
    for light, own in jobs.items():
        folders = [Path(job.folder) for job in own]
        facts = {"clips": len(folders), "reference spp": settings.reference_spp}
        title = f"Filters, 1 sample per pixel, {light} light"
        found = errors[light] = compare(methods, folders, title=title, settings=facts)
        page = write_report(found, settings.out / light)
        save_pictures(found, settings.out / light / "pictures")
        lines += ["", title, "", results.table(found, {"milliseconds": shown})]
        print(f"report: {page}", flush=True)
    table = settings.out / "table.md"
    table.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    write_json(settings.out / "quality-filters.json", record_errors(errors, settings))
    if AGAINST in times:
        write_json(settings.out / "speed-filters.json", record_times(times, settings))


def record_errors(errors: Mapping[str, Results], settings: Settings) -> dict[str, Any]:
    """The errors of each light's clips, side by side, as a measurement for the page of results."""
    means = {light: mean_scores(found) for light, found in errors.items()}
    rows: list[list[Any]] = []
    columns: list[dict[str, Any]] = [{"name": "method"}]
    for light in means:
        columns += [
            {"name": f"{light}: PSNR", "decimals": 2, "best": "higher"},
            {"name": "temporal", "decimals": 2, "best": "higher"},
            {"name": "disoccluded", "decimals": 2, "best": "higher"},
            {"name": "FLIP", "decimals": 3, "best": "lower"},
        ]
    for label in next(iter(means.values())):
        scores = [found[label] for found in means.values()]
        rows.append([f"`{label}`", *(value for one in scores for value in _errors_of(one))])
    what = (
        f"{_describe_clips(settings, next(iter(errors.values())))}, with every buffer that any filter reads, 1 sample. "
        f"Errors but FLIP are without the references' noise ({settings.reference_spp} samples). `combiner` is made for "
        "all light of filtered pixels; here rays go through pixel centres."
    )
    about = describe_measurement(
        "table", "All filters side by side", "Quality", 60, command=_command(settings), what=what, rows=rows
    )
    return about | {"columns": columns}


def _errors_of(scores: Scores) -> list[float | None]:
    hidden = decibels(scores.unbiased_disoccluded_mse)
    return [
        round_finite(scores.unbiased_psnr, 2),
        round_finite(scores.unbiased_temporal_psnr, 2),
        round_finite(hidden, 2),
        round_finite(scores.flip, 3),
    ]


def _describe_clips(settings: Settings, found: Results) -> str:
    families, size = len(settings.families), f"{settings.size} x {settings.size}"
    more = len(found.clips) - families
    own = f"{families} test clips of the families ({size}, {settings.frames} frames)"
    return f"{own} and {more} of rooms (320 x 180, 8 frames)" if more else own


def _command(settings: Settings) -> str:
    """What measures it again, in a folder of its own."""
    words, usual = [place.name for place in settings.scenes], Settings()
    for name in ("size", "frames", "reference_spp"):
        if getattr(settings, name) != getattr(usual, name):
            words += [f"--{name.replace('_', '-')}", str(getattr(settings, name))]
    if settings.families != usual.families:
        words += ["--families", *settings.families]
    return f'make compare SETTINGS="{" ".join(words)}"' if words else "make compare"


def record_times(times: Mapping[str, float], settings: Settings) -> dict[str, Any]:
    """The times relative to :data:`AGAINST` as a measurement for the page of results."""
    height, width = settings.timed
    what = (
        f"Time of a {width} x {height} frame relative to `{AGAINST}`, all buffers of `trmv`, histories as in the "
        "middle of a clip, each method in a process of its own, interleaved."
    )
    rows = [[f"`{name}`", round(ms / times[AGAINST], 2)] for name, ms in times.items() if math.isfinite(ms)]
    about = describe_measurement(
        "table", "Time of the filters", "Speed", 330, command=_command(settings), what=what, rows=rows
    )
    return about | {"columns": [{"name": "method"}, {"name": f"time relative to `{AGAINST}`", "decimals": 2}]}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
