"""A shot denoised in chunks: what is seen where two of them join, by the number of frames that a chunk reads before.

    python -m experiments.stability.joints      # runs/joints.json

Three shots: the camera pans, the camera stands, and it pans while a lamp goes out. For each lead-in the first frame
of a chunk is compared with the same frame of the shot denoised in one piece: its distance, its PSNR, and the flicker
at the joint, where the frame before is that of the chunk before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro

from experiments.measurement import describe_measurement
from experiments.speed.works import scene
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Array, Clip, Frame
from jaxdn.runtime.atomic_files import write_json
from jaxdn.zoo.ready import Model, find_model

_OUT_AGAIN = 8
"""The lamp goes out so many frames before the chunk begins."""


@dataclass
class Settings:
    """Denoise three shots whole and in chunks."""

    methods: tuple[str, ...] = ("steady-balanced", "svgf")
    leads: tuple[int, ...] = (0, 8, 16, 32)
    """Frames that are read before the first of a chunk."""
    start: int = 40
    """The first frame of the chunk."""
    after: int = 4
    """Frames of the chunk."""
    size: int = 64
    out: Path = field(default_factory=lambda: Path("runs/joints.json"))


class Joint(NamedTuple):
    """The first frame of a chunk."""

    difference: float
    """From the whole shot's, mean absolute, in shares of the light."""
    psnr: float
    """dB, of x / (1 + x)."""
    flicker: float
    """Change from the frame before beyond the reference's own, relative to that of the whole shot."""
    equal_after: int | None
    """Frames of the chunk until one is bit-equal to the whole shot's; None: none is."""


def make_shots(frames: int, size: int, chunk: int) -> dict[str, Clip]:
    """The three shots, with clean references."""
    pan = scene.clip(frames, size, size, seed=1)
    still = scene.clip(1, size, size, seed=2)
    noise = np.random.default_rng(3).exponential(size=(frames, size, size, 3)).astype(np.float32)
    repeated = jax.tree.map(lambda image: np.repeat(image, frames, axis=0), still)
    motion = np.zeros_like(repeated.frames.motion)
    guides = repeated.frames._replace(radiance=repeated.reference * noise, motion=motion, dual_motion=motion)
    light = np.where(np.arange(frames) < chunk - _OUT_AGAIN, 1.0, 0.2).astype(np.float32)[:, None, None, None]
    dimmed = pan.frames._replace(radiance=pan.frames.radiance * light)
    return {
        "camera pans": pan,
        "camera stands": Clip(guides, repeated.reference),
        "lamp goes out": Clip(dimmed, pan.reference * light),
    }


class Stepper:
    """A denoiser, frame by frame, compiled once."""

    def __init__(self, model: Model) -> None:
        if model.denoiser is None:
            raise ValueError(f"{model.label}: expected a denoiser, got the noisy image; name a filter or weights.")
        self._denoiser, self._params = model.denoiser, model.params
        self._step = jax.jit(model.denoiser.step)

    def run(self, frames: Frame, begin: int, end: int) -> list[np.ndarray]:
        """The images of frames ``begin`` to ``end``, with no history before."""
        state, images = None, []
        for index in range(begin, end):
            frame = jax.tree.map(lambda image, index=index: image[index], frames)
            state = self._denoiser.start(self._params, frame) if state is None else state
            state, image = self._step(self._params, state, frame)
            images.append(np.asarray(image))
        return images


def measure_joint(whole: Sequence[np.ndarray], chunk: Sequence[np.ndarray], reference: Array, start: int) -> Joint:
    """``whole`` and ``reference`` from frame 0 on, ``chunk`` from frame ``start``."""
    first, before, same = chunk[0], whole[start - 1], whole[start]
    change = reference[start] - reference[start - 1]
    flicker, usual = (np.abs(image - before - change).mean() for image in (first, same))
    error = np.mean((first / (1 + first) - reference[start] / (1 + reference[start])) ** 2)
    equal = (index for index, image in enumerate(chunk) if np.array_equal(image, whole[start + index]))
    difference = np.abs(first - same).mean() / same.mean()
    return Joint(float(difference), float(-10 * np.log10(error)), float(flicker / usual), next(equal, None))


def main(settings: Settings) -> None:
    """Measure, print, save."""
    end = settings.start + settings.after
    shots = make_shots(end, settings.size, settings.start)
    rows = []
    for method in settings.methods:
        stepper = Stepper(find_model(method))
        for name, clip in shots.items():
            whole = stepper.run(clip.frames, 0, end)
            for lead in settings.leads:
                chunk = stepper.run(clip.frames, settings.start - lead, end)[lead:]
                joint = measure_joint(whole, chunk, clip.reference, settings.start)
                own = measure_joint(whole, whole[settings.start :], clip.reference, settings.start)
                told = "never" if joint.equal_after is None else str(joint.equal_after)
                row = [method, name, lead, f"{100 * joint.difference:.2f} %", round(joint.psnr - own.psnr, 2) + 0.0]
                rows.append([*row, f"{joint.flicker:.2f}", told])
                print(*rows[-1], sep="  ", flush=True)
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    found = describe_measurement(
        *("table", "Where chunks join", "Sequences", 215),
        command="python -m experiments.stability.joints",
        what=f"The first frame of a chunk, number {settings.start} of a shot of {settings.size} x {settings.size} "
        "pixels, against that of the whole shot: mean distance in shares of the light; PSNR (of x / (1 + x), in dB) "
        "minus the whole shot's; the change from the frame before beyond the reference's, relative to the whole "
        f"shot's; and the number of frames of the chunk until one is bit-equal, of {settings.after}. The lamp goes out "
        f"{_OUT_AGAIN} frames before the chunk: one that begins there has no history of the lamp, which svgf drags "
        "along for a while.",
        rows=rows,
    )
    names = ("method", "shot", "lead-in", "distance", "PSNR", "flicker", "bit-equal after")
    write_json(settings.out, {**found, "columns": [{"name": name} for name in names]})


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
