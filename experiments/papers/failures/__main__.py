"""The failures that the papers name, made and measured: error in the affected pixels, and response in frames.

    python -m experiments.papers.failures [--quick]

Renders the clips of :mod:`experiments.papers.failures.scenes` into ``data/failures`` (again used if there) with one
sample of all reflected light a pixel, runs every filter, the presets of the papers, the shipped weights, and ``ntd``
with the vectors of shadows and reflections, and writes ``runs/failures/failures.json`` and ``failures-response.json``
in the format of docs/results, every method's last moving frame as ``pictures/CLIP/METHOD.png``, all of a clip on one
sheet as ``sheets/CLIP.png``, and all of all clips on ``sheets/all.png`` and ``failures.webp``. A run that was cut off
goes on where it was: finished frames are kept, and so are rows of the same commit.
"""

import json
from collections.abc import Mapping
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
from experiments.papers.failures.clips import render_failure
from experiments.papers.failures.kept import find_row, keep_row, name_origin
from experiments.papers.failures.scenes import MOVING, SCENES
from experiments.papers.failures.sheet import make_sheet, make_table, save_webp
from experiments.papers.preintegration import file_name
from jaxdn import color
from jaxdn.clips import read_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Clip, Frame, written_out
from jaxdn.denoiser.rollout import denoise
from jaxdn.evaluation.report.images import save_png
from jaxdn.runtime.atomic_files import write_atomically
from jaxdn.zoo.ready import NOISY, Model, filter_names, find_model, ready_names

PAPERS = ("svgf", "asvgf", "trmv", "relax", "reblur", "taa")
"""Filters with a preset of the paper."""
WITH_VECTORS = ("ntd-small", "ntd-large")
"""Shipped weights that are measured with vectors of effects too, for which they were not trained."""
PICTURE = "failures.webp"
"""Of all clips, for the results page."""
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
    more: dict[str, tuple[str, dict[str, Any]]] = {
        f"{name}, vectors of effects": (name, {"motion": "effects"}) for name in WITH_VECTORS
    }
    if "oidn" in plain:
        more["oidn, stabilised"] = ("stabilised:oidn", {})
    return plain | papers | more


def measure_model(model: Model, clip: Clip, affected: np.ndarray) -> tuple[measure.Failure, np.ndarray]:
    """The failure of a model on a clip, and its image [H, W, 3] of the last frame in which something moves."""
    reference = np.asarray(clip.reference)
    late = np.minimum(MOVING + np.arange(len(reference)), len(reference) - 1)
    images = _denoise(model, clip.frames)
    fresh = _denoise(model, jax.tree.map(lambda each: each[late], clip.frames))
    return measure.measure_failure(images, fresh, reference, affected, moving=MOVING), images[MOVING]


def _denoise(model: Model, frames: Frame) -> np.ndarray:
    """The images [T, H, W, 3] of a model."""
    if model.denoiser is None:
        return np.asarray(frames.radiance)
    # Written out, all clips have the same buffers, and a method is compiled once for all.
    given = jax.tree.map(jnp.asarray, Clip(written_out(frames, model.denoiser.reads)))
    return np.asarray(_run(model)(model.params, given))


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
    counts: dict[str, dict[str, int]] = {}
    shown: dict[str, dict[str, np.ndarray]] = {}
    for name in settings.scenes:
        counts[name], shown[name], failures = measure_clip(settings, name, models)
        for label, failure in failures.items():
            found[label][name] = failure
        # After every clip: a run of hours may be cut off.
        _write(settings, shown, describe(settings, found, counts))


