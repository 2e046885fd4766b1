"""The page as one string: text, tables and data in HTML, style and behaviour inlined from ``page.css`` and ``page.js``.

Tables and text need no script. Images and curves are stored as JSON inside each clip's section and only unpacked when
that section is opened, so a page of thirty clips opens as fast as a page of one.
"""

import json
import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from jaxdn.evaluation.report import images
from jaxdn.evaluation.report.film import encode_webp, frames_within
from jaxdn.evaluation.report.results import (
    REFERENCE,
    ClipResult,
    Results,
    Scores,
    TrainingCurve,
    json_ready,
    mean_noise_floor,
    mean_scores,
)
from jaxdn.evaluation.report.summary import (
    Column,
    best_methods,
    columns,
    floor_score,
    headline,
    is_noisy,
    sentences,
    show,
)

IMAGE_BUDGET = 27_000_000
"""Bytes of images (as base64 text) in one page; clips beyond it have only numbers and curves."""

FILM_BUDGET = 16_000_000
"""Bytes of films (as base64 text) in one page, in equal parts for all clips; frames beyond a part are left out."""

ARROWS = {1: "\N{NO-BREAK SPACE}↑", -1: "\N{NO-BREAK SPACE}↓", 0: ""}

POINTS = 1000
"""Maximum number of points of a loss curve, each the mean of its steps; metrics.json has all of them."""


def page(results: Results) -> str:
    """The whole document; expects results that ``check_results`` has accepted."""
    here = files("jaxdn.evaluation.report")
    errors = [
        {
            label: images.error_map(image, clip.images[REFERENCE])
            for label, image in clip.images.items()
            if label != REFERENCE
        }
        for clip in results.clips
    ]
    # The noise of the input would set the scale and leave every denoised image black.
    scale = images.error_scale(
        [values for maps in errors for label, values in maps.items() if not is_noisy(label)]
        or [values for maps in errors for values in maps.values()]
    )
    data = {
        "methods": results.methods,
        "noisy": [method for method in results.methods if is_noisy(method)],
        "opens": results.opens_on or headline(results).best,
        "about": dict(results.about),
        "errorScale": scale,
        "svgf": headline(results).svgf,
        "errorColors": images.ERROR_COLORS,
        "training": {label: _curve(curve) for label, curve in results.training.items()},
    }
    left = IMAGE_BUDGET
    sections = []
    for index, (clip, maps) in enumerate(zip(results.clips, errors, strict=True)):
        section, spent = _clip(results, clip, maps, index, scale, left)
        left -= spent
        sections.append(section)
    body = [
        _top(results, sum(map(len, sections))),
        _means(results),
        _overview(results),
        '<section id="clips"><h2>Clips</h2>',
        '<p class="note">Keys <kbd>1</kbd> … switch the picture of the clip in view, <kbd>E</kbd> shows its error, '
        "<kbd>D</kbd> marks disoccluded pixels, <kbd>Space</kbd> plays the frames, <kbd>,</kbd> and <kbd>.</kbd> step "
        "through them. Error is the mean over channels of |method − reference| on display "
        f"values in 0..1; one colour scale for the whole page: {_scale_bar(scale)}</p>",
        "<noscript><p>The player, other images and curves need JavaScript, which this page contains.</p></noscript>",
        *sections,
        "</section>",
        _training(results),
        _making(results),
    ]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            # The page is complete; this policy makes the browser block every request.
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
            "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>{escape(results.title)}</title>",
            f"<style>\n{here.joinpath('page.css').read_text('utf-8')}</style>",
            "</head>",
            "<body><main>",
            *body,
            "</main>",
            json_script(data, 'id="page-data"'),
            f"<script>\n{here.joinpath('player.js').read_text('utf-8')}</script>",
            f"<script>\n{here.joinpath('page.js').read_text('utf-8')}</script>",
            "</body></html>",
            "",
        ]
    )


