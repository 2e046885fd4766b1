"""The cost of rendering one frame: a part per sample, and fixed parts."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.speed.chart.energy import Meter
from experiments.speed.timing import measure
from jaxdn import effects
from jaxdn.core.frame import OF_SAMPLES
from jaxdn.render import AnimatedScene, render_frame
from jaxdn.render.settings import RenderSettings

SAMPLES = (1, 2, 4)
FRAME = 2
ROUNDS = 7


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


def fit(light: Mapping[int, float], more: Mapping[str, float]) -> Cost:
    """The cost from the times of frames without buffers, ``light`` (samples -> time), and what buffers add to them."""
    samples = np.asarray(sorted(light), float)
    slope, fixed = np.polyfit(samples, [light[int(spp)] for spp in samples], 1)
    # Measurement noise must not make the cost of a buffer, or of the scene, negative.
    return Cost(max(float(fixed), 0.0), max(float(slope), 0.0), {one: max(time, 0.0) for one, time in more.items()})


def measure_cost(
    scene: AnimatedScene, height: int, width: int, reads: Collection[str], there: Collection[str], meter: Meter | None
) -> dict[str, dict[str, Any]]:
    """``{"seconds": ..., "joules": ...}`` of a scene's frame at this size; joules only where there is a meter.

    ``reads`` are what denoisers read (:func:`named`), of which the clip has the buffers ``there``. Buffers that need no
    paths are measured without any: a path tracer's time varies by more than they take.
    """
    everything = effects.plan(effects.choose_all_effects(FRAME + 1))
    before = render_frame(scene, FRAME - 1, RenderSettings(width=width, height=height)).view

    def frame(spp: int, buffers: Sequence[str], *, paths: bool = True) -> Callable[[], Any]:
        plan = everything._replace(frames=(tuple(buffers),) * (FRAME + 1))
        plan = plan if paths else plan._replace(integrator="none")
        return lambda: render_frame(
            scene, FRAME, RenderSettings(width=width, height=height, layers=(spp,), plan=plan), previous=before
        )

    made = {one: [name for name in one.split(", ") if name in there and name in everything.buffers] for one in reads}
    calls = {f"light {spp}": frame(spp, ()) for spp in SAMPLES} | {"": frame(1, (), paths=False)}
    calls |= {named(buffers): frame(1, buffers, paths=_paths(buffers)) for buffers in made.values()}

    def fitted(found: Mapping[str, float]) -> dict[str, Any]:
        base = {True: found["light 1"], False: found[""]}
        more = {one: found[named(buffers)] - base[_paths(buffers)] for one, buffers in made.items()}
        return fit({spp: found[f"light {spp}"] for spp in SAMPLES}, more)._asdict()

    timings = measure(calls, rounds=ROUNDS, budget_s=120)
    costs = {"seconds": fitted({name: timing.median_ms / 1e3 for name, timing in timings.items()})}
    if meter is not None:
        costs["joules"] = fitted({name: meter.joules(call) for name, call in calls.items()})
    return costs


def _paths(buffers: Collection[str]) -> bool:
    """Whether some of the buffers are made of paths."""
    return bool({"luminance_gradient", *OF_SAMPLES} & set(buffers))


def mean_cost(costs: Sequence[Mapping[str, Any]]) -> Cost:
    """The mean over scenes."""
    fixed, sample = (float(np.mean([cost[name] for cost in costs])) for name in ("fixed", "sample"))
    reads = costs[0]["buffers"]
    return Cost(fixed, sample, {one: float(np.mean([cost["buffers"][one] for cost in costs])) for one in reads})
