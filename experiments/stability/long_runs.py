"""Thousands of frames: is each denoiser's recurrent state bounded, does it drift, and does it forget invalid frames?

    python -m experiments.stability.long_runs      # curves.json and curves.png in runs/long-runs/

Three runs of 2,000 frames for each method: a static camera; a clip played back and forth; and the same with one
*poisoned* frame in the middle, in which every value is NaN or 1e30. Per frame: the largest magnitude in the state, the
error of the output against the noise-free image, and, for a poisoned run, its distance from the clean one.
"""

import functools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax

from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Denoiser
from jaxdn.denoiser.rollout import render_requested
from jaxdn.runtime.atomic_files import write_atomically
from jaxdn.zoo.ready import NOISY, all_names, find_model

SIZE, TURN = 48, 16
"""Width and height in pixels, and frames after which the clip is reversed."""
POISONS = {"NaN": float("nan"), "1e30": 1e30}
LAYERS = (1, 2, 4, 8)
"""Samples per pixel of the layers, for denoisers that request samples."""


@dataclass
class Settings:
    """Denoise thousands of frames and record curves."""

    methods: tuple[str, ...] = field(default_factory=lambda: tuple(name for name in all_names() if name != NOISY))
    """Filters, and names or paths of weights; default: all that are shipped."""
    frames: int = 2000
    out: Path = Path("runs/long-runs")


class Curves(NamedTuple):
    """One value per frame of one run."""

    state: np.ndarray
    """Largest magnitude in the recurrent state, except its counters."""
    error: np.ndarray
    """Mean absolute error against the noise-free image, relative to its mean."""
    healthy: np.ndarray
    """Whether state and image are finite."""
    sample: np.ndarray
    """[frames, 6, 6, 3] every eighth pixel of the output."""


def _world(columns: jax.Array, rows: jax.Array) -> Frame:
    """A textured wall behind a nearer, brighter square, noise-free."""
    inside = ((columns > 20) & (columns < 34) & (rows > 14) & (rows < 30))[..., None]
    texture = jnp.stack([0.5 + 0.3 * jnp.sin(columns / 3), 0.5 + 0 * rows, 0.6 + 0.2 * jnp.cos(rows / 5)], axis=-1)
    albedo = jnp.where(inside, 0.8, texture)
    normal = jnp.where(inside, jnp.asarray([0.0, 0.6, 0.8]), jnp.asarray([0.0, 0.0, 1.0]))
    one = jnp.ones((*columns.shape, 1))
    depth = jnp.where(inside, 2.0, 4.0) * one
    return Frame(0.6 * albedo, albedo=albedo, normal=normal, depth=depth, ids=jnp.where(inside, 1, 0))


