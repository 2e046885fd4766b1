"""Open Image Denoise from file to file, with our reading and writing: what `jaxdn denoise` is compared with.

    python -m experiments.speed.peers.oidn_files FRAMES OUT

Frames have the channels that Blender writes. As there, the next file is read and the one before is written while one is
denoised. Each image stands for itself: there is no motion and no history, and nothing is kept of the noisy image.
"""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from jaxdn.data.exr.exr import rewrite_exr
from jaxdn.data.exr.file import ExrFile
from jaxdn.ops import oidn
from jaxdn.runtime.overlap import Behind, read_ahead

LAYERS = {"color": "Combined.RGB", "albedo": "Denoising Albedo.RGB", "normal": "Denoising Normal.XYZ"}
"""Image of the library -> layer and letters, of the view layer's channels."""


def names_of(image: str) -> list[str]:
    """The channels of one of its images."""
    layer, letters = LAYERS[image].split(".")
    return [f"ViewLayer.{layer}.{letter}" for letter in letters]


def read_files(files: list[Path], log: Callable[[str], None]) -> Iterator[tuple[ExrFile, dict[str, np.ndarray]]]:
    """Each file, decoded, and its images [H, W, 3]."""
    for path in files:
        opened = ExrFile(path)
        pixels = opened.pixels
        yield opened, {image: np.stack([pixels[name] for name in names_of(image)], axis=-1) for image in LAYERS}


def denoise_files(source: Path, out: Path) -> list[Path]:
    """Denoise the files of a folder; returns what is written."""
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    files = sorted(source.glob("*.exr"))
    with Behind[list[str]]() as behind, read_ahead(partial(read_files, files), print) as frames:
        for opened, images in frames:
            image = oidn.denoise(images["color"], images["albedo"], images["normal"])
            replaced = dict(zip(names_of("color"), np.moveaxis(image, -1, 0), strict=True))
            target = out / opened.path.name
            behind.start(partial(rewrite_exr, opened, target, replaced), lambda notes: None)
            written.append(target)
    return written


if __name__ == "__main__":
    print(f"{len(denoise_files(Path(sys.argv[1]), Path(sys.argv[2])))} frames")
