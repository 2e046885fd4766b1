"""The cost of rendering one frame: a part per sample, and fixed parts."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.speed.chart.energy import Meter
from experiments.speed.timing import measure
from jaxdn import effects
from jaxdn.core.frame import OF_SAMPLES
from jaxdn.ops.sampling import allot_evenly
from jaxdn.render import AnimatedScene, render_frame
from jaxdn.render.adaptive import render_sampled
from jaxdn.render.settings import RenderSettings

SAMPLES = (1, 2, 4)
FRACTIONS = (0.25, 0.5)
"""Samples per pixel of frames with gaps."""
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
    sparse: Mapping[str, float] = {}
    """Less than one sample per pixel, as in "0.25" -> a frame of which so many pixels have one, without buffers."""

    def at(self, spp: float, reads: str = "") -> float:
        """The cost of a frame with ``spp`` samples and the buffers of a denoiser."""
        light = self.sparse.get(f"{spp:g}", self.fixed + self.sample * spp)
        return light + (self.buffers[reads] if reads else 0.0)


def named(reads: Collection[str]) -> str:
    """The buffers that a denoiser reads besides radiance, as one name: "albedo, normal"."""
    return ", ".join(sorted(reads))


def fit(light: Mapping[int, float], more: Mapping[str, float], sparse: Mapping[str, float]) -> Cost:
    """The cost from the times of frames without buffers, ``light`` (samples -> time), and what buffers add to them."""
    samples = np.asarray(sorted(light), float)
    slope, fixed = np.polyfit(samples, [light[int(spp)] for spp in samples], 1)
    # Measurement noise must not make the cost of a buffer, or of the scene, negative.
    buffers = {one: max(time, 0.0) for one, time in more.items()}
    return Cost(max(float(fixed), 0.0), max(float(slope), 0.0), buffers, sparse)


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

    def gaps(budget: float) -> Callable[[], Any]:
        plan = everything._replace(frames=((),) * (FRAME + 1))
        settings = RenderSettings(width=width, height=height, plan=plan)
        counts = np.asarray(allot_evenly(budget, height, width, FRAME))
        return lambda: render_sampled(scene, FRAME, lambda _: counts, settings, previous=before, sample_first=False)

    made = {one: [name for name in one.split(", ") if name in there and name in everything.buffers] for one in reads}
    calls = {f"light {spp}": frame(spp, ()) for spp in SAMPLES} | {"": frame(1, (), paths=False)}
    calls |= {f"gaps {budget:g}": gaps(budget) for budget in FRACTIONS}
    calls |= {named(buffers): frame(1, buffers, paths=_paths(buffers)) for buffers in made.values()}

    def fitted(found: Mapping[str, float]) -> dict[str, Any]:
        base = {True: found["light 1"], False: found[""]}
        more = {one: found[named(buffers)] - base[_paths(buffers)] for one, buffers in made.items()}
        sparse = {f"{budget:g}": found[f"gaps {budget:g}"] for budget in FRACTIONS}
        return fit({spp: found[f"light {spp}"] for spp in SAMPLES}, more, sparse)._asdict()

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
    buffers, sparse = (
        {one: float(np.mean([cost[name][one] for cost in costs])) for one in costs[0][name]}
        for name in ("buffers", "sparse")
    )
    return Cost(fixed, sample, buffers, sparse)
