"""One page of results: docs/results/index.md and the block in the README, made from docs/results/*.json.

    python -m experiments.results_page        # or: make results

Each JSON file is one measurement. It says what was measured (``title``, ``what``, ``section``, ``order``), where and
when (``measured``: revision, date, machine) and by which command. ``kind`` says how its rows are shown:

* ``table``: ``columns`` and ``rows`` as they are. A column may have ``decimals``, and ``best`` ("higher" or "lower"):
  then its best value is bold, or the best of each ``group``. ``best_in_row`` marks the best number of each row instead.
  ``row_revisions`` are those of the rows, if they differ.
* ``frames``: the rows of ``python -m experiments.speed.frames``, one table for each size.
* ``bench``: the rows of ``make bench``, one line for each workload and implementation.
* ``raw``: no table; another file names it as its ``raw`` data.

A file with ``claims`` says what holds of a paper: claim, paper, here, verdict; the end of the page has those of all.
A file with ``readme`` is in the README too: the part of it that ``columns``, ``rows`` and ``where`` choose.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
BEGIN, END = "<!-- results: written by make results -->", "<!-- /results -->"
OIDN = "Open Image Denoise high"
BACKEND_COLUMNS = {
    "onednn-bfloat16": "oneDNN, bfloat16",
    "onednn-float32": "oneDNN, float32",
    "xla": "XLA",
    "onnxruntime": "ONNX Runtime",
    "reference": "XLA, no Numba kernels",
}
"""Backend in the rows of ``frames`` -> column."""
PEERS = {
    "torch-compiled": "of PyTorch compiled",
    "torch-eager": "of PyTorch eager",
    "oidn-high": f"of {OIDN}",
    "oidn-files": "of Open Image Denoise, file to file",
    "step": "of the method's step alone",
    "roofline": "of the roofline",
}
"""Peer in the rows of ``bench`` -> column."""
HEAD = """# Results

`make results` writes this page and the tables of the README from `docs/results/*.json`. Do not edit it.
PSNR is in dB and higher is better. Lower is better for FLIP, L1 and relative MSE. *Disoccluded* pixels are those that
the previous frame did not see. The revision is that of the commit that recorded the numbers, and has the command that
did it; later ones may lack it. The best value of a
column, of each group of its rows, or of a row that compares methods, is bold.
"""
CLAIMS = """## What the papers claim

