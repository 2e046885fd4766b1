"""Evaluation of the raw measurements: points, the Pareto front, and the time of bare rendering for equal quality."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.speed.chart.render_cost import Cost, mean_cost
from experiments.speed.chart.scores import MEASURES, Measure
from experiments.speed.chart.way import ALL

RENDERER = "renderer"


class Point(NamedTuple):
    """One method at one number of samples."""

    key: str
    method: str
    family: str
    variant: str
    reads: str
    """The buffers that it needs of the renderer besides radiance."""
    spp: float | None
    """None where only the time is known."""
    errors: Mapping[str, float]
    """Measure -> mean over clips."""
    denoise_ms: Mapping[str, float]
    """Size -> milliseconds per frame, 0 for the renderer alone."""
    render_ms: Mapping[str, float]
    """Size -> milliseconds of rendering the input frame (with one sample if ``spp`` is None); empty if not known."""

    def milliseconds(self, size: str, *, render: bool) -> float:
        """Per frame; NaN if not known."""
        rendered = self.render_ms.get(size, math.nan) if render else 0.0
        return self.denoise_ms.get(size, math.nan) + rendered


def headline(points: Sequence[Point]) -> tuple[Measure, Measure]:
    """PSNR and temporal PSNR as the chart is to be read: without the noise of the references wherever that is known.

    The plain ones saturate at the noise of the reference: there, twice the samples no longer look better.
    """
    by_field = {measure.field: measure for measure in MEASURES}
    fields = ("unbiased_psnr", "unbiased_temporal_psnr")
    scored = [point for point in points if point.spp]
    if any(math.isnan(point.errors.get(field, math.nan)) for point in scored for field in fields):
        fields = ("psnr", "temporal_psnr")
    return by_field[fields[0]], by_field[fields[1]]


class Equal(NamedTuple):
    """What the bare renderer needs for the quality of a point."""

    spp: float
    """0 below one sample, infinite beyond the largest rendered number."""
    seconds: float
    """Per frame at the timed size; NaN if the time of rendering is not known."""


def points(data: Mapping[str, Any], labels: Mapping[str, tuple[str, str, str]]) -> list[Point]:
    """The points of the raw data; ``labels``: method -> (family, variant, what it reads).

    Methods without a label are left out: they were measured with an installation that is no longer there.
    """
    costs = {size: render_cost(data, size) for size in data["render"]}
    found = []
    for key, clips in data["errors"].items():
        method, _, spp = key.rpartition(" @ ")
        if method not in labels:
            continue
        family, variant, reads = labels[method]
        errors = {measure.field: _mean([scores[measure.field] for scores in clips.values()]) for measure in MEASURES}
        rendered = {size: 1e3 * cost.at(float(spp), reads) for size, cost in costs.items() if cost}
        times = {size: timing["median_ms"] for size, timing in data["times"].get(method, {}).items()}
        if method == RENDERER:
            times = dict.fromkeys(rendered, 0.0)
        found.append(Point(key, method, family, variant, reads, float(spp), errors, times, rendered))
    scored = {point.method for point in found}
    for method, sizes in data["times"].items():
        if method not in scored and method in labels:
            family, variant, reads = labels[method]
            times = {size: timing["median_ms"] for size, timing in sizes.items()}
            rendered = {size: 1e3 * cost.at(1, reads) for size, cost in costs.items() if cost}
            found.append(Point(method, method, family, variant, reads, None, {}, times, rendered))
    return found


def render_cost(data: Mapping[str, Any], size: str, kind: str = "seconds") -> Cost | None:
    """Mean over the scenes; None where it was not measured."""
    known = [costs[kind] for costs in data["render"].get(size, {}).values() if kind in costs]
    return mean_cost(known) if known else None


def pareto(points: Sequence[Point], measure: Measure, size: str, *, render: bool = True) -> list[Point]:
    """The points that no other one beats in both time and error, by rising time.

    The variant with every buffer explicit is not considered: its image is the plain form's, and often its time too, so
    that noise would decide between them.
    """
    known = []
    for point in points:
        if point.variant == ALL:
            continue
        time, error = point.milliseconds(size, render=render), point.errors.get(measure.field, math.nan)
        if math.isfinite(time) and not math.isnan(error):
            known.append((time, -measure.better * error, point))
    known.sort(key=lambda entry: entry[:2])
    front: list[Point] = []
    best = math.inf
    for _, loss, point in known:
        if loss < best:
            front.append(point)
            best = loss
    return front


def equal_samples(psnr: float, curve: Mapping[float, float]) -> float:
    """Samples per pixel at which the renderer's ``curve`` (spp -> PSNR) reaches ``psnr``.

    Between two counts of samples the PSNR is linear in their logarithm. 0 below the curve's first point, infinite
    beyond its last.
    """
    samples = np.asarray(sorted(curve), float)
    # More samples never make an image worse; where noise suggests it, the smaller number of samples counts.
    quality = np.maximum.accumulate([curve[spp] for spp in samples])
    if psnr < quality[0]:
        return 0.0
    if psnr > quality[-1]:
        return math.inf
    after = int(np.searchsorted(quality, psnr))
    if after == 0:
        return float(samples[0])
    share = (psnr - quality[after - 1]) / (quality[after] - quality[after - 1])
    return float(2 ** np.interp(share, [0, 1], np.log2(samples[after - 1 : after + 1])))


def equal_quality(points: Sequence[Point], cost: Cost | None) -> dict[str, Equal]:
    """Key of each denoised point -> what the bare renderer needs for its PSNR, that of :func:`headline`."""
    field = headline(points)[0].field
    known = [point for point in points if point.spp and math.isfinite(point.errors[field])]
    curve = {point.spp: point.errors[field] for point in known if point.method == RENDERER and point.spp}
    found = {}
    for point in known:
        if point.method != RENDERER and curve:
            spp = equal_samples(point.errors[field], curve)
            found[point.key] = Equal(spp, cost.at(spp) if cost else math.nan)
    return found


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows as text, the first column to the left and the others to the right."""
    widths = [max(len(row[index]) for row in rows) for index in range(len(rows[0]))]
    lines = [
        [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        for row in rows
    ]
    return "\n".join("  ".join(line).rstrip() for line in lines)


def front_table(
    front: Sequence[Point], equals: Mapping[str, Equal], size: str, most: int, quality: Sequence[Measure]
) -> str:
    """The Pareto front for a terminal; ``most`` samples were rendered, ``quality`` is shown."""
    labels = [measure.label for measure in quality]
    rows = [["on the front", "spp", "ms / frame", "denoising ms", *labels, "bare renderer needs"]]
    for point in front:
        equal = equals.get(point.key)
        rows.append(
            [
                point.method,
                f"{point.spp:g}",
                f"{point.milliseconds(size, render=bool(point.render_ms)):.0f}",
                f"{point.denoise_ms[size]:.0f}",
                *(f"{point.errors[measure.field]:.2f}" for measure in quality),
                "" if equal is None else in_words(equal, most),
            ]
        )
    return text_table(rows)


def in_words(equal: Equal, most: int) -> str:
    """An equal-quality figure as text; ``most`` samples were rendered."""
    if math.isinf(equal.spp):
        return f"> {most} spp"
    if equal.spp == 0:
        return "< 1 spp"
    return f"{equal.spp:.0f} spp" + ("" if math.isnan(equal.seconds) else f", {equal.seconds:.1f} s")


def _mean(values: Sequence[float | None]) -> float:
    """The mean of the known values: a clip without disoccluded pixels has none."""
    known = [float(value) for value in values if value is not None]
    return float(np.mean(known)) if known else math.nan
