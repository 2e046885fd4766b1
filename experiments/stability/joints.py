"""A shot denoised in chunks: what is seen where two of them join, by the number of frames that a chunk reads before.

    python -m experiments.stability.joints      # runs/joints.json

Each shot (:mod:`experiments.stability.joint_shots`) is denoised in one piece and in two chunks, forwards alone and in
both directions as ``jaxdn denoise --bidirectional`` does. The chunk before the joint reads as many frames after its
last one, with both directions, as the other one reads before its first. The two frames at the joint are compared with
the same frames of the whole shot: their distance, their PSNR, and the flicker from one to the other.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro

from experiments.measurement import describe_measurement
from experiments.stability.joint_shots import CUT, LAMP_OUT, make_shots, name_shot, render_shot
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Array, Clip, Frame, frame_at
from jaxdn.filters.time_reversal import HistoryLength, blend, reverse_time, update_history_length
from jaxdn.runtime.atomic_files import write_json
from jaxdn.zoo.ready import Model, find_model

Images = dict[int, np.ndarray]
"""By the number of their frame."""


@dataclass
class Settings:
    """Denoise shots whole and in chunks."""

    methods: tuple[str, ...] = ("steady-balanced", "svgf")
    leads: tuple[int, ...] = (0, 8, 16, 32)
    """Frames that are read before the first of a chunk, and with both directions after the last."""
    start: int = 40
    """The first frame of the second chunk; the first one has all before."""
    after: int = 32
    """Frames of the second chunk, to the end of the shot."""
    size: int = 64
    synthetic: bool = True
    """Whether the synthetic shots are measured."""
    rendered: tuple[str, ...] = ("robot", "parlour")
    """Families and scene files (.xml) of which a shot is rendered, which takes minutes."""
    out: Path = field(default_factory=lambda: Path("runs/joints.json"))


class Joint(NamedTuple):
    """The last frame of one chunk and the first of the next. Of what both have, the figure of the worse."""

    difference: float
    """From the whole shot's, mean absolute, in shares of the light."""
    psnr: float
    """dB of x / (1 + x), minus the whole shot's."""
    flicker: float
    """Change from one frame to the other beyond the reference's own, relative to that of the whole shot."""
    equal_after: int | None
    """Frames of the second chunk from which on all are bit-equal to the whole shot's; None: its last is not."""


class Stepper:
    """A denoiser, frame by frame, compiled once."""

    def __init__(self, model: Model) -> None:
        if model.denoiser is None:
            raise ValueError(f"{model.label}: expected a denoiser, got the noisy image; name a filter or weights.")
        self._denoiser, self._params = model.denoiser, model.params
        self._step = jax.jit(model.denoiser.step)

    def run(self, frames: Frame, numbers: range, *, both: bool) -> Images:
        """The images of consecutive frames, with no history before and, with ``both`` directions, none after."""
        images, seen = self._run_one_way({number: frame_at(frames, number) for number in numbers})
        if both:
            reversed_frames = {
                number: reverse_time(
                    frame_at(frames, number), frame_at(frames, number + 1) if number + 1 in numbers else None
                )
                for number in reversed(numbers)
            }
            others, seen_by_others = self._run_one_way(reversed_frames)
            for number in numbers:
                blended = blend(images[number], others[number], seen[number], seen_by_others[number])
                images[number] = np.asarray(blended)
        return images

    def _run_one_way(self, frames: dict[int, Frame]) -> tuple[Images, Images]:
        """The images of frames in their order, and for how many frames each point had been seen."""
        state: Any = None
        length: HistoryLength | None = None
        images: Images = {}
        seen: Images = {}
        for number, frame in frames.items():
            state = self._denoiser.start(self._params, frame) if state is None else state
            state, image = self._step(self._params, state, frame)
            length = update_history_length(length, frame)
            images[number], seen[number] = np.asarray(image), np.asarray(length.number)
        return images, seen


