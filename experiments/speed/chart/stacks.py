"""End to end, as stacked times: rendering, buffers, starting, reading, denoising, writing; first and later frames."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

from experiments.speed.chart.summary import render_cost

COLORS = {
    "rendering": "#7b8794",
    "buffers": "#b08d57",
    "starting": "#c05746",
    "reading": "#4f9d69",
    "denoising": "#3d6fb4",
    "writing": "#8a5fa8",
}
"""Stage -> colour, in the order in which they happen."""
SPP = 1
"""Samples per pixel of the rendered frame."""
_WIDTH, _LABEL, _BAR, _GAP = 900, 260, 18, 8
"""Of the picture, of the names in it, and of bars and what is between them."""


class Stack(NamedTuple):
    """One bar."""

    name: str
    parts: dict[str, float]
    """Stage -> milliseconds, in the order of :data:`COLORS`."""

    @property
    def total(self) -> float:
        """Milliseconds of all."""
        return sum(self.parts.values())


def stacks(data: Mapping[str, Any], size: str) -> list[Stack]:
    """Two bars for each method: its first frame, with the start of the command, and a frame in the steady state.

    Rendering and buffers are left out where their cost was not measured.
    """
    cost = render_cost(data, size)
    found: list[Stack] = []
    for method, taken in data["stages"].items():
        times: dict[str, float] = dict(taken["stages"])
        if cost is not None:
            times |= {"rendering": 1e3 * cost.at(SPP), "buffers": 1e3 * cost.buffers[taken["reads"]]}
        first = {stage: times[stage] for stage in COLORS if stage in times}
        later = {stage: ms for stage, ms in first.items() if stage != "starting"}
        found += [Stack(f"{method}, first frame", first), Stack(f"{method}, steady state", later)]
    return found


def draw(bars: Sequence[Stack]) -> str:
    """The bars as an SVG, on one scale."""
    most = max(bar.total for bar in bars)
    parts = []
    for index, bar in enumerate(bars):
        top, left = index * (_BAR + _GAP), float(_LABEL)
        parts.append(f'<text x="0" y="{top + _BAR - 4}" fill="currentColor">{escape(bar.name)}</text>')
        for stage, ms in bar.parts.items():
            width = (_WIDTH - _LABEL) * ms / most
            parts.append(
                f'<rect x="{left:.2f}" y="{top}" width="{width:.2f}" height="{_BAR}" fill="{COLORS[stage]}">'
                f"<title>{escape(bar.name)}: {stage} {ms:.0f} ms</title></rect>"
            )
            left += width
    height = len(bars) * (_BAR + _GAP)
    return f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="Stacked times">{"".join(parts)}</svg>'


def legend() -> str:
    """The colours of the stages."""
    return " ".join(f'<span><b style="color:{color}">■</b> {stage}</span>' for stage, color in COLORS.items())
