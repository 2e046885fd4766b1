"""The failures that the papers name, made and measured: error in the affected pixels, and response in frames.

    python -m experiments.papers.failures [--quick]

Renders the clips of :mod:`experiments.papers.failures.scenes` into ``data/failures`` (again used if there) with one
sample of all reflected light a pixel, runs every filter, the presets of the papers, the shipped weights, and ``ntd``
with the vectors of shadows and reflections, and writes ``runs/failures/failures.json`` in the format of docs/results
and every method's last moving frame as ``pictures/CLIP/METHOD.png``.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.measurement import describe_measurement
from experiments.papers.failures import measure
from experiments.papers.failures.scenes import MOVING, SCENES
from experiments.papers.preintegration import file_name
from jaxdn import color
from jaxdn.clips import read_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import GUIDES, Clip, written_out
from jaxdn.denoiser.rollout import denoise
from jaxdn.denoisers import svgf
from jaxdn.evaluation.report.images import save_png
from jaxdn.render.clip import render_clip
from jaxdn.render.settings import RenderSettings
from jaxdn.runtime.atomic_files import write_atomically
from jaxdn.sequence.render_jobs import plan_clip
from jaxdn.zoo.ready import NOISY, Model, filter_names, find_model, ready_names

PAPERS = ("svgf", "asvgf", "trmv", "relax", "reblur")
"""Filters with a preset of the paper."""
EFFECTS = "ntd-small, vectors of effects"
COMMAND = "python -m experiments.papers.failures"


@dataclass
class Settings:
    """Measure the failures that the papers name."""

    quick: bool = False
    """48 x 28 pixels, 12 frames, references of 16 samples; the noisy image, svgf and trmv."""
    width: int = 96
    """Of the clips, in pixels."""
    height: int = 56
    frames: int = 16
    """Eight in which something moves, and the others."""
    reference_spp: int = 128
    scenes: list[str] = field(default_factory=lambda: list(SCENES))
    methods: list[str] | None = None
    """Rows; default: all there are."""
    data: Path = Path("data/failures")
    """Folder for the clips."""
    out: Path = Path("runs/failures")
    """Folder for the results."""


def all_rows() -> dict[str, tuple[str, dict[str, Any]]]:
    """Label -> name of a method and options."""
    plain: dict[str, tuple[str, dict[str, Any]]] = {
        name: (name, {}) for name in [NOISY, *filter_names(), *ready_names()]
    }
    papers = {f"{name}, as published": (name, {"preset": "paper"}) for name in PAPERS}
    return plain | papers | {EFFECTS: ("ntd-small", {"motion": "effects"})}


def render(settings: Settings, name: str) -> Clip:
    """The clip of a scene, with every buffer that any method reads."""
    make, more = SCENES[name]
    scene, folder = make(), settings.data / f"{name.replace(' ', '-')}-{settings.width}x{settings.height}"
    size: dict[str, Any] = {"width": settings.width, "height": settings.height}
    how: dict[str, Any] = size | {"light": "reflected", "reference_spp": settings.reference_spp} | more
    reader = svgf()._replace(reads=frozenset(GUIDES))
    planned = plan_clip(scene, RenderSettings(**how, max_depth=4), frames=settings.frames, denoiser=reader)
    assert planned is not None
    render_clip(scene, folder, RenderSettings(**how, max_depth=4, plan=planned.plan), frames=settings.frames)
    return read_clip(folder)


def images_of(models: Mapping[str, Model], clip: Clip) -> Iterator[tuple[str, np.ndarray]]:
    """Label and images [T, H, W, 3] of every model."""
    for label, model in models.items():
        if model.denoiser is None:
            yield label, np.asarray(clip.frames.radiance)
            continue
        # Written out, all clips have the same buffers, and a method is compiled once for all.
        frames = written_out(clip.frames, model.denoiser.reads)
        given = jax.tree.map(jnp.asarray, Clip(frames))
        yield label, np.asarray(_run(model)(model.params, given))


_COMPILED: dict[str, Any] = {}


def _run(model: Model) -> Any:
    key = f"{model.label} {model.options}"
    if key not in _COMPILED:
        assert model.denoiser is not None
        _COMPILED[key] = jax.jit(partial(denoise, model.denoiser))
    return _COMPILED[key]


def main(settings: Settings) -> None:
    """Render, denoise, measure, write."""
    rows = all_rows()
    wanted = list(rows) if settings.methods is None else settings.methods
    if settings.quick:
        settings.width, settings.height, settings.frames, settings.reference_spp = 48, 28, 12, 16
        wanted = settings.methods or [NOISY, "svgf", "trmv"]
    for names, known, option in ((settings.scenes, SCENES, "--scenes"), (wanted, rows, "--methods")):
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"{option}: expected some of {', '.join(known)}, got {', '.join(unknown)}.")
    if settings.frames <= MOVING:
        raise ValueError(f"--frames: expected more than the {MOVING} in which something moves, got {settings.frames}.")
    models = {label: find_model(rows[label][0], **rows[label][1]) for label in wanted}
    found: dict[str, dict[str, measure.Failure]] = {label: {} for label in wanted}
    counts = {}
    for name in settings.scenes:
        clip = render(settings, name)
        reference = np.asarray(clip.reference)
        affected = measure.affected_pixels(reference, clip.frames, moving=MOVING)
        hidden, fallbacks = measure.count_fallbacks(clip.frames)
        counts[name] = {"affected": int(affected.sum()), "hidden": hidden, "dual vector leaves the image": fallbacks}
        print(f"{name}: {counts[name]}", flush=True)
        pictures = settings.out / "pictures" / name.replace(" ", "-")
        _save(pictures / "reference.png", reference[MOVING])
        for label, images in images_of(models, clip):
            found[label][name] = one = measure.measure_failure(images, reference, affected, moving=MOVING)
            print(f"  {label}: {one.psnr:.2f} dB, response {_frames(one.response)}", flush=True)
            _save(pictures / f"{file_name(label)}.png", images[MOVING])
        # After every clip: a run of hours may be cut off.
        text = json.dumps(_describe(settings, found, counts), indent=1) + "\n"
        write_atomically({settings.out / "failures.json": text.encode()})


def _frames(response: int | None) -> str:
    return "-" if response is None else str(response)


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(path, np.asarray(color.tonemap(jnp.asarray(image))))


def _describe(
    settings: Settings, found: Mapping[str, Mapping[str, measure.Failure]], counts: Mapping[str, Mapping[str, int]]
) -> dict[str, Any]:
    """The measurement in the format of docs/results."""
    rows = [
        [label, *(f"{one.psnr:.1f} / {_frames(one.response)}" for one in clips.values())]
        for label, clips in found.items()
    ]
    pixels = ", ".join(f"{name} {count['affected']}" for name, count in counts.items())
    border = counts.get("border", {})
    what = (
        f"Clips of what the papers fail at, {settings.width} x {settings.height}, 1 sample of all reflected light; "
        "something moves for eight frames and then rests. PSNR in dB of the affected pixels while it moves, and the "
        "frames at rest until less than a tenth of the old image is left (0: the first one; -: never). Affected are "
        "pixels that were hidden or whose light differs by a quarter from that of their surface a frame ago: "
        f"{pixels}."
    )
    if border:
        what += (
            f" In `border` the dual vectors of {border['dual vector leaves the image']} of {border['hidden']} hidden "
            "pixels would leave the image."
        )
    about = describe_measurement(
        "table", "Failures that the papers name", "Quality", 63, command=COMMAND, what=what, rows=rows
    )
    return about | {"columns": [{"name": "method"}, *({"name": name} for name in counts)], "counts": counts}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
