"""The picture of the README: a frame of Blender's Cycles, noisy, by Open Image Denoise, by the default, its reference.

    python -m docs.figures.cycles_page runs/cycles/test/cut-9000 --part 200 62 120 60

The clip is one of the test set (``make cycles``). Frames are denoised as ``jaxdn denoise`` does it, without the safe
blend, as in the table of results. Whole frames stand above, a part of each, enlarged without smoothing, below.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from docs.figures.front_page import sheet
from experiments.cycles import reference as references
from experiments.cycles.compare import PLAIN, denoise_frames
from jaxdn import color
from jaxdn.commands.errors import plain_errors
from jaxdn.zoo.ready import BEST_ELSEWHERE, NOISY

_GREY = 0.18
"""What the geometric mean of the reference's light is shown as."""


@dataclass
class Settings:
    """Show a frame of a Cycles clip before and after denoising, and its reference."""

    clip: Annotated[Path, tyro.conf.Positional]
    """A clip with a reference of the frame."""
    part: tuple[int, int, int, int]
    """X,Y,WIDTH,HEIGHT of the part that is enlarged, in pixels."""
    frame: int = 6
    spp: int = 1
    methods: tuple[str, ...] = ("oidn" + PLAIN, BEST_ELSEWHERE + PLAIN)
    """Names as of ``experiments.cycles.compare``."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("docs/images/cycles.webp")


NAMES = {"oidn": "Open Image Denoise high"}
"""Methods that have another name in the picture."""


def main(settings: Settings) -> None:
    """Denoise the clip's frames and draw."""
    held = references.read(settings.clip / "reference" / f"{settings.frame:04d}.exr")
    files = sorted((settings.clip / f"{settings.spp}spp-0").glob("*.exr"))
    gain = _GREY / np.exp(np.mean(np.log(held.image.mean(axis=-1) + 1e-3)))
    samples = f"{settings.spp} sample{'s' * (settings.spp > 1)}"
    images = {f"Cycles, {samples} per pixel": denoise_frames(files, settings.clip, NOISY, [settings.frame])}
    with tempfile.TemporaryDirectory() as place:
        for method in settings.methods:
            name = method.removesuffix(PLAIN)
            images[NAMES.get(name, name)] = denoise_frames(files, Path(place) / name, method, [settings.frame])
    shown = {name: found[settings.frame] for name, found in images.items()}
    shown[f"reference: {2 * held.samples} samples"] = held.image
    pictures = {name: np.asarray(color.tonemap((gain * image).astype(np.float32))) for name, image in shown.items()}
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    sheet(pictures, settings.part).save(settings.out, quality=90, method=6)
    print(f"{settings.out}: {settings.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