The claims of all tables above. Each table says with which clips and how many updates it was made; the papers have whole
scenes, and thousands of updates. *Holds*: in the range of the paper; where that has a distance, at least half of it;
where it has no number, with its sign. *Chance*: less than a tenth of a decibel. *Not stated*: the paper has no such
figure, and ours stands alone.
"""

Result = Mapping[str, Any]


def read_results(folder: Path = RESULTS) -> list[Result]:
    """All measurements of a folder, by ``order``; each has its file name as ``file``.

    Raises ValueError, naming the file, where one lacks what a reader has to know.
    """
    results = [{**json.loads(path.read_text("utf-8")), "file": path.name} for path in folder.glob("*.json")]
    for result in results:
        missing = {"kind", "title", "section", "order", "measured", "what"} - set(result)
        missing |= {"revision", "date", "machine"} - set(result.get("measured", ()))
        if missing:
            raise ValueError(
                f"{result['file']}: expected {', '.join(sorted(missing))}; add what is missing to the file."
            )
        if result["kind"] not in _TABLES:
            raise ValueError(f"{result['file']}: expected a kind out of {', '.join(_TABLES)}, got {result['kind']!r}.")
        for row in result["rows"] if result["kind"] == "table" else ():
            if len(row) != len(result["columns"]):
                raise ValueError(f"{result['file']}: expected {len(result['columns'])} values in each row, got {row}.")
    return sorted(results, key=lambda result: (result["order"], result["file"]))


def results_page(results: Sequence[Result]) -> str:
    """The text of docs/results/index.md."""
    parts, section = [HEAD], None
    for result in results:
        if result["kind"] == "raw":
            continue
        if result["section"] != section:
            section = result["section"]
            parts.append(f"## {section}\n")
        parts += [f"### {result['title']}\n", f"{result['what']}\n", *_TABLES[result["kind"]](result), _notes(result)]
        if picture := result.get("picture"):
            parts.append(f"![{picture['alt']}]({picture['file']})\n\n*{picture['caption']}*\n")
        parts.append(_provenance(result))
    parts += _claims(results)
    return "\n".join(part for part in parts if part)


def _claims(results: Sequence[Result]) -> list[str]:
    """The claims of papers of all measurements that have some, in one table."""
    lines = [
        [result["title"], claim["claim"], claim["paper"], claim["here"], claim["verdict"]]
        for result in results
        for claim in result.get("claims", ())
    ]
    return [CLAIMS, _markdown(["table", "claim", "paper", "here", ""], lines)] if lines else []


def readme_block(results: Sequence[Result]) -> str:
    """What stands between the markers of the README."""
    parts = []
    for result in results:
        if "readme" in result:
            chosen = _choose(result, **result["readme"])
            measured = result["measured"]
            head = f"**{result['title']}** ({measured['date']}, revision {measured['revision']}). {result['what']}"
            where = result["readme"].get("where", {})
            head += "".join(f" Shown: {name} = {value}." for name, value in where.items()) + "\n"
            parts += [head, *_TABLES[result["kind"]](chosen), _notes(chosen)]
    return "\n".join(part for part in parts if part)


def with_block(text: str, block: str) -> str:
    """``text`` with ``block`` between the markers. Raises ValueError where it has no markers."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"README.md: expected the markers {BEGIN} and {END}; put them where the tables belong.")
    return f"{before}{BEGIN}\n{block}\n{END}{after}"


def _choose(
    result: Result, columns: Sequence[str] = (), rows: Sequence[str] = (), where: Mapping[str, Any] | None = None
) -> Result:
    """A part of a table: rows whose columns have the values ``where``, and whose "method" is one of ``rows``, in that
    order in each group."""
    if result["kind"] != "table":
        return result
    names = [column["name"] for column in result["columns"]]
    kept = [
        row for row in result["rows"] if all(row[names.index(key)] == value for key, value in (where or {}).items())
    ]
    if rows:
        group = names.index(result["group"]) if "group" in result else None
        found = {(None if group is None else row[group], row[names.index("method")]): row for row in kept}
        if absent := sorted({(of, name) for of, _ in found for name in rows} - found.keys(), key=str):
            raise ValueError(f"{result['title']}: expected the rows that its readme names, found none of {absent}.")
        kept = [found[of, name] for of in dict.fromkeys(of for of, _ in found) for name in rows]
    places = [names.index(name) for name in columns or names]
    left_out = {"row_revisions"} | ({"group"} if result.get("group") not in (columns or names) else set())
    return {
        **{key: value for key, value in result.items() if key not in left_out},
        "columns": [result["columns"][place] for place in places],
        "rows": [[row[place] for place in places] for row in kept],
    }


def _table(result: Result) -> list[str]:
    columns, rows = result["columns"], result["rows"]
    names = [column["name"] for column in columns]
    groups = [row[names.index(result["group"])] if "group" in result else None for row in rows]
    lines = []
    for row, group in zip(rows, groups, strict=True):
        peers = [other for other, its in zip(rows, groups, strict=True) if its == group]
        best = [_is_best(row, place, peers, columns, result.get("best_in_row")) for place in range(len(row))]
        texts = [_text(value, column.get("decimals")) for value, column in zip(row, columns, strict=True)]
        lines.append([f"**{text}**" if bold else text for text, bold in zip(texts, best, strict=True)])
    if "row_revisions" in result:
        names, lines = (
            [*names, "revision"],
            [[*line, revision] for line, revision in zip(lines, result["row_revisions"], strict=True)],
        )
    return [_markdown(names, lines)]


