"""``jaxdn doctor --warm``: what `jaxdn denoise` compiles, compiled now, so that no first frame waits for it."""

import tempfile
import time
from pathlib import Path

import numpy as np

from jaxdn.data.exr.exr import write_exr
from jaxdn.ops.dispatch.loop_compilers import loops_compiled_apart
from jaxdn.runtime.program_cache import keep_programs
from jaxdn.sequence.run import denoise_files, select_backend
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import AUTO, choose_model

_FRAMES = 2
"""The first has no history, and the second has one."""
_OBJECTS = {"without object indices": 1, "with object indices": 2}
"""Shots, and how many objects they have: indices that are all 0, as Blender has them unless somebody numbers the
objects, count as missing, and that is another program."""


def warm(size: tuple[int, int], method: str = AUTO) -> None:
    """Denoise frames of this height and width, with the passes that Blender writes, and print what is kept where.

    Once without and once with object indices. Raises ValueError for sizes below 1 and for a method that there is not.
    """
    height, width = size
    if min(size) < 1:
        raise ValueError(f"--width, --height: expected at least 1 pixel, got {width} x {height}.")
    folder = keep_programs()
    if folder is None:
        print("programs are not kept: no folder for them can be written, or JAX_COMPILATION_CACHE_DIR names another")
    name = choose_model(through_centres=False).name if method == AUTO else method
    model = select_backend(name)[0]
    start = time.monotonic()
    with loops_compiled_apart(), tempfile.TemporaryDirectory(prefix="jaxdn-warm-") as scratch:
        for shot, objects in _OBJECTS.items():
            source = Path(scratch) / shot
            source.mkdir()
            for number in range(_FRAMES):
                write_exr(source / f"warm.{number:04d}.exr", draw_passes(height, width, objects, number))
            denoise_files([source], Path(scratch) / f"{shot}, denoised", model, Settings())
    kept = "" if folder is None else f"; kept in {folder}"
    print(f"{name} is compiled for {width} x {height} ({time.monotonic() - start:.0f} s){kept}")


def draw_passes(height: int, width: int, objects: int, seed: int) -> dict[str, np.ndarray]:
    """The channels [H, W] of a noisy frame: those that ``docs/how-to/blender_passes.py`` asks for.

    No pass is the same everywhere, as such passes count as missing, but for the indices of a single object.
    """
    rng = np.random.default_rng(seed)

    def layer(name: str, letters: str, values: np.ndarray) -> dict[str, np.ndarray]:
        return {
            f"ViewLayer.{name}.{letter}": np.ascontiguousarray(plane, np.float32)
            for letter, plane in zip(letters, values, strict=True)
        }

    normal = rng.normal(size=(3, height, width))
    return {
        **layer("Combined", "RGB", 0.18 * rng.gamma(4, 0.25, (3, height, width))),
        **layer("Denoising Albedo", "RGB", rng.uniform(0.1, 0.9, (3, height, width))),
        **layer("Denoising Normal", "XYZ", normal / np.linalg.norm(normal, axis=0)),
        **layer("Depth", "Z", rng.uniform(2, 8, (1, height, width))),
        **layer("Vector", "XYZW", rng.uniform(-1, 1, (4, height, width))),
        **layer("IndexOB", "X", rng.integers(0, objects, (1, height, width))),
    }
