"""Training on the devices of this machine: how fast on one and on several, its input, and what follows for more.

    python -m experiments.speed.devices        # five minutes; runs/devices.json

One step is timed on 1, 2, 4, ... devices, with the same number of clips on each. The real pipeline then reads clips
from the disk: CPU milliseconds an element with NumPy's variation and with that of the update, and how
long the loop waits for its batches. The model says what share of ideal speed communication leaves where no such
machine was at hand.
"""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import tyro

from experiments.measurement import describe_measurement
from experiments.speed.timing import measure
from experiments.speed.works import scene
from jaxdn.clips import training_batches, write_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.denoiser import Denoiser
from jaxdn.methods.registry import method_named
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.atomic_files import write_json
from jaxdn.training.devices import divide, make_mesh, put_on_all
from jaxdn.training.step import init_state, make_train_step

_REPEATED = 64
"""The few clips are a large set: to shuffle four numbers takes Grain 8 ms a number, to shuffle hundreds nothing."""


@dataclass
class Settings:
    """Measure training on this machine's devices."""

    method: str = "steady"
    variant: str = "steady-fast"
    batch: int = 8
    """Clips on each device."""
    crop: int = 112
    frames: int = 10
    budget: float = 240.0
    """Seconds for all timings; compilation comes on top."""
    elements: int = 64
    """Elements to read for the cost of the input."""
    out: Path = field(default_factory=lambda: Path("runs/devices.json"))


class Link(NamedTuple):
    """What connects devices."""

    name: str
    devices: int
    bandwidth: float
    """Bytes a second of each device, in each direction."""
    latency: float
    """Seconds of one message."""


LINKS = (
    Link("8 GPUs, 200 GB/s, 10 us", 8, 200e9, 10e-6),
    Link("8 GPUs, 25 GB/s, 20 us", 8, 25e9, 20e-6),
    Link("64 hosts, 25 GB/s, 20 us", 64, 25e9, 20e-6),
)
"""Assumed: NVLink, PCIe, and a fast network between hosts."""


def predict_efficiency(step_s: float, weights: int, link: Link) -> float:
    """The share of ideal speed that one exchange of gradients an update leaves, where input is ready and nobody late.

    A ring of n devices sends 2 (n - 1) messages, of 4 weights / n bytes each, one after the other (Patarasuk and Yuan
    2009); none of it is hidden behind the step.
    """
    messages = 2 * (link.devices - 1)
    exchange = messages * (4 * weights / link.devices / link.bandwidth + link.latency)
    return step_s / (step_s + exchange)


class Steps(NamedTuple):
    """The step of one method on several numbers of devices."""

    weights: int
    milliseconds: dict[int, float]
    """Median by the number of devices, each of which has as many clips."""


def time_steps(denoiser: Denoiser, recipe: Recipe, batch: Any, budget_s: float) -> Steps:
    """Updates on 1, 2, 4, ... devices, interleaved; ``batch`` is that of one device."""
    counts, calls, weights = [], {}, 0
    count = 1
    while count <= jax.local_device_count():
        counts.append(count)
        whole = jax.tree.map(lambda leaf, count=count: leaf.repeat(count, axis=0), batch)
        mesh = make_mesh(count, recipe.batch * count)
        state = [put_on_all(init_state(denoiser, recipe, batch), mesh)]
        weights = sum(leaf.size for leaf in jax.tree.leaves(state[0].params))
        step = make_train_step(denoiser, recipe._replace(batch=recipe.batch * count), mesh)
        there = divide(whole, mesh) if mesh else jax.device_put(whole)

        def update(state: Any = state, step: Any = step, there: Any = there) -> None:
            state[0], report = step(state[0], there)
            jax.block_until_ready(report)

        calls[f"{count}"] = update
        count *= 2
    timings = measure(calls, rounds=9, budget_s=budget_s)
    return Steps(weights, {count: timings[f"{count}"].median_ms for count in counts})


class Input(NamedTuple):
    """What an element of a batch costs before it is on a device."""

    cpu_ms: float
    """Of all threads together."""
    mib: float
    """To be sent to a device."""


def measure_input(place: Path, denoiser: Denoiser, recipe: Recipe, elements: int, *, vary_later: bool) -> Input:
    """CPU time and size of the elements that a recipe asks for, with or without NumPy's variation."""
    batches = _batches(place, denoiser, recipe, vary_later=vary_later, threads=0)
    next(batches)
    began, count = time.process_time(), max(1, elements // recipe.batch)
    for _ in range(count):
        batch = next(batches)
    spent = time.process_time() - began
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(batch)) / recipe.batch
    return Input(1e3 * spent / (count * recipe.batch), size / 2**20)


