"""The validation page as one string: findings, figures and the player; it opens from disk, and asks no server."""

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from jaxdn.evaluation.overlay.findings import Finding
from jaxdn.evaluation.overlay.views import LEGEND
from jaxdn.evaluation.report.images import data_address
from jaxdn.evaluation.report.page import json_script

FIGURES = {
    "noise": ("noise of the light", ".1%"),
    "albedo noise": ("noise of albedo", ".3f"),
    "normal noise": ("noise of normal", ".3f"),
    "fireflies": ("fireflies", ".3%"),
    "invalid": ("NaN or infinite", ".3%"),
    "rejected": ("pixels without history", ".1%"),
    "history": ("mean history, frames", ".1f"),
    "certain": ("pixels with measured motion", ".0%"),
    "disagrees": ("given differs from measured motion", ".1%"),
    "camera differs": ("given differs from the camera's motion", ".1%"),
    "unit normals": ("normals of length 1", ".0%"),
}
"""Figures of the table -> label and format."""


def overlay_page(
    title: str,
    names: Sequence[str],
    figures: Sequence[Mapping[str, float]],
    findings: Sequence[Finding],
    films: Mapping[str, Sequence[bytes | None]],
    facts: Mapping[str, str],
) -> str:
    """The whole document.

    Args:
      title: the shot.
      names: of all its frames.
      figures: of all its frames.
      findings: what is wrong.
      films: view -> the file of each picture, of the first frames; None where a frame has none.
      facts: what else to tell, label -> text.
    """
    shown = len(next(iter(films.values()), ()))
    data: dict[str, Any] = {
        "names": list(names[:shown]),
        "legend": LEGEND,
        "views": {
            view: [None if one is None else data_address(one) for one in films[view]]
            for view in LEGEND
            if view in films
        },
    }
    here, report = files("jaxdn.evaluation.overlay"), files("jaxdn.evaluation.report")
    style = report.joinpath("page.css").read_text("utf-8")
    body = [
        f'<header><h1>{escape(title)}</h1><p class="note">{len(names)} frames, complete in this file</p></header>',
        _findings(findings),
        '<section id="pictures"><h2>Frames</h2><p class="note"><kbd>Space</kbd> plays, <kbd>,</kbd> and <kbd>.</kbd> '
        f"step. The first {shown} frames are shown.</p>"
        "<noscript><p>The player needs JavaScript, which this page contains.</p></noscript>"
        '<div id="player"></div></section>' if shown else "",
        _table(names, figures),
        _facts(facts),
    ]  # fmt: skip
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            # The page is complete; this policy makes the browser block every request.
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
            "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>\n{style}\n#player img {{ width: 100%; image-rendering: pixelated; }}</style></head>",
            "<body><main>",
            *body,
            "</main>",
            json_script(data, 'id="overlay-data"'),
            f"<script>\n{here.joinpath('overlay.js').read_text('utf-8')}</script>" if shown else "",
            "</body></html>",
            "",
        ]
    )


def _findings(findings: Sequence[Finding]) -> str:
    if not findings:
        return '<section id="summary"><h2>Findings</h2><p>Nothing was found.</p></section>'
    rows = "".join(
        f"<li><b>{escape(each.name)}</b>. {escape(each.evidence)} <br><i>{escape(each.remedy)}</i></li>"
        for each in findings
    )
    return f'<section id="summary"><h2>Findings</h2><ul>{rows}</ul></section>'


def _table(names: Sequence[str], figures: Sequence[Mapping[str, float]]) -> str:
    """Frames down, figures across; the mean first."""
    keys = [key for key in FIGURES if any(key in each for each in figures)]
    head = "".join(f'<th scope="col">{FIGURES[key][0]}</th>' for key in keys)
    mean = {key: float(np.mean([each[key] for each in figures if key in each])) for key in keys}
    rows = [
        f'<tr><th scope="row">{escape(name)}</th>{"".join(_cell(each, key) for key in keys)}</tr>'
        for name, each in [("mean", mean), *zip(names, figures, strict=True)]
    ]
    return (
        f'<section id="figures"><h2>Figures</h2><div class="scroll"><table><thead><tr><th scope="col">Frame</th>{head}'
        f"</tr></thead><tbody>{''.join(rows)}</tbody></table></div></section>"
    )


def _cell(figures: Mapping[str, float], key: str) -> str:
    return f"<td>{figures[key]:{FIGURES[key][1]}}</td>" if key in figures else "<td>–</td>"


def _facts(facts: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(key)}</th><td>{escape(value)}</td></tr>' for key, value in facts.items()
    )
    return f'<section id="made"><h2>What was read</h2><table class="facts"><tbody>{rows}</tbody></table></section>'
