"""The page: every case against every denoiser and operation, the worst result of each cell, with pictures."""

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jax

from jaxdn.runtime.atomic_files import write_atomically
from tests.hard_cases.cases import CASES
from tests.hard_cases.invariances import Deviation
from tests.hard_cases.table import DIRECTIONS, PRECISIONS, Row

Pictures = Mapping[tuple[str, str], str]
"""(case, function) -> the address of a PNG."""

_WORST = ("none", "green", "input", "red")
_STYLE = """
body{font:14px/1.5 system-ui,sans-serif;margin:2em;color:#222;max-width:100%}p,li{max-width:52em}
.wide{overflow:auto;max-height:85vh;width:fit-content;max-width:100%;border:1px solid #ccc}
table{border-collapse:separate;border-spacing:0;font-size:12px;font-variant-numeric:tabular-nums}
td,th{border-right:1px solid #ddd;border-bottom:1px solid #ddd;padding:1px 6px;white-space:nowrap;background:#fff}
td{text-align:right}th{text-align:left;font-weight:normal}td a,th a{color:inherit;text-decoration:none}
td a:hover,th a:hover{text-decoration:underline}
thead th{position:sticky;top:0;z-index:1;vertical-align:bottom}tbody th{position:sticky;left:0}
thead th:first-child{left:0;z-index:2}.up{writing-mode:vertical-rl;transform:rotate(180deg);padding:4px 0}
small{display:block;color:#777;line-height:1.1}
.green{background:#dcefdc}.red{background:#f0a59b}.input{background:#e4e4e4}
.none{background:#f6f6f6}.key{padding:1px 8px}
section{border-top:1px solid #ddd;padding:.5em 0;scroll-margin-top:1em}h3{margin:.3em 0}
figure{display:inline-block;margin:0 10px 8px 0;vertical-align:top}figcaption{font-size:12px;color:#555}
img{width:132px;max-height:132px;image-rendering:pixelated;display:block;border:1px solid #ccc}
figure:target,section:target h3{background:#fff3b0}
"""


def write_page(
    table: Sequence[Row], folder: Path, *, deviations: Sequence[Deviation] = (), pictures: Pictures | None = None
) -> Path:
    """``table.json`` and ``table.html`` in ``folder``: cases down, functions across, each cell linked to its case."""
    folder.mkdir(parents=True, exist_ok=True)
    counts = {verdict: sum(row.verdict == verdict for row in table) for verdict in _WORST}
    cells: dict[tuple[str, str], list[Row]] = {}
    for row in table:
        cells.setdefault((row.case, row.function), []).append(row)
    cases = list(dict.fromkeys(row.case for row in table))
    kinds = {kind: list(dict.fromkeys(row.function for row in table if row.kind == kind)) for kind in _kinds(table)}
    pictures = pictures or {}
    tables = "".join(_table(kind, cases, functions, cells, pictures) for kind, functions in kinds.items())
    red = [row for row in table if row.verdict == "red"]
    body = f"""<h1>Hard cases</h1>
<p>{len(cases)} cases, {sum(map(len, kinds.values()))} functions, {len(table)} cells: <span class="green key">
{counts["green"]} green</span> <span class="red key">{counts["red"]} red</span> <span class="input key">
{counts["input"]} pass on</span> NaN or infinity of the input, or have no finite true value (the PSNR of identical
images), as a pure function may and a denoiser may not;
{counts["none"]} have no gradient. Compiled by jax {jax.__version__} for {jax.default_backend()}.
</p>
<p>Green is finite, within its bounds, and close to the same function in double precision. Numbers are the largest
difference from it, relative to the largest value (small ones: bfloat16 inputs); – is
where infinity in the input leaves nothing to compare. Point at
a cell for all its results; click it for the case{" and its pictures" if pictures else ""}.</p>
{_list("Red", red) if red else ""}{tables}{_deviations(deviations) if deviations else ""}
<h2>Cases</h2>{"".join(_section(case, cells, pictures) for case in cases)}"""
    page = folder / "table.html"
    document = f'<!doctype html><meta charset="utf-8"><title>Hard cases</title><style>{_STYLE}</style>{body}\n'
    record = {"rows": [row._asdict() for row in table], "deviations": [one._asdict() for one in deviations]}
    write_atomically({page: document, folder / "table.json": json.dumps(record, indent=0, default=str) + "\n"})
    return page


def _kinds(table: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row.kind for row in table))


def _anchor(case: str, function: str | None = None) -> str:
    return html.escape("--".join(part.replace(" ", "-").replace(",", "") for part in (case, function) if part))


