"""Which windows of clips a packed training set holds, and what of each: the same for every format of such sets."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxdn.core.checks import check_at_least
from jaxdn.core.frame import GUIDES
from jaxdn.data.errors import ClipError
from jaxdn.data.training.cache import CachedClip

USUAL = ("albedo", "normal", "depth", "roughness", "motion", "dual_motion", "visible", "reflectance")
"""What every variant of ``ntd`` and its objectives read."""


class Packing(NamedTuple):
    """What is taken from each clip."""

    crop: int = 64
    """Side of the square windows, in pixels."""
    frames: int = 10
    """Consecutive frames of a window; of a shorter clip all."""
    draws: int = 2
    """Single samples; 0: the clips' layer of one sample instead."""
    buffers: tuple[str, ...] = USUAL
    direct: bool = True
    """With the direct light of the single samples, and the buffers ``direct`` and ``emission``."""
    half: bool = True
    """With the reference's first half, for training on inputs of half its samples."""
    seed: int = 0
    """Of the windows."""


class Packed(NamedTuple):
    """What was written."""

    windows: int
    clips: int
    """Clips that at least one window is of."""
    size: int
    """In bytes."""


def check_packable(clip: CachedClip, packing: Packing) -> None:
    """Raise ClipError for a clip that lacks what is asked for, and ValueError for values out of range."""
    unknown = set(packing.buffers) - set(GUIDES)
    if unknown:
        raise ValueError(f"buffers: expected some of {', '.join(GUIDES)}, got {', '.join(sorted(unknown))}.")
    check_at_least(1, crop=packing.crop, frames=packing.frames)
    check_at_least(0, draws=packing.draws)
    if min(clip.shape[1:]) < packing.crop:
        raise ClipError(
            f"{clip.path}: expected at least {packing.crop} x {packing.crop} pixels for the crop, got {clip.shape[2]} "
            f"x {clip.shape[1]}; make it smaller (--crop {min(clip.shape[1:])})."
        )
    if "reference" not in clip.arrays:
        raise ClipError(f"{clip.path}: there is no reference to train towards; render the clip with one.")
    if clip.draws < packing.draws or (not packing.draws and 1 not in clip.layers):
        raise ClipError(
            f"{clip.path}: expected {packing.draws or 'a layer of 1'} single samples, got {clip.draws} and layers of "
            f"{', '.join(map(str, clip.layers))} samples; ask for other --draws, or render the clip with more."
        )


def choose_windows(
    clips: Sequence[CachedClip], packing: Packing
) -> Iterator[tuple[CachedClip, tuple[slice, ...], np.random.Generator]]:
    """Different windows in rounds, each with one of every clip; the end is a round that had no new one."""
    rng = np.random.default_rng(packing.seed)
    taken: set[tuple[int, ...]] = set()
    found = True
    while found:
        found = False
        for chosen in map(int, rng.permutation(len(clips))):
            clip = clips[chosen]
            sizes = (min(packing.frames, clip.shape[0]), packing.crop, packing.crop)
            starts = [int(rng.integers(has - wants + 1)) for has, wants in zip(clip.shape, sizes, strict=True)]
            if (chosen, *starts) not in taken:
                found = True
                taken.add((chosen, *starts))
                yield clip, tuple(slice(start, start + n) for start, n in zip(starts, sizes, strict=True)), rng
