"""A clip's record, ``cycles.json``: what it is, how it was rendered, how noisy its references are."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cycles.reference import Reference, decibels, noise
from experiments.cycles.sets import Clip

RECORD = "cycles.json"


def write_record(
    path: Path,
    of: Clip,
    level: int,
    found: dict[int, Reference],
    spent: dict[str, list[float]],
    settings: dict[str, Any],
) -> None:
    """Write the record of a clip that has reached a level; it appears whole or not at all.

    ``reference_noise_db`` is the PSNR of the mean error of the references' own noise in x / (1 + x), peak 1; seconds
    are processor time a frame, of what this and earlier runs rendered.
    """
    before = read_record(path) or {"seconds": {}}
    errors = {frame: noise(reference) for frame, reference in found.items()}
    seconds = {name: round(float(np.mean(times)), 2) for name, times in spent.items()}
    record = {
        "set": of.set,
        "kind": of.kind,
        "seed": of.seed,
        "level": level,
        "frames": of.frames,
        "resolution": list(of.size),
        "window": of.window._asdict(),
        "pixel_filter": list(of.pixel_filter),
        **settings,
        "reference_noise_db": round(decibels(float(np.mean(list(errors.values())))), 2),
        "references": {
            str(frame): {"samples": 2 * found[frame].samples, "noise_db": round(decibels(error), 2)}
            for frame, error in errors.items()
        },
        "seconds": before["seconds"] | seconds,
    }
    part = path.with_name(f".{path.name}.part")
    part.write_text(json.dumps(record, indent=1) + "\n")
    part.replace(path)


def read_record(path: Path) -> dict[str, Any] | None:
    """The record of a clip, or nothing where it has none yet."""
    return json.loads(path.read_text()) if path.exists() else None


def done(path: Path, level: int) -> bool:
    """Whether a clip has reached a level."""
    record = read_record(path)
    return record is not None and record["level"] >= level
