"""The cost of repair: the same step with and without the repair of frames and histories, at 1280 x 720.

    python -m experiments.stability.protection      # runs/protection.json

Both programs run interleaved in one process, so that other load affects both. The result is the median of the ratios of
all pairs, for wall time and for CPU time, which other load affects less. The program without repair lacks every
``repair`` and ``repair_image`` of :mod:`jaxdn.denoiser.sanitize` that a denoiser calls. The safe powers and lengths of
:mod:`jaxdn.core.numerics` are part of both: without them gradients would not be finite.
"""

import contextlib
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import BUFFERS, Buffer, Frame
from jaxdn.denoiser.sanitize import repair, repair_image
from jaxdn.methods.registry import Method, methods
from jaxdn.runtime.atomic_files import write_json

_RANGES = {
    "light": (0.0, 2.0),
    "signed": (-1.0, 1.0),
    "fraction": (0.1, 0.9),
    "direction": (-1.0, 1.0),
    "distance": (1.0, 9.0),
    "vector": (-3.0, 3.0),
    "count": (1.0, 9.0),
    "flag": (0.0, 1.0),
    "id": (0.0, 9.0),
}
"""Lowest and highest value of each kind of buffer; of a direction, before it is normalised."""

Subject = tuple[Method, Mapping[str, Any]]
"""A row of the table of methods, and options."""


def subjects() -> dict[str, Subject]:
    """Filters with their default options, and each variant of the learned methods, by name."""
    found: dict[str, Subject] = {}
    for name, method in methods().items():
        found |= {variant: (method, options) for variant, options in (method.variants or {name: {}}).items()}
    return found


@dataclass
class Settings:
    """Time a step with and without repair."""

    subjects: tuple[str, ...] = field(default_factory=lambda: tuple(subjects()))
    pairs: int = 15
    height: int = 720
    width: int = 1280
    out: Path = Path("runs/protection.json")


def frame_of(reads: Collection[str], height: int, width: int) -> Frame:
    """A valid noisy frame with every buffer in ``reads``."""
    rng = np.random.default_rng(0)

    def drawn(buffer: Buffer) -> np.ndarray:
        low, high = _RANGES[buffer.kind]
        values = rng.uniform(low, high, (height, width, buffer.channels))
        if buffer.kind == "direction":
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        return values.astype(buffer.dtype)

    return Frame(**{name: drawn(buffer) for name, buffer in BUFFERS.items() if name == "radiance" or name in reads})


@contextlib.contextmanager
def unprotected() -> Iterator[None]:
    """Inside this context denoisers are traced without repair."""
    kept = {"repair": repair, "repair_image": repair_image}
    neutral: dict[str, Callable[..., Any]] = {
        "repair": lambda frame: (frame, jnp.zeros((), jnp.int32)),
        "repair_image": lambda image: image,
    }
    modules = [module for name, module in sys.modules.items() if name.startswith("jaxdn.")]
    places = [(module, name) for module in modules for name in kept if vars(module).get(name) is kept[name]]
    try:
        for module, name in places:
            setattr(module, name, neutral[name])
        yield
    finally:
        for module, name in places:
            setattr(module, name, kept[name])


def stepper(subject: Subject, height: int, width: int) -> Callable[[], None]:
    """A function that runs the next step, compiled with repair unless inside :func:`unprotected`."""
    method, options = subject
    denoiser = method.factory(**options)  # a new one each time: jax would reuse an old trace
    frame = jax.tree.map(jnp.asarray, frame_of(denoiser.reads, height, width))
    params = denoiser.init(jax.random.key(0), frame)
    states = [jax.tree.map(jnp.copy, denoiser.start(params, frame))]  # a buffer cannot be donated twice
    step = jax.jit(denoiser.step, donate_argnums=1).lower(params, states[0], frame).compile()

    def run() -> None:
        states[0], image = step(params, states[0], frame)
        image.block_until_ready()

    return run


def seconds(run: Callable[[], None]) -> tuple[float, float]:
    """Wall time of one call, and CPU time of all its threads."""
    wall, busy = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - wall, time.process_time() - busy


def measure(subject: Subject, pairs: int, *, height: int, width: int) -> dict[str, Any]:
    """Median times of both programs and the median of their ratios, with its quartiles."""
    with_it = stepper(subject, height, width)
    with unprotected():
        without = stepper(subject, height, width)
    for run in (with_it, without):
        run()
        run()
    times = np.array([  # [pairs, (with, without), (wall, CPU)]
        [seconds(with_it), seconds(without)] if pair % 2 else [seconds(without), seconds(with_it)][::-1]
        for pair in range(pairs)
    ])  # fmt: skip
    ratios = times[:, 0] / times[:, 1]  # [pairs, (wall, CPU)]
    (protected, busy), (bare, _) = np.median(times, axis=0)
    low, middle, high = np.percentile(ratios, (25, 50, 75), axis=0).round(4).tolist()
    return {
        "ms protected": round(1e3 * float(protected), 2),
        "ms without": round(1e3 * float(bare), 2),
        "ms of CPU time": round(1e3 * float(busy), 2),
        "ratio": middle[0],
        "ratio, quartiles": [low[0], high[0]],
        "ratio of CPU time": middle[1],
        "ratio of CPU time, quartiles": [low[1], high[1]],
        "pairs": pairs,
    }


def main(settings: Settings) -> None:
    """Measure all subjects and write the results."""
    size = {"height": settings.height, "width": settings.width}
    known = subjects()
    unknown = [name for name in settings.subjects if name not in known]
    if unknown:
        raise ValueError(f"subjects: expected some of {', '.join(known)}, got {', '.join(map(repr, unknown))}.")
    costs: dict[str, Any] = {**size, "device": str(jax.devices()[0])}
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    for name in settings.subjects:
        costs[name] = measure(known[name], settings.pairs, **size)
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in costs[name].items()), flush=True)
        write_json(settings.out, costs)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
