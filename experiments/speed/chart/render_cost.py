"""The cost of rendering one frame: a part per sample, and fixed parts."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.speed.chart.energy import Meter
from experiments.speed.timing import measure
from jaxdn import effects
from jaxdn.render import AnimatedScene, render_frame

SAMPLES = (1, 2, 4)
FRAME = 2


class Cost(NamedTuple):
    """Seconds, or joules, of one rendered frame."""

    fixed: float
    """Building the scene."""
    sample: float
    """One sample per pixel."""
    buffers: Mapping[str, float]
    """What a denoiser reads (:func:`named`) -> the buffers that the renderer makes for it."""

    def at(self, spp: float, reads: str = "") -> float:
        """The cost of a frame with ``spp`` samples and the buffers of a denoiser."""
        return self.fixed + self.sample * spp + (self.buffers[reads] if reads else 0.0)


def named(reads: Collection[str]) -> str:
    """The buffers that a denoiser reads besides radiance, as one name: "albedo, normal"."""
    return ", ".join(sorted(reads))


def fit(light: Mapping[int, float], buffers: Mapping[str, float]) -> Cost:
    """The cost from the times of frames: ``light`` (samples -> without buffers), and 1 sample with ``buffers``."""
    samples = np.asarray(sorted(light), float)
    slope, fixed = np.polyfit(samples, [light[int(spp)] for spp in samples], 1)
    # Measurement noise must not make the cost of a buffer, or of the scene, negative.
    more = {reads: max(seconds - light[1], 0.0) for reads, seconds in buffers.items()}
    return Cost(max(float(fixed), 0.0), max(float(slope), 0.0), more)


def measure_cost(
    scene: AnimatedScene, height: int, width: int, reads: Collection[str], there: Collection[str], meter: Meter | None
) -> dict[str, dict[str, Any]]:
    """``{"seconds": ..., "joules": ...}`` of a scene's frame at this size; joules only where there is a meter.

    ``reads`` are what denoisers read (:func:`named`), of which the clip has the buffers ``there``.
    """
    everything = effects.plan(effects.everything(FRAME + 1))
    before = render_frame(scene, FRAME - 1, width=width, height=height).view

    def frame(spp: int, buffers: Sequence[str]) -> Callable[[], Any]:
        plan = everything._replace(frames=(tuple(buffers),) * (FRAME + 1))
        return lambda: render_frame(scene, FRAME, width=width, height=height, layers=(spp,), previous=before, plan=plan)

    made = {one: [name for name in one.split(", ") if name in there and name in everything.buffers] for one in reads}
    calls = {f"light {spp}": frame(spp, ()) for spp in SAMPLES}
    calls |= {named(buffers): frame(1, buffers) for buffers in made.values() if buffers}
    names = {one: named(buffers) or "light 1" for one, buffers in made.items()}
    seconds = {name: timing.median_ms / 1e3 for name, timing in measure(calls, rounds=3, budget_s=90).items()}
    costs = {"seconds": _fitted(seconds, names)._asdict()}
    if meter is not None:
        joules = {name: meter.joules(call) for name, call in calls.items()}
        costs["joules"] = _fitted(joules, names)._asdict()
    return costs


def _fitted(found: Mapping[str, float], names: Mapping[str, str]) -> Cost:
    light = {spp: found[f"light {spp}"] for spp in SAMPLES}
    return fit(light, {one: found[name] for one, name in names.items()})


def mean_cost(costs: Sequence[Mapping[str, Any]]) -> Cost:
    """The mean over scenes."""
    fixed, sample = (float(np.mean([cost[name] for cost in costs])) for name in ("fixed", "sample"))
    reads = costs[0]["buffers"]
    return Cost(fixed, sample, {one: float(np.mean([cost["buffers"][one] for cost in costs])) for one in reads})
