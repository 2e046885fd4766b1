"""The clips of a folder as they would be had they been rendered in another way, to measure what that way is worth."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.clips import find_clips
from jaxdn.data.errors import read_json
from jaxdn.data.exr.exr import read_exr, write_exr
from jaxdn.runtime.atomic_files import write_json

Channels = dict[str, np.ndarray]


def without_draws(clips: Path, out: Path) -> None:
    """One noisy image a frame for ever, instead of single samples that are drawn anew."""

    def first_only(channels: Channels) -> Channels:
        return {name: image for name, image in channels.items() if not re.match(r"draw_\d", name)}

    _rewritten(clips, out, first_only, lambda record: {n: value for n, value in record.items() if n != "draws"})


def half_reference(clips: Path, out: Path) -> None:
    """References of half as many samples: those of the half that a clip keeps."""

    def halved(channels: Channels) -> Channels:
        halves = {f"reference.{letter}": channels[f"reference_half.{letter}"] for letter in "RGB"}
        return {n: c for n, c in (channels | halves).items() if not n.startswith("reference_half.")}

    _rewritten(clips, out, halved, lambda record: record | {"reference_spp": record["reference_spp"] // 2})


def every_other(clips: Path, out: Path) -> None:
    """Half of the clips, every second in the order of their names."""
    _some(find_clips(clips)[::2], out)


def three_of_four(clips: Path, out: Path) -> None:
    """Three quarters of the clips.

    With references of 32 samples they take as much rendering time as all of them with 16: a room's clip (128 x 128
    pixels, 10 frames, six draws, two of them measured) took 1.27 times as many seconds of a core with 32 as with 16, a
    parlour's 1.45 times.
    """
    _some([clip for index, clip in enumerate(find_clips(clips)) if index % 4], out)


def _some(clips: list[Path], out: Path) -> None:
    for clip in clips:
        shutil.copytree(clip, out / clip.name, dirs_exist_ok=True)


def _rewritten(
    clips: Path, out: Path, frames: Callable[[Channels], Channels], record: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    for clip in find_clips(clips):
        (out / clip.name).mkdir(parents=True, exist_ok=True)
        for frame in sorted(clip.glob("frame_*.exr")):
            write_exr(out / clip.name / frame.name, frames(read_exr(frame)))
        write_json(out / clip.name / "clip.json", record(read_json(clip / "clip.json")))
