"""The cost of rendering one frame: a part per sample, and fixed parts."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.speed.chart.energy import Meter
from experiments.speed.timing import measure
from jaxdn import effects
from jaxdn.render import AnimatedScene, render_frame

SAMPLES = (1, 2, 4)
FRAME = 2
FEATURES = frozenset({"albedo", "normal"})


class Cost(NamedTuple):
    """Seconds, or joules, of one rendered frame."""

    fixed: float
    """Building the scene."""
    sample: float
    """One sample per pixel."""
    features: float
    """Albedo, normals, depth."""
    motion: float
    """Motion vectors, dual motion vectors and visibility."""

    def at(self, spp: float, guides: str = "none") -> float:
        """The cost of a frame with ``spp`` samples and the buffers that "features" or "motion" stand for."""
        extra = {"none": 0.0, "features": self.features, "motion": self.features + self.motion}[guides]
        return self.fixed + self.sample * spp + extra


def fit(light: Mapping[int, float], features: float, motion: float) -> Cost:
    """The cost from the times of frames: ``light`` (samples -> without buffers), and 1 sample with more buffers."""
    samples = np.asarray(sorted(light), float)
    slope, fixed = np.polyfit(samples, [light[int(spp)] for spp in samples], 1)
    slope = max(float(slope), 0.0)
    # Measurement noise must not make the cost of a buffer, or of the scene, negative.
    return Cost(max(float(fixed), 0.0), slope, max(features - light[1], 0.0), max(motion - features, 0.0))


def measure_cost(scene: AnimatedScene, height: int, width: int, meter: Meter | None) -> dict[str, dict[str, float]]:
    """``{"seconds": ..., "joules": ...}`` of a scene's frame at this size; joules only where there is a meter."""
    everything = effects.plan(effects.everything(FRAME + 1))
    before = render_frame(scene, FRAME - 1, width=width, height=height).view

    def frame(spp: int, buffers: Sequence[str]) -> Callable[[], Any]:
        plan = everything._replace(frames=(tuple(buffers),) * (FRAME + 1))
        return lambda: render_frame(scene, FRAME, width=width, height=height, layers=(spp,), previous=before, plan=plan)

    calls = {f"light {spp}": frame(spp, ()) for spp in SAMPLES}
    calls |= {"features": frame(1, tuple(FEATURES)), "motion": frame(1, everything.buffers)}
    seconds = {name: timing.median_ms / 1e3 for name, timing in measure(calls, rounds=3, budget_s=40).items()}
    costs = {"seconds": _fitted(seconds)._asdict()}
    if meter is not None:
        costs["joules"] = _fitted({name: meter.joules(call) for name, call in calls.items()})._asdict()
    return costs


def _fitted(found: Mapping[str, float]) -> Cost:
    return fit({spp: found[f"light {spp}"] for spp in SAMPLES}, found["features"], found["motion"])


def mean_cost(costs: Sequence[Mapping[str, float]]) -> Cost:
    """The mean over scenes."""
    return Cost(*(float(np.mean([cost[name] for cost in costs])) for name in Cost._fields))
