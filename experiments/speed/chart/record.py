"""The front of the chart as a measurement for the page of results (:mod:`experiments.measurement`)."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from experiments.measurement import describe_measurement
from experiments.speed.chart.footage import SCORED
from experiments.speed.chart.scores import Measure
from experiments.speed.chart.summary import RENDERER, Equal, Point, in_words
from experiments.speed.chart.way import PLAIN


class Measured(NamedTuple):
    """What a run has measured."""

    clips: int
    """Their number."""
    size: str
    """Theirs, such as "64x64"."""
    timed: str
    """That of the frame that is timed."""
    most: int
    """Samples of the renderer's last point."""
    methods: Sequence[str]
    """The rows that were asked for; empty for all."""


def record_front(
    front: Sequence[Point], equals: Mapping[str, Equal], quality: Sequence[Measure], run: Measured
) -> dict[str, Any]:
    """A row for each point of ``front``, by rising time; ``quality`` is shown, and what the bare renderer needs."""
    rows = [
        [
            _name(point),
            f"{point.spp:g}",
            round(point.milliseconds(run.timed, render=bool(point.render_ms))),
            None if point.method == RENDERER else round(point.denoise_ms[run.timed]),
            *(round(point.errors[measure.field], 2) for measure in quality),
            None if (equal := equals.get(point.key)) is None else in_words(equal, run.most),
        ]
        for point in front
    ]
    some = ", some methods" if run.methods else ""
    what = (
        f"The Pareto front of error against time, rendering included: {run.clips} clips of the families, {run.size}, "
        f"last {SCORED} frames; times of a {run.timed} frame. Every method is charged for the buffers that it reads. "
        "With less than one sample a pixel some pixels have one, in a pattern that rotates; the rendering of such "
        "frames was timed."
    )
    command = ["python", "-m", "experiments.speed.chart", *(["--methods"] if run.methods else []), *run.methods]
    order = 320.5 if run.methods else 320
    described = describe_measurement(
        "table", f"Error against time{some}", "Speed", order, command=shlex.join(command), what=what, rows=rows
    )
    plain = ("method", "samples", "ms, rendering included", "ms, denoising")
    columns: list[dict[str, Any]] = [{"name": name} for name in plain]
    columns += [{"name": measure.label, "decimals": 2} for measure in quality]
    return {**described, "columns": [*columns, {"name": "as good as the renderer alone with"}]}


def _name(point: Point) -> str:
    if point.method == RENDERER:
        return "the renderer alone"
    return f"`{point.family}`" + ("" if point.variant == PLAIN else f", {point.variant}")