def compiled(denoiser: Denoiser, params: Any, frames: int) -> Callable[[Any], Any]:
    """(speed, poison, frame poisoned) -> the values of :class:`Curves`."""
    rows, columns = jnp.mgrid[:SIZE, :SIZE].astype(jnp.float32)

    def seen_at(offset: jax.Array) -> Frame:
        return _world(columns + offset, rows)

    def layers(noisy: jax.Array, clean: Frame) -> dict[int, jax.Array] | None:
        if denoiser.samples is None:
            return None
        return {samples: clean.radiance + (noisy - clean.radiance) / samples**0.5 for samples in LAYERS}

    def body(settings: Any, state: Any, index: jax.Array) -> tuple[Any, Any]:
        speed, poison, poisoned = settings
        forwards = (index // TURN) % 2 == 0
        phase = index % TURN
        offset = speed * jnp.where(forwards, phase, TURN - 1 - phase).astype(jnp.float32)
        moved = jnp.where(phase == 0, 0.0, jnp.where(forwards, speed, -speed))
        clean = seen_at(offset)
        noise = jax.random.exponential(jax.random.fold_in(jax.random.key(1), index), (SIZE, SIZE, 1))
        noisy = jnp.where(index == poisoned, poison, clean.radiance * noise)
        motion = jnp.broadcast_to(jnp.stack([moved, jnp.zeros(())]), (SIZE, SIZE, 2))
        frame = clean._replace(radiance=noisy, motion=motion)
        state, image = denoiser.step(
            params, state, render_requested(denoiser, params, state, frame, layers(noisy, clean))
        )
        leaves = [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
        largest = jnp.max(jnp.stack([jnp.zeros(()), *(jnp.max(jnp.abs(leaf), initial=0.0) for leaf in leaves)]))
        error = jnp.mean(jnp.abs(image - clean.radiance)) / jnp.mean(clean.radiance)
        return state, (largest, error, jnp.isfinite(largest) & jnp.isfinite(image).all(), image[::8, ::8])

    def run(settings: Any) -> Any:
        first = seen_at(jnp.zeros(()))
        start = denoiser.start(params, first._replace(motion=jnp.zeros((SIZE, SIZE, 2))))
        return lax.scan(functools.partial(body, settings), start, jnp.arange(frames))[1]

    return jax.jit(run)


def recovery(clean: Curves, poisoned: Curves, at: int) -> int:
    """Frames from the poisoned one until the output stays within 1 % of the clean run's mean level."""
    bad = np.flatnonzero(distance(clean, poisoned) > 0.01)
    return int(bad.max()) + 1 - at if bad.size else 0


def distance(clean: Curves, poisoned: Curves) -> np.ndarray:
    """Per frame the largest difference of the samples, relative to the clean run's mean."""
    apart = np.abs(poisoned.sample - clean.sample).max(axis=(1, 2, 3))
    return np.asarray(apart / np.abs(clean.sample).mean(axis=(1, 2, 3)))


def examine(name: str, frames: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """All runs of one method: their results and curves."""
    method = find_model(name)
    if method.denoiser is None:
        raise ValueError(f"method {name!r}: expected a denoiser, got the noisy image itself.")
    run = compiled(method.denoiser, method.params, frames)
    at = frames // 2

    def curves(speed: float, poison: float = 0.0, poisoned: int = -1) -> Curves:
        return Curves(*map(np.asarray, run((jnp.float32(speed), jnp.float32(poison), jnp.int32(poisoned)))))

    runs = {"static": curves(0.0), "back and forth": curves(0.7)}
    runs |= {label: curves(0.7, poison, at) for label, poison in POISONS.items()}
    outcome: dict[str, Any] = {}
    lines: dict[str, np.ndarray] = {}
    for label, found in runs.items():
        level = {"early": found.error[frames // 20 : frames // 5].mean(), "late": found.error[-frames // 10 :].mean()}
        outcome[label] = {key: round(float(value), 4) for key, value in level.items()}
        outcome[label] |= {"largest state": float(found.state.max()), "healthy": bool(found.healthy.all())}
        lines |= {f"{label}, state": found.state, f"{label}, error": found.error}
    for label in POISONS:
        outcome[label]["frames to within 1 %"] = recovery(runs["back and forth"], runs[label], at)
        lines[f"{label}, distance"] = distance(runs["back and forth"], runs[label])
    return outcome, lines


def draw(curves: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """State and error over all frames, and the frames around the poisoned one, a row for each method."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(curves), 3, figsize=(15, 3.2 * len(curves)), squeeze=False, layout="constrained")
    for row, (name, lines) in zip(axes, curves.items(), strict=True):
        for label in ("static", "back and forth"):
            row[0].plot(lines[f"{label}, state"], label=label, linewidth=0.8)
            row[1].plot(lines[f"{label}, error"], label=label, linewidth=0.8)
        for label in POISONS:
            apart = lines[f"{label}, distance"]
            at = len(apart) // 2
            row[2].plot(np.arange(-10, 150), np.maximum(apart[at - 10 : at + 150], 1e-7), label=label)
        row[2].axhline(0.01, color="grey", linewidth=0.8, linestyle="--", label="1 %")
        titles = ("largest value in the state", "error of the output", "distance after a poisoned frame")
        for axis, title in zip(row, titles, strict=True):
            axis.set(yscale="log", title=f"{name}: {title}", xlabel="frame")
            axis.legend(fontsize="small")
    figure.savefig(path, dpi=90)


def main(settings: Settings) -> None:
    """Run all methods, write curves.json and curves.png, print the results."""
    settings.out.mkdir(parents=True, exist_ok=True)
    outcomes: dict[str, Any] = {}
    curves: dict[str, dict[str, np.ndarray]] = {}
    for name in settings.methods:
        began = time.monotonic()
        outcomes[name], curves[name] = examine(name, settings.frames)
        print(f"{name} ({time.monotonic() - began:.0f} s)", flush=True)
        for label, facts in outcomes[name].items():
            print(f"  {label}: " + ", ".join(f"{key} {value}" for key, value in facts.items()), flush=True)
    per_frame = {
        name: {label: [float(f"{value:.5g}") for value in line] for label, line in lines.items()}
        for name, lines in curves.items()
    }
    report = {"frames": settings.frames, "size": SIZE, "methods": outcomes, "curves": per_frame}
    write_atomically({settings.out / "curves.json": json.dumps(report) + "\n"})
    draw(curves, settings.out / "curves.png")
    print(f"{settings.out / 'curves.json'}, {settings.out / 'curves.png'}")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