def _top(results: Results, size: int) -> str:
    """Title, cards and sentences; ``size`` is in characters, that of the clips' sections: nearly all of the page."""
    top = headline(results)
    free = "" if top.field == "psnr" else ", unbiased"
    cards = []
    if top.best is not None:
        cards.append((f"Best PSNR{free}", f"{show(top.best_psnr, 'psnr')} dB", top.best))
    if math.isfinite(top.gain_over_svgf):
        cards.append((f"Gain over {top.svgf}", _signed(top.gain_over_svgf) + " dB", f"PSNR of {top.best}"))
    if math.isfinite(top.disoccluded_less):
        percent = f"{-100 * top.disoccluded_less:+.0f} %".replace("-", "−")
        cards.append(("L1 in disoccluded pixels", percent, f"{top.occlusion} against {top.traditional}"))
    if not math.isnan(top.floor):
        cards.append(("Noise floor", f"{show(top.floor, 'psnr')} dB", "what a perfect image would score"))
    shown = "".join(
        f'<div class="card"><div class="label">{escape(label)}</div><div class="figure">{escape(figure)}</div>'
        f'<div class="label">{escape(below)}</div></div>'
        for label, figure, below in cards
    )
    findings = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences(results))
    count = f"{len(results.clips)} clip{'s' if len(results.clips) != 1 else ''}"
    megabytes = f"{size / 1e6:.1f} MB, complete in this file"
    links = {"scores": "Scores", "overview": "By clip", "clips": "Pictures", "training": "Training", "made": "Settings"}
    navigation = " ".join(
        f'<a href="#{anchor}">{label}</a>'
        for anchor, label in links.items()
        if anchor != "training" or results.training
    )
    return (
        f"<header><h1>{escape(results.title)}</h1>"
        f'<p class="note">{count}, {len(results.methods)} methods; {megabytes}</p>'
        f"<nav>{navigation}</nav></header>"
        f'<section id="summary"><div class="cards">{shown}</div>'
        f"<ul>{findings}</ul></section>"
    )


def _means(results: Results) -> str:
    shown = columns(results)
    explained = "; ".join(f"<b>{column.label}</b>: {column.explanation}" for column in shown)
    return (
        '<section id="scores"><h2>Scores, mean over all clips</h2>'
        f"{_table(mean_scores(results), shown, results, mean_noise_floor(results))}"
        f'<p class="note">Arrows point to better, the best of a column is bold. {explained}. '
        "The last row is what a perfect image would score against references that are noisy themselves; unbiased "
        "scores do not have that noise in them, and are the ones to compare by. "
        "– means not measured, or nothing to measure on.</p></section>"
    )


