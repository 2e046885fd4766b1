"""The results as sentences and as a text table: the page's summary and the terminal's output."""

import math
import re
from typing import NamedTuple

from jaxdn.evaluation.report.results import Results, Scores, headline_psnr, mean_noise_floor, mean_scores

NEAR_FLOOR = 3.0
"""dB; within this distance of the noise floor, half or more of the measured error is the reference's own noise."""


class Column(NamedTuple):
    """How one score is shown."""

    field: str
    label: str
    better: int
    """1 if higher is better, -1 if lower is, 0 if it is not a score."""
    explanation: str


COLUMNS = (
    Column("unbiased_psnr", "PSNR dB, unbiased", 1, "the one to compare by: without the noise of the reference"),
    Column("psnr", "PSNR dB", 1, "peak 1, tone-mapped, mean of the frames; its noise floor is in the last row"),
    Column("ssim", "SSIM", 1, "structural similarity"),
    Column("l1", "L1", -1, "mean absolute difference"),
    Column("unbiased_mse", "MSE, unbiased", -1, "without the noise of the reference"),
    Column("mse", "MSE", -1, "mean squared difference"),
    Column("unbiased_disoccluded_mse", "MSE, disoccluded, unbiased", -1, "without the noise of the reference"),
    Column("unbiased_relative_mse", "Relative MSE, unbiased", -1, "without the noise of the reference"),
    Column("relative_mse", "Relative MSE", -1, "squared difference over (reference² + 0.01), of linear radiance"),
    Column("unbiased_temporal_psnr", "Temporal PSNR dB, unbiased", 1, "without the noise of the reference"),
    Column("temporal_psnr", "Temporal PSNR dB", 1, "of differences between consecutive frames"),
    Column("flip", "FLIP", -1, "perceived difference when flipping"),
    Column("disoccluded_l1", "Disoccluded L1", -1, "on pixels hidden one frame earlier"),
    Column("disoccluded_psnr", "Disoccluded PSNR dB", 1, "on pixels hidden one frame earlier"),
    Column("ms_per_frame", "ms / frame", 0, "on the machine of this report"),
    Column("spp", "spp", 0, "samples per pixel of the input"),
)


def show(value: float, field: str) -> str:
    """A score as text: dB with two decimals, small errors with three significant digits, an en dash for NaN."""
    return _figures(value, field).replace("-", "−")


def _figures(value: float, field: str) -> str:
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if field.endswith("psnr"):
        return f"{value:.2f}"
    if field in ("ssim", "flip"):
        return f"{value:.4f}"
    if field == "spp":
        return f"{value:.3g}"
    if field == "ms_per_frame":
        return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:.0f}"
    if value != 0 and abs(value) < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        return f"{mantissa}e-{abs(int(exponent))}"
    if 0 < abs(value) < 0.01:
        return f"{value:.5f}"
    return f"{value:.4f}" if abs(value) < 10 else f"{value:.3g}"


class Headline(NamedTuple):
    """The main findings; NaN or None where the results do not have them."""

    best: str | None
    field: str
    """Which PSNR decides: ``psnr``, or ``unbiased_psnr`` where it is known (:func:`headline_psnr`)."""
    best_psnr: float
    gain_over_svgf: float
    """dB PSNR of the best method over svgf; NaN where there is no svgf or it is the best."""
    svgf: str | None
    traditional: str | None
    """The compared ablation A (traditional motion vectors)."""
    occlusion: str | None
    """The ablation C (dual motion vectors and occlusion loss), of the same size as A."""
    disoccluded_less: float
    """The fraction by which C's L1 error in disoccluded pixels is below A's; negative if it is above."""
    disoccluded_gain: float
    """PSNR of C minus that of A in disoccluded pixels, in dB."""
    floor: float
    """dB, mean noise floor of the references."""


def headline(results: Results) -> Headline:
    """Find the best method by mean PSNR (unbiased where it is known), svgf, and the ablations A and C.

    They are found by labels such as ``ntd C SMALL``.
    """
    means = mean_scores(results)
    field = headline_psnr(clip.scores for clip in results.clips)
    psnrs = {method: getattr(means[method], field) for method in results.methods}
    known = [method for method in results.methods if not math.isnan(psnrs[method])]
    best = max(known, key=lambda method: psnrs[method], default=None)
    best_psnr = psnrs[best] if best is not None else math.nan
    svgf = _labelled(results.methods, "svgf")
    gain = _difference(best_psnr, psnrs[svgf]) if svgf is not None and svgf != best else math.nan
    traditional, occlusion = _ablation(results.methods)
    less = decibels = math.nan
    if traditional is not None and occlusion is not None:
        a, c = means[traditional], means[occlusion]
        if a.disoccluded_l1 > 0 and math.isfinite(a.disoccluded_l1):
            less = 1.0 - c.disoccluded_l1 / a.disoccluded_l1
        decibels = _difference(c.disoccluded_psnr, a.disoccluded_psnr)
    floor = mean_noise_floor(results)
    return Headline(best, field, best_psnr, gain, svgf, traditional, occlusion, less, decibels, floor)


