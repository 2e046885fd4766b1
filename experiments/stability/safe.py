"""Is any frame worse than it was? Beauty with all guides, with none, and with guides of another picture.

    python -m experiments.stability.safe CLIP ... [--spp 1 64] [--methods svgf steady-balanced]

Clips with a reference and with the layers that are asked for, such as `jaxdn render pinkroom --layers 1 4 16 64
--reference-spp 1024 -o data/safe` makes. Their indirect, direct and emitted light are added, as other renderers do.
Prints PSNR in dB (tone-mapped, means of the frames) of the input, of the denoised frame, and of the safe mixture of
both (:mod:`jaxdn.sequence.safe_blend`, what `jaxdn denoise` writes); ``reference`` is the reference itself as the
input, to be returned as it is.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxdn import color
from jaxdn.clips import find_clips
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.read import open_frames
from jaxdn.metrics import psnr
from jaxdn.sequence.denoise_frames import Pass
from jaxdn.zoo.ready import Candidate, candidate

GUIDES = ("all", "none", "turned")
"""All guides, light alone, and guides turned by 180 degrees."""
MOST = 99.0
"""Shown where nothing differs."""


@dataclass
class Settings:
    """Compare inputs, denoised frames and the safe mixture of both."""

    clips: Annotated[list[Path], tyro.conf.Positional]
    """Clips, or folders of clips."""
    spp: list[int] = field(default_factory=lambda: [1, 64])
    """Samples per pixel."""
    methods: list[str] = field(default_factory=lambda: ["svgf", "steady-balanced"])


class Beauty(NamedTuple):
    """All light of a frame, its guides and its reference."""

    frame: Frame
    reference: np.ndarray


def beauties(clip: Path, spp: int) -> Iterator[Beauty]:
    """The frames of a clip at so many samples; 0: its reference in their place. Raises ValueError without one."""
    for stored in open_frames(clip, spp=spp or 1)[1]:
        frame, reference = stored.frame, stored.reference
        if reference is None or frame.direct is None:
            raise ValueError(f"{clip}: expected a reference and direct light; render it with --reference-spp 1024.")
        rest = frame.direct + (0.0 if frame.emission is None else frame.emission)
        wanted = reference + rest
        light = wanted if spp == 0 else frame.radiance + rest
        yield Beauty(frame._replace(radiance=light, direct=None, emission=None), wanted)


def guided(frame: Frame, guides: str) -> Frame:
    """The frame with :data:`GUIDES`."""
    if guides == "none":
        return Frame(frame.radiance)
    if guides == "all":
        return frame
    turned = jax.tree.map(lambda buffer: np.ascontiguousarray(buffer[::-1, ::-1]), frame)
    return turned._replace(radiance=frame.radiance)


def decibels(image: np.ndarray, wanted: np.ndarray) -> float:
    """PSNR of tone-mapped images, at most :data:`MOST`."""
    return min(float(psnr(*(color.tonemap(jnp.asarray(each)) for each in (image, wanted)))), MOST)


def measure(clip: Path, method: Candidate, spp: int, guides: str) -> list[float]:
    """PSNR of input, denoised frames and mixture."""
    found = []
    step = Pass(clip, method, log=lambda line: None)
    for frame, wanted in beauties(clip, spp):
        frame = guided(frame, guides)
        image = step(StoredFrame(frame, {}, None, None))
        found.append([decibels(each, wanted) for each in (frame.radiance, image, step.safe(frame, image)[0])])
    return np.mean(found, axis=0).tolist()


def main(settings: Settings) -> None:
    """Print a table in Markdown."""
    print("| clip | samples | guides | input | " + " | ".join(f"{name} | safe" for name in settings.methods) + " |")
    print("|" + "---|" * (4 + 2 * len(settings.methods)))
    methods = [candidate(name) for name in settings.methods]
    for clip in (clip for folder in settings.clips for clip in find_clips(folder)):
        for spp in (*settings.spp, 0):
            for guides in GUIDES:
                rows = [measure(clip, method, spp, guides) for method in methods]
                cells = " | ".join(f"{denoised:.1f} | {safe:.1f}" for _, denoised, safe in rows)
                print(f"| {clip.name} | {spp or 'reference'} | {guides} | {rows[0][0]:.1f} | {cells} |", flush=True)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