def _sentence(case: str) -> str:
    sentence = CASES[case].sentence
    return f"{sentence[0].upper()}{sentence[1:]}."


def _number(error: float | None) -> str:
    return "–" if error is None else "0" if error == 0 else f"{error:.0e}".replace("e-0", "e-")


def _described(row: Row) -> str:
    error = "nothing to compare" if row.error is None else f"error {row.error:.1e}"
    return f"{row.precision}, {row.direction}: {row.reason or 'finite'}, {error}, largest {row.largest:.3g}"


def _table(
    kind: str,
    cases: Sequence[str],
    functions: Sequence[str],
    cells: Mapping[tuple[str, str], Sequence[Row]],
    pictures: Pictures,
) -> str:
    """Denoisers have a column for each precision and direction, operations one with two forward errors."""
    wide = kind == "denoiser"
    ways = [(precision, direction) for precision in PRECISIONS for direction in DIRECTIONS] if wide else [None]
    head = []
    for function in functions:
        for way in ways:
            label = function if way is None else f"{function}: {way[0]}, {way[1]}"
            head.append(f"<th><div class='up'>{html.escape(label)}</div></th>")
    body = []
    for case in cases:
        where = html.escape(_sentence(case), quote=True)
        line = [f'<th title="{where}"><a href="#{_anchor(case)}">{html.escape(case)}</a></th>']
        for function in functions:
            place = _anchor(case, function) if (case, function) in pictures else _anchor(case)
            for way in ways:
                found = [
                    row for row in cells.get((case, function), ()) if way in (None, (row.precision, row.direction))
                ]
                line.append(_cell(found, place))
        body.append(f"<tr>{''.join(line)}</tr>\n")
    rows = "".join(body)
    return f"<h2>{kind.capitalize()}s</h2><div class='wide'><table><thead><tr><th></th>{''.join(head)}</tr></thead>\
<tbody>{rows}</tbody></table></div>"


def _cell(found: Sequence[Row], place: str) -> str:
    """One row's error, or of several rows the forward error of each precision, in the color of the worst."""
    if not found:
        return "<td></td>"
    verdict = max((row.verdict for row in found), key=_WORST.index)
    shown = [_number(row.error) for row in found if len(found) == 1 or row.direction == "forward"]
    shown = shown or [_number(None)]
    numbers = shown[0] + "".join(f"<small>{number}</small>" for number in shown[1:] if number != shown[0])
    described = html.escape("\n".join(map(_described, found)), quote=True)
    return f'<td class="{verdict}" title="{described}"><a href="#{place}">{numbers}</a></td>'


def _list(title: str, found: Iterable[Row]) -> str:
    lines = (
        f'<li><a href="#{_anchor(row.case)}">{html.escape(f"{row.function}, {row.case}")}</a>: '
        f"{html.escape(_described(row))}"
        for row in found
    )
    return f"<h2>{title}</h2><ul>{''.join(lines)}</ul>"


def _section(case: str, cells: Mapping[tuple[str, str], Sequence[Row]], pictures: Pictures) -> str:
    shown = [
        f'<figure id="{_anchor(case, function)}"><img src="{address}" alt="{html.escape(f"{case}: {function}")}">'
        f"<figcaption>{html.escape(function)}</figcaption></figure>"
        for (one, function), address in pictures.items()
        if one == case
    ]
    faults = [row for (one, _), rows in cells.items() if one == case for row in rows if row.verdict == "red"]
    return (
        f'<section id="{_anchor(case)}"><h3>{html.escape(case)}</h3><p>{html.escape(_sentence(case))}</p>'
        f"{''.join(shown)}{_list('Red', faults) if faults else ''}</section>\n"
    )


def _deviations(deviations: Sequence[Deviation]) -> str:
    body = "".join(
        f"<tr><th>{html.escape(one.change)}</th><th>{html.escape(one.method)}</th><td>{one.difference:.1e}</td>"
        f"<td>{one.error:.1e}</td><td>{one.difference / one.error:.2f}</td></tr>\n"
        for one in deviations
    )
    return f"""<h2>Invariances of the learned networks</h2><p>A filter commutes with each of these changes of its
input; a network has only learned to. Its deviation: root mean square of the difference between the denoised change
and the changed denoised clip, relative to the clip's own root mean square; and how far the denoised clip is from its
reference in the same measure. A filter without weights is included for comparison.</p><table><thead><tr><th>change
</th><th>method</th><th>difference</th><th>error</th><th>ratio</th></tr></thead><tbody>{body}</tbody></table>"""