def measure_joint(whole: Images, chunks: Sequence[Images], reference: Array, start: int) -> Joint:
    """The joint before frame ``start``, where the first chunk ends; ``reference`` [T, H, W, 3]."""
    one, other = (chunk[number] for chunk, number in zip(chunks, (start - 1, start), strict=True))
    found = {start - 1: one, start: other}
    change = reference[start] - reference[start - 1]
    flicker, usual = (np.abs(b - a - change).mean() for a, b in ((one, other), (whole[start - 1], whole[start])))
    differing = [n for n, image in chunks[1].items() if n >= start and not np.array_equal(image, whole[n])]
    equal_after = max(differing, default=start - 1) + 1 - start
    return Joint(
        float(max(np.abs(image - whole[n]).mean() / whole[n].mean() for n, image in found.items())),
        float(min(_psnr(image, reference[n]) - _psnr(whole[n], reference[n]) for n, image in found.items())),
        float(flicker / usual),
        equal_after if start + equal_after in chunks[1] else None,
    )


def _psnr(image: np.ndarray, reference: Array) -> float:
    return float(-10 * np.log10(np.mean((image / (1 + image) - reference / (1 + reference)) ** 2)))


def measure_shot(stepper: Stepper, clip: Clip, start: int, lead: int, whole: Images, *, both: bool) -> Joint:
    """The joint of a shot in two chunks that read ``lead`` frames of each other."""
    end = len(clip.reference)
    first = range(min(end, start + lead)) if both else range(start)
    second = range(max(0, start - lead), end)
    # Forwards the first chunk is the beginning of the whole shot.
    one = stepper.run(clip.frames, first, both=True) if both else whole
    other = stepper.run(clip.frames, second, both=both)
    return measure_joint(whole, [one, other], clip.reference, start)


def main(settings: Settings) -> None:
    """Measure, print, save."""
    end = settings.start + settings.after
    shots = make_shots(end, settings.size, settings.start) if settings.synthetic else {}
    for scene in settings.rendered:
        with tempfile.TemporaryDirectory() as folder:
            shots[name_shot(scene)] = render_shot(scene, Path(folder) / "clip", end, settings.size)
    rows = []
    for method in settings.methods:
        stepper = Stepper(find_model(method))
        for name, clip in shots.items():
            for both in (False, True):
                whole = stepper.run(clip.frames, range(end), both=both)
                for lead in settings.leads:
                    joint = measure_shot(stepper, clip, settings.start, lead, whole, both=both)
                    rows.append([method, name, "both" if both else "forwards", lead, *_tell(joint)])
                    print(*rows[-1], sep="  ", flush=True)
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(settings.out, _describe(settings, rows))


def _tell(joint: Joint) -> list[str | float]:
    equal = "never" if joint.equal_after is None else str(joint.equal_after)
    return [f"{100 * joint.difference:.2f} %", round(joint.psnr, 2) + 0.0, f"{joint.flicker:.2f}", equal]


def _describe(settings: Settings, rows: list[list[str | float]]) -> dict[str, object]:
    found = describe_measurement(
        *("table", "Where chunks join", "Sequences", 215),
        command="python -m experiments.stability.joints",
        what=f"A shot of {settings.start + settings.after} frames of {settings.size} x {settings.size} pixels in two "
        f"chunks, which join before frame {settings.start} and read so many frames of each other, against the shot in "
        "one piece. Of the two frames at the joint the worse: mean distance in shares of the light; PSNR (of "
        "x / (1 + x), in dB) minus the whole shot's. Then the change from one to the other beyond the reference's, "
        "relative to the whole shot's, and the number of frames from which on the second chunk is bit-equal. "
        f"The lamp goes out {LAMP_OUT} frames before the joint: a chunk that begins there has no history of the lamp, "
        f"which svgf drags along for a while. The cut comes {CUT} frames after it. The rendered shots have a "
        "reference of 128 samples.",
        rows=rows,
    )
    names = ("method", "shot", "directions", "read", "distance", "PSNR", "flicker", "bit-equal after")
    return {**found, "columns": [{"name": name} for name in names]}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
