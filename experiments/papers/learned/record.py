"""The papers' tables as measurements for the page of results (:mod:`experiments.measurement`)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from experiments.cycles.reference import decibels
from experiments.measurement import describe_measurement, round_finite
from experiments.papers.learned.curves import METRICS, PICTURE, choose_frames, find_mean
from experiments.papers.learned.scores import Table, rows_of
from experiments.papers.learned.stages import FAMILIES, REFERENCE_SPP, STAGES, Clips, Settings, recipe_of
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import Scores, mean_scores
from jaxdn.zoo.weights import shipped_names

COLUMNS: Mapping[str, tuple[Callable[[Scores], float], int, str]] = {
    "PSNR": (lambda one: one.unbiased_psnr, 2, "higher"),
    "temporal PSNR": (lambda one: one.unbiased_temporal_psnr, 2, "higher"),
    "disoccluded PSNR": (lambda one: decibels(one.unbiased_disoccluded_mse), 2, "higher"),
    "SSIM": (lambda one: one.ssim, 4, "higher"),
    "L1": (lambda one: one.l1, 4, "lower"),
    "MSE": (lambda one: one.unbiased_mse, 5, "lower"),
    "FLIP": (lambda one: one.flip, 3, "lower"),
    "relative MSE": (lambda one: one.unbiased_relative_mse, 4, "lower"),
}
"""Title of a column -> its value, the decimals, what is best."""
_ORDER, _CURVES_ORDER = 71.0, 72.0
_Made = tuple[list[dict[str, Any]], list[list[Any]], str]
"""Columns, rows, and what the rows are."""


def record_table(one: Table, found: Results, settings: Settings) -> dict[str, Any]:
    """A table as a measurement, with what holds of the paper's claims."""
    columns, rows, what = _scores_of(one, found) if one.figures is None else _figures_of(one.figures(found))
    what = f"{what} {_describe(settings, one.clips)}"
    rates = {row: recipe_of(row, settings).learning_rate for row in one.rows if row in STAGES}
    if len(set(rates.values())) > 1:
        what += f" Adam's rates: {', '.join(f'`{row}` {rate:g}' for row, rate in rates.items())}."
    if one.figures is None and (shipped := [row for row in one.rows if row in shipped_names()]):
        what += f" {', '.join(f'`{row}`' for row in shipped)}: shipped weights, of other clips and far more updates."
    if any(STAGES[row].start for row in one.rows if row in STAGES):
        what += " Networks of smaller budgets go on from those of the next larger one and so have had more updates."
    if one.clips == "small lights":
        what += " What the networks that choose are given to place, half of the budget,"
        what += " was settled on these test clips."
    title = one.heading + (", as published" if settings.as_published else "")
    described = describe_measurement(
        "table", title, "Quality", _ORDER, command=_command(settings), what=what, rows=rows
    )
    return {
        **described,
        "columns": columns,
        "claims": [
            {"claim": claim.text, "paper": claim.paper, "here": claim.ours, "verdict": claim.verdict}
            for claim in one.claims(found)
        ],
    }


def _scores_of(one: Table, found: Results) -> _Made:
    """A row a method, its means over the test clips."""
    rows = [
        [f"`{label}`", *(round_finite(value(scores), decimals) for value, decimals, _ in COLUMNS.values())]
        for label, scores in mean_scores(rows_of(found, one.rows)).items()
    ]
    columns = [{"name": title, "decimals": decimals, "best": best} for title, (_, decimals, best) in COLUMNS.items()]
    what = f"Means over {len(found.clips)} test clips of other seeds; SSIM, L1 and FLIP have the references' noise."
    return [{"name": "method"}, *columns], rows, what


def _figures_of(figures: Sequence[Mapping[str, str | float]]) -> _Made:
    """A table's own rows, all of PSNR."""
    rows = [[value if isinstance(value, str) else round(value, 2) for value in row.values()] for row in figures]
    columns = [{"name": title, "decimals": 2} for title in figures[0]]
    return columns, rows, "PSNR in dB on test clips of other seeds, without the references' noise."


def record_curves(found: Mapping[str, Mapping[str, Sequence[float]]], settings: Settings) -> dict[str, Any]:
    """Row of table 2 -> metric -> frames, of :func:`experiments.papers.learned.curves.measure_curves`."""
    shown = choose_frames(settings.curve_frames)
    rows = [
        [
            f"`{row}`",
            name.upper(),
            *(round(curves[name][number - 1], 4) for number in shown),
            round(find_mean(curves[name]), 4),
        ]
        for row, curves in found.items()
        for name in METRICS
    ]
    titles = ["method", "error", *(f"frame {number}" for number in shown), "mean from 2 on"]
    described = describe_measurement(
        "table",
        f"Zeng et al. 2021, figure 8: {settings.curve_frames} frames"
        + (", as published" if settings.as_published else ""),
        "Quality",
        _CURVES_ORDER,
        command=_command(settings),
        what=f"Errors of one clip, 1 sample a pixel, with the references' noise. {_describe(settings)}",
        rows=rows,
    )
    picture = {
        "file": PICTURE,
        "alt": "SSIM and MSE of each method over the frames",
        "caption": "Every frame of the clip.",
    }
    columns = [{"name": title, "decimals": 4} for title in titles]
    return {**described, "columns": columns, "picture": picture}


def _describe(settings: Settings, clips: Clips = "families") -> str:
    """The clips and the training, and with ``--as-published`` what of it is not the papers'."""
    families, rooms = len(FAMILIES) + len(settings.rooms), " and rooms" if settings.rooms else ""
    trained_on = {
        "families": f"{settings.clips} clips of each of {families} families{rooms}",
        "small lights": f"{4 * settings.clips} clips, of all reflected light, of rooms with a small lamp",
    }[clips]
    how = "By the presets and recipes of their papers, but for" if settings.as_published else "Trained by"
    return (
        f"{how} {settings.steps} updates on windows of {settings.frames} frames; small networks where they are not "
        f"called large. {trained_on}, 8 frames of {settings.size} x "
        f"{settings.size} pixels, with references of {REFERENCE_SPP} samples. Each network was trained once: a tenth "
        "of a decibel is chance."
    )


def _command(settings: Settings) -> str:
    """What measures it again, in a folder of its own."""
    words = ["python -m experiments.papers.learned", "--tables", *settings.tables] if settings.tables else []
    words = words or ["python -m experiments.papers.learned"]
    words += ["--as-published"] * settings.as_published
    for name in ("steps", "clips", "frames", "size", "curve_frames"):
        if getattr(settings, name) != getattr(Settings(), name):
            words += [f"--{name.replace('_', '-')}", str(getattr(settings, name))]
    for name, places in (("rooms", settings.rooms), ("scenes", settings.scenes)):
        words += [f"--{name}", *(place.name for place in places)] if places else []
    return " ".join(words)
