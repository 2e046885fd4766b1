"""What protection costs: the same step with and without the repair of frames and histories, at 1280 x 720.

    python -m experiments.stability.protection      # runs/protection.json

Both programs run in one process in turn, so that whatever else the machine does falls on both; each pair gives a ratio
and the median of the ratios counts, of wall time and of the processors' time, which others disturb less. What is taken
away is every ``repair`` and ``repair_image`` that a denoiser calls. The safe powers and lengths of
:mod:`jaxdn.numerics` are part of both: without them there is no gradient to speak of.
"""

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxdn
from jaxdn.commands.errors import told_plainly
from jaxdn.frame import Frame

SUBJECTS: dict[str, dict[str, Any]] = {
    "svgf": {"factory": "svgf"},
    "ntd small": {"factory": "ntd", "size": "small"},
    "ntd large": {"factory": "ntd", "size": "large"},
}


@dataclass
class Settings:
    """Time a step with and without its protection."""

    subjects: tuple[str, ...] = field(default_factory=lambda: tuple(SUBJECTS))
    pairs: int = 15
    height: int = 720
    width: int = 1280
    out: Path = Path("runs/protection.json")


def frame_of(height: int, width: int) -> Frame:
    """A noisy frame with every buffer that the subjects read, and nothing wrong in it."""
    rng = np.random.default_rng(0)

    def made(low: float, high: float, channels: int) -> np.ndarray:
        return rng.uniform(low, high, (height, width, channels)).astype(np.float32)

    normal = made(-1, 1, 3)
    motion = made(-3, 3, 2)
    return Frame(
        radiance=made(0, 2, 3),
        albedo=made(0.1, 0.9, 3),
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        depth=made(1, 9, 1),
        motion=motion,
        dual_motion=motion,
        ids=rng.integers(0, 9, (height, width, 1), np.int32),
    )


@contextlib.contextmanager
def unprotected() -> Iterator[None]:
    """While this lasts, denoisers are traced without repair."""
    neutral: dict[str, Callable[..., Any]] = {
        "repair": lambda frame: (frame, jnp.zeros((), jnp.int32)),
        "repair_image": lambda image: image,
    }
    modules = [module for name, module in sys.modules.items() if name.startswith("jaxdn.denoisers.")]
    places = [(module, name) for module in modules for name in neutral if hasattr(module, name)]
    kept = [(module, name, getattr(module, name)) for module, name in places]
    try:
        for module, name in places:
            setattr(module, name, neutral[name])
        yield
    finally:
        for module, name, function in kept:
            setattr(module, name, function)


def stepper(options: dict[str, Any], frame: Frame) -> Callable[[], None]:
    """A function that takes one step further, compiled under whatever protection there is now."""
    options = dict(options)
    denoiser = getattr(jaxdn.denoisers, options.pop("factory"))(**options)
    params = denoiser.init(jax.random.key(0), frame)
    states = [jax.tree.map(jnp.copy, denoiser.start(params, frame))]  # what is donated must not be given twice
    step = jax.jit(denoiser.step, donate_argnums=1).lower(params, states[0], frame).compile()

    def run() -> None:
        states[0], image = step(params, states[0], frame)
        image.block_until_ready()

    return run


def seconds(run: Callable[[], None]) -> tuple[float, float]:
    """Wall time of one call, and processor time of all its threads."""
    wall, busy = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - wall, time.process_time() - busy


def measure(options: dict[str, Any], frame: Frame, pairs: int) -> dict[str, Any]:
    """Median times of both programs and the median of their ratios, with its quartiles."""
    with_it = stepper(options, frame)
    with unprotected():
        without = stepper(options, frame)
    for run in (with_it, without):
        run()
        run()
    times = np.array([  # [pairs, (with, without), (wall, processors)]
        [seconds(with_it), seconds(without)] if pair % 2 else [seconds(without), seconds(with_it)][::-1]
        for pair in range(pairs)
    ])  # fmt: skip
    ratios = times[:, 0] / times[:, 1]  # [pairs, (wall, processors)]
    (protected, busy), (bare, _) = np.median(times, axis=0)
    low, middle, high = np.percentile(ratios, (25, 50, 75), axis=0).round(4).tolist()
    return {
        "ms protected": round(1e3 * float(protected), 2),
        "ms without": round(1e3 * float(bare), 2),
        "ms of processors": round(1e3 * float(busy), 2),
        "ratio": middle[0],
        "ratio, quartiles": [low[0], high[0]],
        "ratio of processor time": middle[1],
        "ratio of processor time, quartiles": [low[1], high[1]],
        "pairs": pairs,
    }


def main(settings: Settings) -> None:
    """Measure all subjects and write what they cost."""
    frame = jax.tree.map(jnp.asarray, frame_of(settings.height, settings.width))
    told: dict[str, Any] = {"width": settings.width, "height": settings.height, "device": str(jax.devices()[0])}
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    for name in settings.subjects:
        told[name] = measure(SUBJECTS[name], frame, settings.pairs)
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in told[name].items()), flush=True)
        settings.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    with told_plainly():
        main(tyro.cli(Settings, description=Settings.__doc__))