def _table(scores: dict[str, Scores], shown: Sequence[Column], results: Results, floor: float) -> str:
    """Methods down, metrics across, the noise floor as the last row."""
    head = "".join(
        f'<th scope="col" title="{escape(column.explanation)}">{column.label}{ARROWS[column.better]}</th>'
        for column in shown
    )
    best = {column.field: best_methods(scores, column) for column in shown}
    rows = []
    for number, method in enumerate(results.methods):
        cells = "".join(
            _cell(getattr(scores[method], column.field), column.field, best=method in best[column.field])
            for column in shown
        )
        rows.append(f'<tr><th scope="row">{_swatch(number, method)}{_named(method, results)}</th>{cells}</tr>')
    cells = "".join(f"<td>{show(floor_score(floor, column.field), column.field)}</td>" for column in shown)
    rows.append(f'<tr class="floor"><th scope="row">noise floor</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table><thead><tr><th scope="col">Method</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _overview(results: Results) -> str:
    """One row per clip, one column per method."""
    tables = []
    shown = columns(results)[:-2]
    for column in shown:
        head = "".join(
            f'<th scope="col">{_swatch(number, method)}{_named(method, results)}</th>'
            for number, method in enumerate(results.methods)
        )
        rows = []
        for index, clip in enumerate(results.clips):
            best = best_methods(clip.scores, column)
            cells = "".join(
                _cell(getattr(clip.scores[method], column.field), column.field, best=method in best)
                for method in results.methods
            )
            cells += f'<td class="floor">{show(floor_score(clip.noise_floor_psnr, column.field), column.field)}</td>'
            rows.append(f'<tr><th scope="row"><a href="#clip-{index}">{escape(clip.name)}</a></th>{cells}</tr>')
        hidden = "" if column is shown[0] else " hidden"
        tables.append(
            f'<div class="scroll" data-metric="{column.field}"{hidden}><table><thead><tr><th scope="col">Clip</th>'
            f'{head}<th scope="col">noise floor</th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        )
    options = "".join(
        f'<option value="{column.field}">{column.label}{ARROWS[column.better]}</option>' for column in shown
    )
    return (
        '<section id="overview"><h2>Clip by clip</h2>'
        f'<p><label>Metric <select id="metric" autocomplete="off">{options}</select></label></p>'
        f"{''.join(tables)}</section>"
    )


def _clip(
    results: Results, clip: ClipResult, maps: dict[str, np.ndarray], index: int, scale: float, budget: int
) -> tuple[str, int]:
    """A clip's collapsible section, and how many bytes its images take.

    Args:
      results: of the whole report.
      clip: to show.
      maps: method -> its error map [H, W].
      index: of the clip.
      scale: upper end of the error maps' colour scale.
      budget: bytes of images that the page may still take.
    """
    labels = [method for method in results.methods if method in clip.images]
    judged = [maps[label] for label in labels if not is_noisy(label)] or list(maps.values())
    mask = np.asarray(clip.disoccluded, bool)
    x, y, width, height = images.worst_crop(judged, mask)
    where = np.zeros_like(mask)
    where[y : y + height, x : x + width] = True
    if mask.any():
        where &= mask
    pictures = {label: images.data_address(images.encode_png(clip.images[label])) for label in [*labels, REFERENCE]}
    wrong = {label: images.data_address(images.encode_error(maps[label], scale)) for label in labels}
    still = _still(results, clip)
    spent = sum(map(len, pictures.values())) + sum(map(len, wrong.values())) + len(still)
    data: dict[str, Any] = {
        "labels": [*labels, REFERENCE],
        "width": mask.shape[1],
        "height": mask.shape[0],
        "shownFrame": clip.shown_frame,
        "crop": [x, y, width, height],
        "disoccluded": int(mask.sum()),
        "floor": clip.noise_floor_psnr,
        "error": {label: show(float(maps[label].mean()), "l1") for label in labels},
        "cropError": {label: show(float(maps[label][where].mean()), "l1") for label in labels},
        "curves": _curves(clip),
        "film": _film(clip, FILM_BUDGET // len(results.clips)),
    }
    notice = ""
    if spent <= budget:
        data |= {"images": pictures, "errors": wrong}
        data["mask"] = images.data_address(images.encode_mask(mask)) if mask.any() else None
    else:
        spent, still = 0, ""
        notice = (
            '<p class="note">No pictures: this page would become too large to open comfortably. '
            "Report fewer clips, or smaller ones, to see them.</p>"
        )
    top = headline(results)
    gist = ""
    if top.best is not None:
        gist = f"{escape(top.best)} {show(getattr(clip.scores[top.best], top.field), top.field)} dB, "
    opened = " open" if index == 0 else ""
    return (
        f'<details class="clip" id="clip-{index}"{opened}><summary><span class="name">'
        f'{escape(clip.name)}</span> <span class="note">{gist}'
        f"floor {show(clip.noise_floor_psnr, 'psnr')} dB</span></summary>"
        f'{notice}{still}<div class="views"></div><h3>Scores on this clip</h3>'
        f"{_table(clip.scores, columns(results), results, clip.noise_floor_psnr)}"
        '<div class="curves"></div>'
        f"{json_script(data)}</details>"
    ), spent


def _film(clip: ClipResult, budget: int) -> dict[str, Any] | None:
    """What the player plays: as many first frames as ``budget`` bytes hold; None if there are no films."""
    count = frames_within(clip.films, budget)
    if not count:
        return None
    films = {
        label: [[*map(images.data_address, files[:count])] for files in each] for label, each in clip.films.items()
    }
    return {
        "frames": count,
        "of": max((len(curve) for metrics in clip.per_frame.values() for curve in metrics.values()), default=count),
        "pictures": {label: pictures for label, (pictures, _) in films.items()},
        "errors": {label: errors for label, (_, errors) in films.items() if errors},
    }


def _still(results: Results, clip: ClipResult) -> str:
    """Three pictures of the shown frame for browsers that run no script; others do not even decode them."""
    opens = results.opens_on or headline(results).best
    wanted = [next(filter(is_noisy, results.methods), None), opens, REFERENCE]
    shown = "".join(
        f'<figure><img src="{images.data_address(encode_webp(clip.images[label]))}" alt="{escape(label)}">'
        f"<figcaption>{escape(label)}</figcaption></figure>"
        for label in wanted
        if label is not None and label in clip.images
    )
    return f'<noscript><div class="still">{shown}</div></noscript>'


def _curves(clip: ClipResult) -> dict[str, dict[str, list[float]]]:
    """metric -> method -> values with five significant digits, ordered as on the page."""
    curves: dict[str, dict[str, list[float]]] = {}
    for method, metrics in clip.per_frame.items():
        for metric, values in metrics.items():
            if len(values):
                curves.setdefault(metric, {})[method] = [float(f"{float(value):.5g}") for value in values]
    return curves


def _curve(curve: TrainingCurve) -> dict[str, Any]:
    """A training curve of at most ``POINTS`` points."""
    parts = np.array_split(np.arange(len(curve.step)), min(POINTS, max(len(curve.step), 1)))
    steps, losses = np.asarray(curve.step, np.float64), np.asarray(curve.loss, np.float64)
    return {
        "step": [float(steps[part].mean()) for part in parts if part.size],
        "loss": [float(f"{losses[part].mean():.5g}") for part in parts if part.size],
        "validationStep": curve.validation_step,
        "validationPsnr": curve.validation_psnr,
    }


def _training(results: Results) -> str:
    if not results.training:
        return ""
    return (
        '<section id="training"><h2>Training</h2>'
        '<div class="pair"><div id="loss"></div><div id="validation"></div></div>'
        '<p class="note">A loss of other terms cannot be compared between networks; validation PSNR can.</p></section>'
    )


def _making(results: Results) -> str:
    parts = []
    for name, facts in (("Settings", results.settings), ("Machine and versions", results.machine)):
        rows = "".join(
            f'<tr><th scope="row">{escape(key)}</th><td>{escape(value)}</td></tr>'
            for key, value in _flat(json_ready(facts))
        )
        rows = rows or "<tr><td>not recorded</td></tr>"
        parts.append(f'<div><h3>{name}</h3><table class="facts"><tbody>{rows}</tbody></table></div>')
    return (
        f'<section id="made"><h2>How this was made</h2><div class="pair">{"".join(parts)}</div>'
        '<p class="note">All numbers of this page are in <code>metrics.json</code> in the same folder.</p></section>'
    )


def _flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested facts as rows with dotted names."""
    if isinstance(value, dict) and value:
        return [row for key, item in value.items() for row in _flat(item, f"{prefix}.{key}" if prefix else key)]
    if isinstance(value, list) and not any(isinstance(item, dict | list) for item in value):
        return [(prefix, ", ".join(map(str, value)) or "none")]
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return [(prefix, {"null": "–", "true": "yes", "false": "no", "{}": "none"}.get(text, text))]


def _named(method: str, results: Results) -> str:
    """A label, and beneath it what it is."""
    about = results.about.get(method)
    return escape(method) + (f' <small class="about">{escape(about)}</small>' if about else "")


def _cell(value: float, field: str, *, best: bool) -> str:
    return f'<td class="best">{show(value, field)}</td>' if best else f"<td>{show(value, field)}</td>"


def _signed(decibels: float) -> str:
    return ("+" if decibels >= 0 else "") + show(decibels, "psnr")


def _swatch(number: int, method: str) -> str:
    """The method's colour, the same in tables and curves."""
    color = "n" if is_noisy(method) else number % 8
    return f'<i class="swatch c{color}"></i>'


def _scale_bar(scale: float) -> str:
    colors = ", ".join(f"rgb{color}" for color in images.ERROR_COLORS)
    bar = f'<i style="background:linear-gradient(to right, {colors})"></i>'
    return f'<span class="scale">0 {bar} {scale:g} and above</span>'


def json_script(data: Any, attributes: str = "") -> str:
    """Data inside the page; no ``<`` survives, so no text in it can end the element."""
    text = json.dumps(json_ready(data), allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    text = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return f'<script type="application/json" {attributes}>{text}</script>'