def _is_best(
    row: Sequence[Any],
    place: int,
    peers: Sequence[Sequence[Any]],
    columns: Sequence[Mapping[str, Any]],
    across: str | None,
) -> bool:
    """Whether a number is the best of its column among ``peers``, or of its row if ``across`` says what is better."""
    wanted = across or columns[place].get("best")
    if across:
        known = [
            value for value, column in zip(row, columns, strict=True) if "decimals" in column and value is not None
        ]
        if "decimals" not in columns[place]:
            return False
    else:
        known = [peer[place] for peer in peers if isinstance(peer[place], int | float)]
    if wanted is None or not known:
        return False
    return bool(row[place] == (max(known) if wanted == "higher" else min(known)))


def _frames(result: Result) -> list[str]:
    """One table for each size: methods by backends, milliseconds, and their ratio to the peer if that run has it."""
    rows, tables = result["rows"], []
    for width, height in dict.fromkeys((row["width"], row["height"]) for row in rows):
        here = [row for row in rows if (row["width"], row["height"]) == (width, height)]
        reference = {row["run"]: row["ms"] for row in here if row["implementation"] == OIDN}
        times: dict[tuple[str, int], dict[str, float]] = {}
        for row in here:
            method, _, backend = row["implementation"].partition(", ")
            if backend:
                times.setdefault((method, row["run"]), {})[backend] = row["ms"]
        backends = [backend for backend in BACKEND_COLUMNS if any(backend in found for found in times.values())]
        lines = [
            [
                f"`{method}`",
                str(run),
                *(_ratio(found.get(backend), reference.get(run)) for backend in backends),
                _ms(reference[run]) if run in reference else "",
            ]
            for (method, run), found in times.items()
        ]
        head = [f"{width} x {height}", "run", *(BACKEND_COLUMNS[backend] for backend in backends), OIDN]
        tables.append(_markdown(head, lines))
    return tables


def _bench(result: Result) -> list[str]:
    """One line for each workload and implementation, with a column for each peer."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in result["rows"]:
        entry = found.setdefault((row["work"], row["implementation"]), {"ms": row["median_ms"], "mib": row["peak_mib"]})
        entry[row["against"]] = row["ratio"]
    peers = [peer for peer in PEERS if any(peer in entry for entry in found.values())]
    lines = [
        [
            work,
            implementation,
            _ms(entry["ms"]),
            _text(entry["mib"] and round(entry["mib"])),
            *(_text(entry.get(p), 2) for p in peers),
        ]
        for (work, implementation), entry in found.items()
    ]
    return [
        _markdown(["workload", "implementation", "median, ms", "peak, MiB", *(PEERS[peer] for peer in peers)], lines)
    ]


_TABLES: Mapping[str, Callable[[Result], list[str]]] = {
    "table": _table,
    "frames": _frames,
    "bench": _bench,
    "raw": lambda result: [],
}


def _markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def _text(value: Any, decimals: int | None = None) -> str:
    """A cell: numbers with a fixed number of decimals, or as short as they are; nothing for None."""
    if value is None:
        return ""
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.{decimals}f}" if decimals is not None else f"{value:.10f}".rstrip("0").rstrip(".")
    return str(value)


def _ms(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def _ratio(value: float | None, reference: float | None) -> str:
    if value is None:
        return ""
    return _ms(value) if reference is None else f"{_ms(value)} ({value / reference:.2f})"


def _notes(result: Result) -> str:
    return "\n".join(f"- {note}" for note in result.get("notes", ())) + "\n" if result.get("notes") else ""


def _provenance(result: Result) -> str:
    measured = result["measured"]
    command = f" Command: `{result['command']}`." if "command" in result else ""
    raw = f", [raw data]({result['raw']})" if "raw" in result else ""
    return (
        f"*Revision {measured['revision']}, {measured['date']}. Machine: {measured['machine']}.{command} "
        f"[JSON]({result['file']}){raw}.*\n"
    )


def main() -> None:
    results = read_results()
    (RESULTS / "index.md").write_text(results_page(results), "utf-8")
    readme = ROOT / "README.md"
    readme.write_text(with_block(readme.read_text("utf-8"), readme_block(results)), "utf-8")


if __name__ == "__main__":
    main()
