"""Does the memory of `jaxdn denoise` grow with the number of frames? Peak memory for a short and a long sequence.

    python -m experiments.stability.memory --frames 2 60     # 1280 x 720, runs/memory.json

Frames are another renderer's EXR files (beauty, albedo, normal, depth, motion). The command line denoises each sequence
in a separate process, whose peak resident set is measured. Unix only.
"""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json


@dataclass
class Settings:
    """Denoise sequences of several lengths and compare their peak memory."""

    frames: tuple[int, ...] = (2, 60)
    width: int = 1280
    height: int = 720
    method: str = "ntd-small"
    max_memory: float | None = None
    """`jaxdn denoise --max-memory`, in GiB."""
    out: Path = Path("runs/memory.json")


def write_sequence(folder: Path, frames: int, height: int, width: int) -> None:
    """Noise with every buffer that the networks read; all frames are copies: a link counts as a frame that is held."""
    rng = np.random.default_rng(0)
    layers = {"": "RGB", "albedo.": "RGB", "normal.": "XYZ", "motion.": "XY", "depth.": "Z"}
    channels = {
        f"{layer}{letter}": rng.uniform(0.1, 0.9, (height, width)).astype(np.float32)
        for layer, letters in layers.items()
        for letter in letters
    }
    folder.mkdir()
    first = folder / "frame_0001.exr"
    # As they are: to compress noise, once to write it here and once in each result, takes most of a run's time.
    OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(first))
    for index in range(2, frames + 1):
        shutil.copyfile(first, folder / f"frame_{index:04d}.exr")


def peak_mib(source: Path, out: Path, method: str, max_memory: float | None = None) -> float:
    """The peak resident set of one `jaxdn denoise`, in MiB. Raises RuntimeError where it fails."""
    command = [sys.executable, "-m", "jaxdn.commands.main", "denoise", str(source), "-o", str(out), "--method", method]
    command += ["--motion-convention", "previous-current"]
    command += [] if max_memory is None else ["--max-memory", f"{max_memory:g}"]
    told = subprocess.run([sys.executable, "-c", _LAUNCHER, *command], stdout=subprocess.PIPE, text=True, check=False)
    if told.returncode:
        raise RuntimeError(f"jaxdn denoise of {source} ended with status {told.returncode}")
    return int(told.stdout.splitlines()[-1]) / (1024 if sys.platform != "darwin" else 1024**2)


# Linux counts the memory of the process that starts another one as that one's, too: a small one has to start it.
_LAUNCHER = """
import resource, subprocess, sys
status = subprocess.call(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(status)
"""


def main(settings: Settings) -> None:
    """Measure, print, save."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as place:
        for count in settings.frames:
            source = Path(place) / f"frames-{count}"
            write_sequence(source, count, settings.height, settings.width)
            found[str(count)] = peak_mib(source, Path(place) / f"out-{count}", settings.method, settings.max_memory)
            print(f"{count} frames: {found[str(count)]:.0f} MiB", flush=True)
    sizes = {name: getattr(settings, name) for name in ("width", "height", "method", "max_memory")}
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(settings.out, {**sizes, "peak MiB": found})


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
