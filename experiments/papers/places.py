"""Hard places side by side: the same part of every method's image, enlarged without smoothing.

    python -m experiments.papers.places runs/results/indirect-1/pictures -o docs/results/places.png \\
        --places living-room-0:10,18,64,48 living-room-0:146,104,64,48 parlour-2008:0,30,64,48 \\
        living-room-0:256,20,64,48 staircase2-0:105,100,64,48 staircase2-0:24,128,64,48 staircase2-0:110,18,64,48

Reads the pictures that `experiments.papers.results` writes, of one run or of several. Each row is a place, each
column a method.
"""

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image, ImageDraw

from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.report.images import save_png

SCALE = 4
"""Times as large as the image."""
_LABEL = 16
"""Rows above the images for the methods' names."""


@dataclass
class Settings:
    """Show parts of every method's image side by side."""

    pictures: Annotated[list[Path], tyro.conf.Positional]
    """Folders with one folder of pictures per clip; of several, each place is a row from each of them."""
    places: list[str]
    """CLIP:X,Y,WIDTH,HEIGHT in pixels."""
    methods: list[str] = field(
        default_factory=lambda: ["noisy", "svgf", "Open-Image-Denoise", "ntd-small", "steady-balanced", "reference"]
    )
    """File names of the pictures."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("runs/places.png")


def part(picture: Path, place: tuple[int, int, int, int]) -> np.ndarray:
    """The place [height, width, 3] of a picture, in 0..1. Raises ValueError if it does not lie in the picture."""
    x, y, width, height = place
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"), np.float64) / 255.0
    found = pixels[y : y + height, x : x + width]
    if min(place) < 0 or found.shape[:2] != (height, width) or 0 in (height, width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]} pixels"
        raise ValueError(f"--places: expected a part of {picture} ({size}), got {place}.")
    return found


def parsed(place: str) -> tuple[str, tuple[int, int, int, int]]:
    """A clip's name and x, y, width, height. Raises ValueError for another form."""
    clip, _, numbers = place.rpartition(":")
    try:
        x, y, width, height = map(int, numbers.split(","))
    except ValueError as error:
        raise ValueError(f"--places: expected CLIP:X,Y,WIDTH,HEIGHT, got {place!r}.") from error
    return clip, (x, y, width, height)


def sheet(settings: Settings) -> np.ndarray:
    """All places [H, W, 3], with the methods' names above. Raises ValueError for places of different sizes."""
    rows = []
    for (clip, place), pictures in itertools.product(map(parsed, settings.places), settings.pictures):
        row = [part(pictures / clip / f"{method}.png", place) for method in settings.methods]
        rows.append(np.concatenate([np.pad(one, ((0, 1), (0, 1), (0, 0))) for one in row], axis=1))
    if len({row.shape for row in rows}) != 1:
        raise ValueError("--places: expected places of one width and height.")
    pixels = np.concatenate(rows).repeat(SCALE, axis=0).repeat(SCALE, axis=1)
    head = Image.new("RGB", (pixels.shape[1], _LABEL))
    for column, method in enumerate(settings.methods):
        at = (column * pixels.shape[1] // len(settings.methods) + 2, 2)
        ImageDraw.Draw(head).text(at, method.replace("-", " "), fill=(255, 255, 255))
    return np.concatenate([np.asarray(head, np.float64) / 255.0, pixels])


def main(settings: Settings) -> None:
    """Write the sheet."""
    save_png(settings.out, sheet(settings))
    print(settings.out)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