def sentences(results: Results) -> list[str]:
    """The headline as plain text, one or two sentences for each finding."""
    top, clips = headline(results), results.clips
    over = f"over {len(clips)} clips" if len(clips) != 1 else f"on the clip {clips[0].name}"
    unbiased = top.field != "psnr"
    free = ", without the noise of the references" if unbiased else ""
    found = []
    if top.best is None:
        found.append("No method has a PSNR, so none can be called the best.")
    elif len(results.methods) == 1:
        found.append(f"{top.best} reaches {show(top.best_psnr, 'psnr')} dB PSNR {over}{free}.")
    else:
        value = show(top.best_psnr, "psnr")
        text = f"{top.best} has the highest PSNR of {len(results.methods)} methods: {value} dB {over}{free}"
        if math.isfinite(top.gain_over_svgf):
            text += f", {show(top.gain_over_svgf, 'psnr')} dB more than {top.svgf}"
        found.append(text + ".")
    broken = [method for method, scores in mean_scores(results).items() if math.isnan(getattr(scores, top.field))]
    if broken and top.best is not None:
        found.append(f"Without a PSNR on at least one clip: {', '.join(broken)}.")
    if top.traditional is not None and top.occlusion is not None:
        if math.isnan(top.disoccluded_less):
            found.append("Disoccluded pixels were not scored, so A and C cannot be compared there.")
        else:
            means = mean_scores(results)
            a, c = (means[method].disoccluded_l1 for method in (top.traditional, top.occlusion))
            word = "lower" if top.disoccluded_less >= 0 else "higher"
            text = (
                f"In disoccluded pixels the L1 error of {named(top.occlusion, results)} is "
                f"{abs(top.disoccluded_less):.0%} {word} than that of {named(top.traditional, results)}: "
                f"{show(c, 'l1')} against {show(a, 'l1')}"
            )
            if math.isfinite(top.disoccluded_gain):
                text += f"; {'+' if top.disoccluded_gain >= 0 else ''}{show(top.disoccluded_gain, 'psnr')} dB PSNR"
            found.append(text + ".")
    if math.isnan(top.floor):
        found.append("The noise floor of the references is not known.")
    else:
        plain = " of plain PSNR" if unbiased else ""
        text = f"The references are noisy themselves: a perfect image would score {show(top.floor, 'psnr')} dB{plain}"
        found.append(text + (" on average." if len(clips) != 1 else "."))
        if unbiased:
            found.append("Compare by the unbiased columns, which do not have that noise in them.")
        elif top.best_psnr > top.floor - NEAR_FLOOR:
            found.append(
                f"{top.best} comes within {NEAR_FLOOR:g} dB of that floor, so its true error is smaller than it looks; "
                "references with more samples would show it."
            )
    return found


def named(method: str, results: Results) -> str:
    """A label, followed by what it is, in brackets, where that is known."""
    about = results.about.get(method)
    return f"{method} ({about})" if about else method


def columns(results: Results) -> tuple[Column, ...]:
    """The columns to show: those of unbiased scores only where a clip keeps a half of its reference."""
    means = mean_scores(results).values()
    return tuple(
        column
        for column in COLUMNS
        if not column.field.startswith("unbiased") or any(not math.isnan(getattr(each, column.field)) for each in means)
    )


def text_table(results: Results) -> str:
    """The means over all clips as a table for the terminal, with the noise floor as its last row."""
    means = mean_scores(results)
    floor = mean_noise_floor(results)
    shown = columns(results)
    # A label in two lines, or the table would be wider than a screen.
    labels = [(column.label.partition(", ")[0], column.label.partition(", ")[2]) for column in shown]
    rows = [["method", *(label for label, _ in labels)]]
    rows += [["", *(rest for _, rest in labels)]] if any(rest for _, rest in labels) else []
    rows += [
        [method, *(show(getattr(means[method], column.field), column.field) for column in shown)]
        for method in results.methods
    ]
    rows.append(["noise floor", *(show(floor_score(floor, column.field), column.field) for column in shown)])
    widths = [max(len(row[index]) for row in rows) for index in range(len(rows[0]))]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]
    return "\n".join(line.rstrip() for line in lines)


def floor_score(floor_psnr: float, field: str) -> float:
    """What a perfect image would score: known for PSNR, and for MSE as 10^(-PSNR / 10)."""
    if field == "psnr":
        return floor_psnr
    if field == "mse" and not math.isnan(floor_psnr):
        return 10.0 ** (-floor_psnr / 10.0)
    return math.nan


def best_methods(scores: dict[str, Scores], column: Column) -> set[str]:
    """The best methods of a column, as rounded; none if the column is not a score or has one method."""
    values = {method: getattr(score, column.field) for method, score in scores.items()}
    known = {method: value * column.better for method, value in values.items() if not math.isnan(value)}
    if column.better == 0 or len(known) < 2:
        return set()
    top = max(known.values())
    shown = {show(values[method], column.field) for method, value in known.items() if value == top}
    return {method for method in known if show(values[method], column.field) in shown}


def is_noisy(method: str) -> bool:
    """Whether a label is that of the noisy input, not of a method."""
    return "noisy" in method.lower()


def _difference(first: float, second: float) -> float:
    return math.nan if math.isinf(first) and math.isinf(second) else first - second


def _labelled(methods: list[str], word: str) -> str | None:
    """The first method with this label, or with the word in its label."""
    exact = [method for method in methods if method.lower() == word]
    within = [method for method in methods if word in re.split(r"[^a-z0-9]+", method.lower())]
    return next(iter(exact + within), None)


def _ablation(methods: list[str]) -> tuple[str | None, str | None]:
    """Labels of the ablations A and C: those that differ only in this letter, else the first of each."""

    def lettered(letter: str) -> list[str]:
        return [method for method in methods if re.search(rf"(?<![A-Za-z0-9]){letter}(?![A-Za-z0-9])", method)]

    for a in lettered("A"):
        c = re.sub(r"(?<![A-Za-z0-9])A(?![A-Za-z0-9])", "C", a)
        if c in methods:
            return a, c
    return next(iter(lettered("A")), None), next(iter(lettered("C")), None)