def measure_waiting(place: Path, denoiser: Denoiser, recipe: Recipe, devices: int, budget_s: float) -> float:
    """The share of the loop's time in which it has no batch, on so many devices, with as many clips on each."""
    whole = recipe._replace(batch=recipe.batch * devices)
    mesh = make_mesh(devices, whole.batch)
    batches = _batches(place, denoiser, whole, vary_later=True, threads=4)
    held = next(batches)
    state = put_on_all(init_state(denoiser, whole, held), mesh)
    step = make_train_step(denoiser, whole, mesh)
    state, report = step(state, divide(held, mesh))  # compiles
    jax.block_until_ready(report)
    waited, began = 0.0, time.perf_counter()
    while time.perf_counter() - began < budget_s:
        asked = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - asked
        state, report = step(state, divide(batch, mesh))
        jax.block_until_ready(report)
    return waited / (time.perf_counter() - began)


def _batches(place: Path, denoiser: Denoiser, recipe: Recipe, *, vary_later: bool, threads: int) -> Iterator[Any]:
    return training_batches(
        [place] * _REPEATED,
        buffers=denoiser.reads | recipe.objective.reads,
        batch=recipe.batch,
        crop=recipe.crop,
        frames=recipe.frames,
        seed=recipe.seed,
        variation=recipe.variation,
        vary_later=vary_later,
        threads=threads,
    )


def main(settings: Settings) -> None:
    """Measure, print, save."""
    method = method_named(settings.method)
    denoiser = method.factory(**(method.variant_named(settings.variant) if settings.variant else {}))
    recipe = method.recipe_named(None)._replace(
        batch=settings.batch, crop=settings.crop, frames=settings.frames, spp=(1,)
    )
    with tempfile.TemporaryDirectory() as folder:
        place, side = Path(folder) / "clips", settings.crop + settings.crop // 8
        for seed in range(4):
            write_clip(scene.clip(settings.frames + 2, side, side, seed=seed), place / f"clip-{seed}")
        before = measure_input(place, denoiser, recipe, settings.elements, vary_later=False)
        after = measure_input(place, denoiser, recipe, settings.elements, vary_later=True)
        held = next(_batches(place, denoiser, recipe, vary_later=True, threads=0))
        steps = time_steps(denoiser, recipe, held, settings.budget / 2)
        devices = max(steps.milliseconds)
        waiting = measure_waiting(place, denoiser, recipe, devices, settings.budget / 4)
    rows = _rows(settings, steps, before, after, waiting)
    for name, value in rows:
        print(f"{name}: {value}", flush=True)
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(settings.out, _describe(settings, rows))


def _rows(settings: Settings, steps: Steps, before: Input, after: Input, waiting: float) -> list[tuple[str, str]]:
    alone = steps.milliseconds[1]
    rows = []
    for count, taken in steps.milliseconds.items():
        speed = 1e3 * count * settings.batch * settings.frames / taken
        share = f", {alone / taken:.3f} of {count} times one" if count > 1 else ""
        rows.append(
            (f"step on {count} of {jax.local_device_count()} devices", f"{taken:.1f} ms, {speed:.0f} frames/s{share}")
        )
    needed = 1e3 * settings.batch / alone
    rows += [
        ("input, varied by NumPy", f"{before.cpu_ms:.1f} CPU ms and {before.mib:.2f} MiB an element"),
        ("input, varied in the update", f"{after.cpu_ms:.1f} CPU ms and {after.mib:.2f} MiB an element"),
        ("input for one device", f"{needed:.1f} elements/s: {needed * after.cpu_ms / 1e3:.2f} cores"),
        (f"waiting for input with {max(steps.milliseconds)} devices", f"{100 * waiting:.1f} % of the time"),
        ("exchanged an update", f"{4 * steps.weights / 1e6:.2f} MB, {steps.weights} weights"),
    ]
    for link in LINKS:
        left = predict_efficiency(alone / 1e3, steps.weights, link)
        rows.append((f"model, {link.name}", f"{left:.4f} of {link.devices} times one (not measured)"))
    return rows


def _describe(settings: Settings, rows: list[tuple[str, str]]) -> dict[str, Any]:
    found = describe_measurement(
        *("table", "Training on several devices", "Speed", 350),
        command="python -m experiments.speed.devices",
        what=f"{settings.variant or settings.method}, {settings.batch} clips of {settings.frames} frames, "
        f"{settings.crop} x {settings.crop}, on each device. Medians. Rows of the model assume that input is ready, "
        "that no device is late, and that nothing of the exchange is hidden.",
        rows=rows,
    )
    return {**found, "columns": [{"name": "what"}, {"name": "found"}]}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
