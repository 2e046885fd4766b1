"""The chart as one page that needs no network: a plot linked to images, and tables that need no script."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments.speed.chart import stacks
from experiments.speed.chart.breakdown import WHOLE
from experiments.speed.chart.scores import MEASURES
from experiments.speed.chart.summary import RENDERER, Equal, Point, headline, in_words, pareto, render_cost
from experiments.speed.chart.way import ALL
from jaxdn.evaluation.report import images
from jaxdn.evaluation.report.results import json_ready
from jaxdn.runtime.atomic_files import write_atomically

Pictures = dict[str, dict[str, np.ndarray]]
"""Clip -> point, or "reference" -> [H, W, 3] in 0..1."""


def write_page(
    folder: str | os.PathLike[str],
    data: Mapping[str, Any],
    points: Sequence[Point],
    equals: Mapping[str, Equal],
    sizes: tuple[str, str],
) -> Path:
    """Write ``folder/chart.html`` and return its path.

    Args:
      folder: with the images that were saved while scoring.
      data: raw measurements.
      points: of the chart.
      equals: key of a point -> what the bare renderer needs for its quality.
      sizes: the timed size and the clips' own.
    """
    path = Path(folder) / "chart.html"
    document = page(data, points, equals, sizes, read_pictures(Path(folder), data, points))
    write_atomically({path: document.encode("utf-8", "replace")})
    return path


def read_pictures(folder: Path, data: Mapping[str, Any], points: Sequence[Point]) -> Pictures:
    """The images that were saved while scoring."""
    found: Pictures = {}
    for clip in data["clips"]:
        keys = ["reference", *(point.key for point in points if point.spp)]
        paths = {key: folder / "images" / clip / f"{key.replace(' ', '_')}.png" for key in keys}
        found[clip] = {
            key: np.asarray(Image.open(path), np.float64) / 255 for key, path in paths.items() if path.is_file()
        }
    return found


def page(
    data: Mapping[str, Any],
    points: Sequence[Point],
    equals: Mapping[str, Equal],
    sizes: tuple[str, str],
    pictures: Pictures,
) -> str:
    """The whole document.

    Args:
      data: raw measurements.
      points: of the chart.
      equals: key of a point -> what the bare renderer needs for its quality.
      sizes: the timed size and the clips' own.
      pictures: clip -> point -> image.
    """
    here = files("experiments.speed.chart")
    style = files("jaxdn.evaluation.report").joinpath("page.css").read_text("utf-8") + here.joinpath(
        "page.css"
    ).read_text("utf-8")
    errors = {
        clip: {key: images.error_map(image, shown["reference"]) for key, image in shown.items() if key != "reference"}
        for clip, shown in pictures.items()
    }
    denoised = [error for maps in errors.values() for key, error in maps.items() if not key.startswith(RENDERER)]
    scale = images.error_scale(denoised or [np.zeros((1, 1))])
    most = max((int(point.spp or 0) for point in points if point.method == RENDERER), default=0)
    content = {
        "measures": [each._asdict() for each in sorted(MEASURES, key=lambda each: each != headline(points)[0])],
        "sizes": sizes,
        "families": list(dict.fromkeys(point.family for point in points)),
        "variants": list(dict.fromkeys(point.variant for point in points)),
        "renderer": RENDERER,
        "all": ALL,
        "points": [_for_script(point, data, equals, most, sizes[0]) for point in points],
        "pictures": {
            clip: {key: images.data_address(images.encode_png(image)) for key, image in shown.items()}
            for clip, shown in pictures.items()
        },
        "wrong": {
            clip: {key: images.data_address(images.encode_error(error, scale)) for key, error in maps.items()}
            for clip, maps in errors.items()
        },
        "scale": scale,
    }
    body = [
        _top(data, sizes),
        '<section id="plot-section"><div class="bar" id="controls"></div><div class="chart" id="plot"></div>'
        '<div class="legend" id="families"></div><div class="legend" id="variants"></div>'
        '<p class="note" id="hovered" aria-live="polite">Point at a mark for its numbers, click it for its picture.</p>'
        '<div id="shown"></div>'
        "<noscript><p>The plot and the pictures need JavaScript, which this page contains. The tables do not."
        "</p></noscript></section>",
        _front(data, points, equals, sizes[0], most),
        _table(data, points, equals, sizes, most),
        _costs(data, sizes),
        _stages(data, sizes[0]),
        _breakdown(data, sizes[0]),
        _making(data),
    ]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            # The page is complete; this policy makes the browser block every request.
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
            "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>What accuracy costs in time</title><style>\n{style}</style></head><body><main>",
            *body,
            "</main>",
            f'<script type="application/json" id="page-data">{_json(content)}</script>',
            f"<script>\n{here.joinpath('page.js').read_text('utf-8')}</script></body></html>",
            "",
        ]
    )


def _for_script(
    point: Point, data: Mapping[str, Any], equals: Mapping[str, Equal], most: int, timed: str
) -> dict[str, Any]:
    equal = equals.get(point.key)
    timings = data["times"].get(point.method, {})
    return {
        **point._asdict(),
        "equal": None if equal is None else in_words(equal, most),
        "spread": {size: [timing["min_ms"], timing["max_ms"]] for size, timing in timings.items()},
        # At the clips' own size the program was compiled while scoring.
        "compile": {size: timing["first_ms"] for size, timing in timings.items() if size == timed},
        "peak": {size: timing["peak_mib"] for size, timing in timings.items()},
    }


def _json(value: Any) -> str:
    """Data inside the page; no ``<`` survives, so no text in it can end the element."""
    text = json.dumps(json_ready(value), allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _top(data: Mapping[str, Any], sizes: tuple[str, str]) -> str:
    clips = ", ".join(
        f"{name} (a perfect image would score {facts['noise_floor']:.1f} dB)"
        if facts["noise_floor"] is not None
        else name
        for name, facts in data["clips"].items()
    )
    notes = [
        f"Errors are means over the last {data['settings']['scored frames']} frames of {escape(clips)}, "
        f"{sizes[1]} pixels: small images. All except relative MSE are computed on sRGB values, clipped at 1.",
        "Unbiased errors do not have the noise of the references in them: read those, where the clips keep the halves "
        "of their references. The plain ones saturate at that noise.",
        f"Time is for one frame of {sizes[0]} (median of repeats, methods interleaved), or of the clips' own size. "
        "Rendering times beyond four samples per pixel are extrapolated linearly in the number of samples.",
        "Marks at the bottom of the plot have no error: untrained widths, and the time of a frame in which nothing "
        "moves. They are placed at the time of a frame with 1 sample per pixel.",
        "Effects all has every buffer that a denoiser reads, plain only those of the clip's effects: the same image, "
        "and the same program if the clip has all effects.",
        *(escape(sentence) for sentence in data["left_out"]["here"]),
    ]
    sentences = "".join(f"<li>{sentence}</li>" for sentence in notes)
    return (
        "<header><h1>What accuracy costs in time</h1></header>"
        f'<section id="summary"><ul class="note">{sentences}</ul></section>'
    )


def _front(data: Mapping[str, Any], points: Sequence[Point], equals: Mapping[str, Equal], size: str, most: int) -> str:
    """The Pareto front in PSNR, rendering included where it was timed."""
    rows = []
    quality = headline(points)
    front = pareto(points, quality[0], size, render=bool(data["render"]))
    for point in front:
        equal = equals.get(point.key)
        rows.append(
            [
                escape(point.method),
                f"{point.spp:g}",
                number(point.milliseconds(size, render=bool(data["render"]))),
                number(point.denoise_ms.get(size, math.nan)),
                *(number(point.errors[measure.field], 2) for measure in quality),
                "" if equal is None else in_words(equal, most),
            ]
        )
    head = ["Method", "spp", f"ms / frame, {size}", "denoising ms", *(each.label for each in quality), "bare renderer"]
    return (
        '<section id="front"><h2>The Pareto front</h2><p class="note">No other point is better and no slower; PSNR '
        "against time with rendering. Last column: what rendering alone needs for the same PSNR.</p>"
        f"{_rows(head, rows)}</section>"
    )


def _table(
    data: Mapping[str, Any],
    points: Sequence[Point],
    equals: Mapping[str, Equal],
    sizes: tuple[str, str],
    most: int,
) -> str:
    """Every point."""
    head = ["Method", "spp", *(measure.label for measure in MEASURES), "bare renderer needs"]
    head += [
        f"render ms, {sizes[0]}",
        f"denoise ms, {sizes[0]}",
        "min – max",
        f"denoise ms, {sizes[1]}",
        "first call s",
    ]
    head += ["peak MiB"] + (["joules"] if _has_joules(data) else [])
    rows = []
    for point in points:
        timing = data["times"].get(point.method, {}).get(sizes[0], {})
        equal = equals.get(point.key)
        spread = f"{number(timing['min_ms'])} – {number(timing['max_ms'])}" if timing else ""
        row = [escape(point.method), f"{point.spp:g}" if point.spp else "time only"]
        row += [
            number(point.errors.get(measure.field, math.nan), 4 if measure.better < 0 else 2) for measure in MEASURES
        ]
        row += ["" if equal is None else in_words(equal, most), number(point.render_ms.get(sizes[0], math.nan))]
        row += [number(point.denoise_ms.get(sizes[0], math.nan)), spread]
        row += [number(point.denoise_ms.get(sizes[1], math.nan), 1)]
        row += [number(timing.get("first_ms", math.nan) / 1e3, 1), number(timing.get("peak_mib"))]
        if _has_joules(data):
            row += [_joules(data, point, timing, sizes[0])]
        rows.append(row)
    return (
        '<section id="points"><h2>Every point</h2><p class="note">First calls compile. Peak memory is the growth '
        "of the process during one call; what a backend keeps between calls (ONNX Runtime, Open Image Denoise) is not "
        f"in it.</p>{_rows(head, rows)}</section>"
    )


def _has_joules(data: Mapping[str, Any]) -> bool:
    return any("joules" in timing for sizes in data["times"].values() for timing in sizes.values())


def _joules(data: Mapping[str, Any], point: Point, timing: Mapping[str, Any], size: str) -> str:
    """Joules of denoising, and with rendering."""
    cost = render_cost(data, size, "joules")
    alone = timing.get("joules", 0.0)
    whole = "" if cost is None or point.spp is None else f" ({number(alone + cost.at(point.spp, point.reads), 1)})"
    return f"{number(alone, 1)}{whole}"


def _costs(data: Mapping[str, Any], sizes: tuple[str, str]) -> str:
    """What rendering costs."""
    columns = [
        (f"{clip}, {size}", costs["seconds"]) for size in sizes for clip, costs in data["render"].get(size, {}).items()
    ]
    if not columns:
        return ""
    lines = {"building the scene": [cost["fixed"] for _, cost in columns]}
    lines["each sample per pixel"] = [cost["sample"] for _, cost in columns]
    for reads in columns[0][1]["buffers"]:
        lines[reads or "no buffers"] = [cost["buffers"][reads] for _, cost in columns]
    rows = [[escape(name), *(number(1e3 * value, 1) for value in values)] for name, values in lines.items()]
    head = ["ms", *(name for name, _ in columns)]
    return (
        '<section id="rendering"><h2>Rendering one frame, ms</h2><p class="note">The first two are the bare renderer. '
        "The other rows are the buffers that denoisers read, each with the time that they add to a frame.</p>"
        f"{_rows(head, rows)}</section>"
    )


def _stages(data: Mapping[str, Any], size: str) -> str:
    """What a person waits for, from the scene to the denoised file."""
    bars = stacks.stacks(data, size)
    rows = [
        [escape(bar.name), *(number(bar.parts.get(stage)) for stage in stacks.COLORS), number(bar.total)]
        for bar in bars
    ]
    return (
        f'<section id="stages"><h2>One {size} frame end to end</h2><p class="note">Rendered with {stacks.SPP} '
        "sample per pixel, read from a file with Blender's passes, denoised, and written: one after the other. A "
        "sequence of frames is read, denoised and written at the same time, and takes less. The first frame starts "
        "the command, "
        f'with programs kept.</p>{stacks.draw(bars)}<p class="legend">{stacks.legend()}</p>'
        f"{_rows(['ms', *stacks.COLORS, 'all'], rows)}</section>"
        if bars
        else ""
    )


def _breakdown(data: Mapping[str, Any], size: str) -> str:
    """One frame in parts, of the denoisers that can be taken apart."""
    rows, head = [], ["ms"]
    for name, parts in data["breakdown"].items():
        head = ["ms", *parts]
        whole = parts[WHOLE]["median_ms"]
        cells = [
            number(part["median_ms"]) + ("" if label == WHOLE else f" ({part['median_ms'] / whole:.0%})")
            for label, part in parts.items()
        ]
        rows.append([escape(name), *cells])
    return (
        f'<section id="breakdown"><h2>One {size} frame in parts</h2><p class="note">Each part is a program of '
        "its own; the whole step is one, and shares memory between its parts.</p>"
        f"{_rows(head, rows)}</section>"
        if rows
        else ""
    )


def _making(data: Mapping[str, Any]) -> str:
    facts = {**data["machine"], "fingerprint of settings and machine": data["fingerprint"]}
    rows = "".join(f'<tr><th scope="row">{escape(str(k))}</th><td>{escape(str(v))}</td></tr>' for k, v in facts.items())
    return (
        f'<section id="made"><h2>How this was made</h2><table class="facts"><tbody>{rows}</tbody></table>'
        '<p class="note">All raw numbers lie next to this page in <code>chart.json</code>.</p></section>'
    )


def _rows(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; cells are HTML, the first of each row is its heading."""
    titles = "".join(f'<th scope="col">{escape(title)}</th>' for title in head)
    lines = "".join(
        f'<tr><th scope="row">{row[0]}</th>{"".join(f"<td>{cell}</td>" for cell in row[1:])}</tr>' for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{titles}</tr></thead><tbody>{lines}</tbody></table></div>'


def number(value: float | None, places: int = 0) -> str:
    """A number as text, an en dash where it is not known."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    return f"{value:.{places}f}" if places or value >= 10 else f"{value:.2g}"
