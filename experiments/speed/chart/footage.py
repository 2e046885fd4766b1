"""The clips of the chart, rendered with noisy layers from 1 sample per pixel up to the most a user would wait for."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn import effects
from jaxdn.clips import ClipError, read_clip, read_record
from jaxdn.core.frame import Frame
from jaxdn.data.clip.noise_floor import read_halves, read_noise_floor
from jaxdn.ops.sampling import allot_evenly
from jaxdn.render import ClipJob, render_clips
from jaxdn.render.settings import RenderSettings


class Sizes(NamedTuple):
    """The rendered and timed sizes."""

    scenes: tuple[tuple[str, int], ...]
    """(family, seed): seeds that no network was trained or validated on."""
    pixels: int
    """Width and height."""
    frames: int
    most_samples: int
    """The largest noisy layer, a power of two."""
    reference_spp: int
    timed: tuple[int, int]
    """Height and width of the frame that is timed."""
    rounds: int
    quick: bool = False
    """Measure only the plain form of each method's fastest weights."""

    @property
    def layers(self) -> tuple[int, ...]:
        """1, 2, 4 ... samples per pixel."""
        return tuple(2**power for power in range(self.most_samples.bit_length()))


FULL = Sizes((("pinkroom", 400), ("mobile", 400)), 64, 6, 1024, 2048, (720, 1280), rounds=3)
QUICK = Sizes((("mobile", 400),), 32, 5, 16, 32, (48, 64), rounds=2, quick=True)
SCORED = 4
"""Frames at a clip's end that are scored: recurrent methods have a history by then."""


class EvaluationClip(NamedTuple):
    """One clip, read."""

    name: str
    folder: Path
    record: dict[str, Any]
    frames: Frame
    """[T, H, W, C] the buffers that the clip's effects require; ``radiance`` is that of the smallest layer."""
    noisy: dict[int, np.ndarray]
    """Samples per pixel -> [T, H, W, 3]."""
    reference: np.ndarray
    halves: tuple[np.ndarray, np.ndarray] | None
    """Two independent references of half the samples each, where the clip keeps them."""
    hidden: np.ndarray
    """[T, H, W, 1] bool, pixels whose point was hidden one frame earlier."""
    shown: int
    """The frame on the page: the scored frame with the most hidden pixels."""
    noise_floor: float
    """PSNR in dB that a perfect image would have against the reference; NaN where it is not known."""


def render(sizes: Sizes, folder: Path) -> list[Path]:
    """Render the clips into ``folder``, unless they exist; returns their folders."""
    places = [folder / f"{family}-{seed}" for family, seed in sizes.scenes]
    jobs = [
        ClipJob(
            {"family": family, "seed": seed},
            str(place),
            sizes.frames,
            RenderSettings(
                width=sizes.pixels,
                height=sizes.pixels,
                layers=sizes.layers,
                reference_spp=sizes.reference_spp,
                seed=seed,
            ),
        )
        for (family, seed), place in zip(sizes.scenes, places, strict=True)
    ]
    return render_clips(jobs)


def read(folder: Path) -> EvaluationClip:
    """Read a clip. Raises ClipError if it has no reference or too few frames to be scored."""
    record = read_record(folder)
    layers = sorted(record["layers"])
    clip = read_clip(folder, spp=layers[0])
    count = record["frames"]
    if clip.reference is None:
        raise ClipError(f"{folder}: expected a clip with a reference to compare with; render one with reference_spp.")
    if count <= SCORED:
        raise ClipError(f"{folder}: expected more than {SCORED} frames, the last {SCORED} are scored; got {count}.")
    noisy = {spp: np.asarray(read_clip(folder, spp=spp).frames.radiance) for spp in layers}
    visible = clip.frames.visible
    hidden = np.zeros((*np.shape(clip.reference)[:3], 1), bool) if visible is None else ~np.asarray(visible, bool)
    shown = count - SCORED + int(np.argmax(hidden[-SCORED:].sum((1, 2, 3))))
    planned = effects.plan(effects.inspect(folder)).buffers
    frames = clip.frames._replace(**{name: None for name in Frame._fields[1:] if name not in planned})
    floor, halves = read_noise_floor(folder), read_halves(folder)
    reference = np.asarray(clip.reference)
    return EvaluationClip(folder.name, folder, record, frames, noisy, reference, halves, hidden, shown, floor)


def noisy_frames(clip: EvaluationClip, spp: float) -> Frame:
    """The frames with so many samples per pixel; below 1, of the layer of one sample, in a pattern that rotates."""
    if spp >= 1:
        return clip.frames._replace(radiance=clip.noisy[int(spp)])
    count, height, width = clip.noisy[1].shape[:3]
    counts = np.stack([allot_evenly(spp, height, width, index) for index in range(count)])
    return clip.frames._replace(radiance=clip.noisy[1] * counts, sample_count=counts)


def common_layers(clips: Sequence[EvaluationClip]) -> list[int]:
    """The numbers of samples that every clip has. Raises ClipError if there are none, or the sizes differ."""
    shared = set.intersection(*(set(clip.noisy) for clip in clips))
    shapes = {clip.reference.shape[1:3] for clip in clips}
    if not shared or len(shapes) > 1:
        raise ClipError(
            f"clips: expected clips of one size with sample counts in common, got sizes {sorted(shapes)} and counts "
            f"{[sorted(clip.noisy) for clip in clips]}."
        )
    return sorted(shared)
