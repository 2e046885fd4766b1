"""A frame of two sequences side by side, as a small picture for the documentation.

python -m docs.figures.before_after runs/blender/noisy runs/blender/clean --frame 7 -o docs/images/blender.webp
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from docs.figures.front_page import sheet
from jaxdn import color
from jaxdn.clips import read_clip
from jaxdn.commands.errors import plain_errors


@dataclass
class Settings:
    """Show the same frame of two sequences."""

    before: Annotated[Path, tyro.conf.Positional]
    """Noisy frames."""
    after: Annotated[Path, tyro.conf.Positional]
    """The same frames, denoised."""
    frame: int = 0
    """Counted from 0."""
    names: tuple[str, str] = ("4 samples per pixel", "denoised")
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("docs/images/blender.webp")


def main(settings: Settings) -> None:
    """Read both, draw."""
    clips = [read_clip(folder) for folder in (settings.before, settings.after)]
    shown = [np.asarray(color.tonemap(clip.frames.radiance[settings.frame])) for clip in clips]
    sheet(dict(zip(settings.names, shown, strict=True)), None).save(settings.out, quality=90, method=6)
    print(f"{settings.out}: {settings.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
