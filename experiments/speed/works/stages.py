"""From file to file, stage by stage: what a frame takes to be read, denoised and written, one after the other.

`jaxdn denoise` does the three at the same time for three frames. Here nothing overlaps, so that the times add up.
"""

import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.speed.workers import apart
from experiments.speed.works import files
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.runtime.malloc import tune_malloc
from jaxdn.runtime.program_cache import VARIABLE, keep_programs
from jaxdn.sequence.frame_denoiser import FrameDenoiser
from jaxdn.sequence.run import select_backend
from jaxdn.sequence.settings import Settings
from jaxdn.sequence.write_frames import ForeignWriter

FRAMES = 6


class Stages(NamedTuple):
    """Milliseconds of one frame, in the steady state; and of a first frame, what is left of the command's time."""

    starting: float
    """Python, imports, tracing, loading programs that are kept; memory that is used for the first time."""
    reading: float
    denoising: float
    """With the safe blend."""
    writing: float


def measure_stages(method: str, size: tuple[int, int], frames: int = FRAMES) -> Stages:
    """Stages of frames of this height and width with Blender's passes, each command in a process of its own.

    Raises RuntimeError where the command fails, WorkerError where the method cannot run here.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        one, all_ = files.write_shot(place / "one", 1, *size), files.write_shot(place / "all", frames, *size)
        taken = apart(time_frames, method, all_, place / "out", place / "programs")
        first = [files.run_apart(files.command(method, one, place / "first"), place / "programs") for _ in range(2)]
    reading, denoising, writing = np.median(taken[1:], axis=0).tolist()
    return Stages(max(0.0, first[-1].wall_ms - reading - denoising - writing), reading, denoising, writing)


def time_frames(method: str, source: Path, out: Path, programs: Path) -> list[tuple[float, float, float]]:
    """Milliseconds of reading, denoising and writing each frame of a folder, with what `jaxdn denoise` calls."""
    os.environ[VARIABLE] = str(programs)
    keep_programs()
    tune_malloc()
    settings = Settings()
    sequence = ForeignSequence([ExrFile(path) for path in sorted(source.glob("*.exr"))], settings.naming)
    channels = len(sequence.files[0].windows)
    denoiser = FrameDenoiser(select_backend(method)[0], source, channels=lambda: channels, log=_ignore)
    writer = ForeignWriter(sequence.window, settings, _ignore)
    frames = sequence.frames(keep_pixels=True)
    taken: list[tuple[float, float, float]] = []
    for file in sequence.files:
        times = [time.perf_counter()]
        frame = next(frames)
        times.append(time.perf_counter())
        image, _ = denoiser.blend_fallback(frame, denoiser(StoredFrame(frame)))
        times.append(time.perf_counter())
        write = writer.prepare(out / file.path.name, file, frame, image)
        assert write is not None
        write()
        times.append(time.perf_counter())
        reading, denoising, writing = 1e3 * np.diff(times)
        taken.append((float(reading), float(denoising), float(writing)))
    return taken


def _ignore(line: str) -> None:
    """What is told about a shot is not measured."""
