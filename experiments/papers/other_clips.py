"""The clips of a folder as they would be had they been rendered in another way, to measure what that way is worth."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxdn.clips import find_clips
from jaxdn.clips.exr import read_exr, write_exr
from jaxdn.clips.files import read_json
from jaxdn.files import write_json

Channels = dict[str, np.ndarray]


def without_draws(clips: Path, out: Path) -> None:
    """One noisy image a frame for ever, instead of single samples that are drawn anew."""
    _rewritten(clips, out, lambda channels: {n: c for n, c in channels.items() if not re.match(r"draw_\d", n)})


def half_reference(clips: Path, out: Path) -> None:
    """References of half as many samples: those of the half that a clip keeps."""

    def halved(channels: Channels) -> Channels:
        halves = {f"reference.{letter}": channels[f"reference_half.{letter}"] for letter in "RGB"}
        return {n: c for n, c in (channels | halves).items() if not n.startswith("reference_half.")}

    _rewritten(clips, out, halved)


def every_other(clips: Path, out: Path) -> None:
    """Half of the clips, every second in the order of their names."""
    for clip in find_clips(clips)[::2]:
        shutil.copytree(clip, out / clip.name, ignore=shutil.ignore_patterns("cache*"), dirs_exist_ok=True)


def _rewritten(clips: Path, out: Path, change: Callable[[Channels], Channels]) -> None:
    for clip in find_clips(clips):
        (out / clip.name).mkdir(parents=True, exist_ok=True)
        for frame in sorted(clip.glob("frame_*.exr")):
            write_exr(out / clip.name / frame.name, change(read_exr(frame)))
        record = {name: value for name, value in read_json(clip / "clip.json").items() if name != "draws"}
        write_json(out / clip.name / "clip.json", record)