def measure_clip(
    settings: Settings, name: str, models: Mapping[str, Model]
) -> tuple[dict[str, int], dict[str, np.ndarray], dict[str, measure.Failure]]:
    """The counts of a clip, its images [H, W, 3] to look at, and label -> failure; what is kept is not measured again.

    Args:
      settings: of the run.
      name: of the clip.
      models: label -> model.
    """
    size = (settings.width, settings.height)
    folder = render_failure(
        settings.data, name, size=size, frames=settings.frames, reference_spp=settings.reference_spp
    )
    origin, clip = name_origin(folder, settings.frames), read_clip(folder)
    reference = np.asarray(clip.reference)
    affected = measure.affected_pixels(reference, clip.frames, moving=MOVING)
    hidden, fallbacks = measure.count_fallbacks(clip.frames)
    counts = {"affected": int(affected.sum()), "hidden": hidden, "dual vector leaves the image": fallbacks}
    print(f"{name}: {counts}", flush=True)
    shown = {"reference": _display(reference[MOVING]), "affected pixels": np.repeat(affected[MOVING, ..., None], 3, 2)}
    failures = {}
    for label, model in models.items():
        path = settings.out / "rows" / name.replace(" ", "-") / f"{file_name(label)}.npz"
        row = find_row(path, origin)
        if row is None:
            row = measure_model(model, clip, affected)
            keep_row(path, origin, *row)
        failures[label], shown[label] = row[0], _display(row[1])
        response = "never" if row[0].response is None else row[0].response
        print(f"  {label}: {row[0].psnr:.2f} dB, response {response}", flush=True)
    return counts, shown, failures


def _display(image: np.ndarray) -> np.ndarray:
    return np.asarray(color.tonemap(jnp.asarray(image)))


def _write(
    settings: Settings, shown: Mapping[str, Mapping[str, np.ndarray]], results: Mapping[str, dict[str, Any]]
) -> None:
    """The pictures of the last clip, those of all, and the results so far."""
    name, of_clip = list(shown.items())[-1]
    clip = name.replace(" ", "-")
    pictures = {settings.out / "pictures" / clip / f"{file_name(label)}.png": image for label, image in of_clip.items()}
    pictures[settings.out / "sheets" / f"{clip}.png"] = make_sheet(of_clip)
    rows = {label: [images[label] for images in shown.values()] for label in of_clip}
    pictures[settings.out / "sheets" / "all.png"] = make_table(rows, list(shown))
    for path, image in pictures.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_png(path, image)
    save_webp(settings.out / PICTURE, pictures[settings.out / "sheets" / "all.png"])
    texts = {settings.out / f"{file}.json": json.dumps(result, indent=1) + "\n" for file, result in results.items()}
    write_atomically({path: text.encode() for path, text in texts.items()})


def describe(
    settings: Settings, found: Mapping[str, Mapping[str, measure.Failure]], counts: Mapping[str, Mapping[str, int]]
) -> dict[str, dict[str, Any]]:
    """Name of a file -> its measurement in the format of docs/results: the error, and the response."""
    clips = f"Clips of what the papers fail at, {settings.width} x {settings.height}, 1 sample of all reflected light; "
    clips += (
        "something moves for eight frames and then rests. Networks without shipped weights (`ntasd`, `dasr`, `rae`, "
    )
    clips += "`arae`) are left out. "
    pixels = ", ".join(f"{name} {count['affected']}" for name, count in counts.items())
    error = "PSNR in dB of the affected pixels while it moves: those that were hidden, or whose light differs by a "
    error += f"quarter from that of their surface a frame ago ({pixels})."
    if border := counts.get("border"):
        error += (
            f" In `border` the dual vectors of {border['dual vector leaves the image']} of {border['hidden']} hidden "
            "pixels would leave the image."
        )
    response = (
        "Frames at rest until less than a tenth of the image before is left, in the pixels that changed last, over "
        "what the same method shows that begins there; 0: the first frame; never: not within "
        f"{settings.frames - MOVING} frames."
    )
    title = "Failures that the papers name"
    errors = [[label, *(one.psnr for one in clips.values())] for label, clips in found.items()]
    responses = [
        [label, *("never" if one.response is None else one.response for one in clips.values())]
        for label, clips in found.items()
    ]
    about = describe_measurement(
        "table", f"{title}: error", "Quality", 63, command=COMMAND, what=clips + error, rows=errors
    )
    names = [{"name": name, "decimals": 1, "best": "higher"} for name in counts]
    caption = "The last frame in which something moves: the reference, the affected pixels, and every method."
    picture = {"file": PICTURE, "alt": "Every clip in a column, every method in a row", "caption": caption}
    about |= {"columns": [{"name": "method"}, *names], "counts": counts, "picture": picture}
    other = describe_measurement(
        "table", f"{title}: response", "Quality", 64, command=COMMAND, what=clips + response, rows=responses
    )
    other |= {"columns": [{"name": "method"}, *({"name": name} for name in counts)]}
    return {"failures": about, "failures-response": other}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
