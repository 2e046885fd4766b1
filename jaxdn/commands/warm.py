"""``jaxdn doctor --warm``: what `jaxdn denoise` compiles, compiled now, so that no first frame waits for it."""

import tempfile
import time
from pathlib import Path

import numpy as np

from jaxdn.data.exr.exr import write_exr
from jaxdn.runtime.program_cache import keep_programs
from jaxdn.sequence.run import denoise_files, select_backend
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import AUTO, choose_model

_FRAMES = 2
"""The first has no history, and the second has one."""


def warm(size: tuple[int, int], method: str = AUTO) -> None:
    """Denoise frames of this height and width, with the passes that Blender writes, and print what is kept where.

    Raises ValueError for sizes below 1 and for a method that there is not.
    """
    height, width = size
    if min(size) < 1:
        raise ValueError(f"--width, --height: expected at least 1 pixel, got {width} x {height}.")
    folder = keep_programs()
    if folder is None:
        print("programs are not kept: no folder for them can be written, or JAX_COMPILATION_CACHE_DIR names another")
    name = choose_model(own_clips=False).name if method == AUTO else method
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="jaxdn-warm-") as scratch:
        source = Path(scratch) / "frames"
        source.mkdir()
        for number in range(_FRAMES):
            write_exr(source / f"warm.{number:04d}.exr", _draw_passes(height, width, number))
        denoise_files([source], Path(scratch) / "out", select_backend(name)[0], Settings())
    print(f"{name} is compiled for {width} x {height} ({time.monotonic() - start:.0f} s); kept in {folder}")


def _draw_passes(height: int, width: int, seed: int) -> dict[str, np.ndarray]:
    """The channels of a noisy frame that fills the image."""
    rng = np.random.default_rng(seed)

    def layer(name: str, letters: str, values: np.ndarray) -> dict[str, np.ndarray]:
        planes = np.broadcast_to(values, (len(letters), height, width)).astype(np.float32)
        return {
            f"ViewLayer.{name}.{letter}": np.ascontiguousarray(plane)
            for letter, plane in zip(letters, planes, strict=True)
        }

    noisy = 0.18 * rng.gamma(4, 0.25, (3, height, width))
    up = np.array([0.0, 0.0, 1.0])[:, None, None]
    return {
        **layer("Combined", "RGB", noisy),
        **layer("Denoising Albedo", "RGB", np.asarray(0.5)),
        **layer("Denoising Normal", "XYZ", up),
        **layer("Depth", "Z", np.asarray(4.0)),
        **layer("Vector", "XYZW", rng.uniform(-1, 1, (4, height, width))),
    }
