"""The crossing of cases, subjects, precisions and directions, and what came of each.

python -m tests.hard_cases.table                # `make hard-cases`: everything, and the page
"""

import html
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tests.hard_cases.cases import CASES, Case, Inputs, good
from tests.hard_cases.subjects import Subject, denoiser_subjects, gradient_of, operation_subjects

DIRECTIONS = ("forward", "gradient")
ERROR_BOUND = {"float32": 2e-3, "bfloat16 inputs": 0.1}
"""Largest error against the same function in double precision on the same inputs, relative to its largest value."""
STEEPEST = 1e9
"""A gradient beyond this is as good as infinite to an optimiser."""


_MOST, _LEAST = float(np.finfo(np.float32).max), float(np.finfo(np.float32).tiny)


class Row(NamedTuple):
    """One cell of the table."""

    case: str
    subject: str
    precision: str
    direction: str
    finite: bool
    largest: float
    """Largest magnitude that came out."""
    error: float | None
    """Against double precision, where that is finite; None where there is nothing to compare."""
    verdict: str
    """``green``, ``red``, or ``input`` where a pure function hands on what was no number before."""
    told: str


def rows(
    cases: Iterable[Case],
    subjects: Sequence[Subject],
    *,
    precisions: Sequence[str] = tuple(ERROR_BOUND),
    directions: Sequence[str] = DIRECTIONS,
) -> Iterator[Row]:
    """Every cell, one compiled program for each subject, precision and direction."""
    made = {case.name: case.make(good()) for case in cases}
    for subject in subjects:
        for direction in directions:
            function = subject.run if direction == "forward" else gradient_of(subject)
            for precision in precisions:
                run = jax.jit(function)
                for name, inputs in made.items():
                    given = _cast(inputs, precision)
                    found = _leaves(run(subject.params, given))
                    truth = _leaves(_in_double(function, subject.params, given)) if _compared(subject) else None
                    yield _judge(name, subject, precision, direction, found, truth, given)


def _compared(subject: Subject) -> bool:
    # A network's own arithmetic in bfloat16 has no double.
    return "bfloat16" not in subject.name


def _cast(inputs: Inputs, precision: str) -> Inputs:
    """Half-precision inputs are what a file or a GPU hands over."""
    if precision == "float32":
        return inputs

    def half(array: Any) -> Any:
        array = np.asarray(array)
        return array.astype(jnp.bfloat16) if array.dtype == np.float32 else array

    return jax.tree.map(half, inputs)


_doubles: dict[Any, Callable[..., Any]] = {}


def _in_double(function: Callable[..., Any], params: Any, inputs: Inputs) -> Any:
    """The same function with every number in double precision."""
    with jax.enable_x64(True):

        def widen(array: Any) -> Any:
            array = np.asarray(array)
            if not jnp.issubdtype(array.dtype, jnp.floating):
                return jnp.asarray(array)
            wide = array.astype(np.float64)
            return jnp.asarray(np.where(np.abs(wide) < _LEAST, 0.0, wide))  # as the hardware reads them

        run = _doubles.setdefault(function, jax.jit(function))
        return jax.tree.map(np.asarray, run(jax.tree.map(widen, params), jax.tree.map(widen, inputs)))


def _leaves(tree: Any) -> np.ndarray:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    kept = [leaf.astype(np.float64).ravel() for leaf in leaves if leaf.dtype != jax.dtypes.float0]
    return np.concatenate(kept) if kept else np.zeros(0)


def _judge(
    case: str,
    subject: Subject,
    precision: str,
    direction: str,
    found: np.ndarray,
    truth: np.ndarray | None,
    inputs: Inputs,
) -> Row:
    finite = np.isfinite(found)
    largest = float(np.max(np.abs(found[finite]), initial=0.0))
    representable = np.isfinite(truth) & (np.abs(truth) <= _MOST) if truth is not None else finite
    error = None
    # A pure function of infinity saturates at the largest number of its own precision: nothing to compare there.
    if truth is not None and (subject.repairs or _usable(inputs)):
        both = finite & representable
        # Below the smallest normal number XLA:CPU rounds to 0, as most hardware does.
        scale = max(float(np.max(np.abs(truth[both]), initial=0.0)), 1e3 * _LEAST)
        error = float(np.max(np.abs(found[both] - truth[both]), initial=0.0)) / scale

    # What double precision cannot make finite either comes from the input, or from the true value (an infinite PSNR).
    excused = np.zeros_like(finite) if truth is None or subject.repairs else ~representable
    verdict, told = "green", ""
    if not np.all(finite | excused):
        verdict, told = "red", f"{int(np.sum(~finite & ~excused))} values are not finite"
    elif direction == "gradient" and largest > STEEPEST and subject.repairs:
        verdict, told = "red", f"a gradient of {largest:.1e}"
    elif direction == "forward" and found.size and (found[finite].min(initial=0) < subject.bounds[0] - 1e-6):
        verdict, told = "red", f"{found[finite].min():.3g} is below {subject.bounds[0]:g}"
    elif direction == "forward" and largest > subject.bounds[1]:
        verdict, told = "red", f"{largest:.3g} is above {subject.bounds[1]:g}"
    elif direction == "forward" and error is not None and error > ERROR_BOUND[precision]:
        verdict, told = "red", f"relative error {error:.1e}"
    elif not np.all(finite):
        verdict, told = "input", "not finite in double precision either"
    return Row(case, subject.name, precision, direction, bool(np.all(finite)), largest, error, verdict, told)


def _usable(inputs: Inputs) -> bool:
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(inputs))
    return all(np.all(np.isfinite(leaf.astype(np.float64))) for leaf in leaves)


def write_page(table: Sequence[Row], folder: Path) -> Path:
    """``table.json`` and ``table.html``: cases down, subjects across, the worst of each cell, and why on hover."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.json").write_text(json.dumps([row._asdict() for row in table], indent=0, default=str))
    worst = {"green": 0, "input": 1, "red": 2}
    cells: dict[tuple[str, str], list[Row]] = {}
    for row in table:
        cells.setdefault((row.case, row.subject), []).append(row)
    cases, subjects = (list(dict.fromkeys(key[axis] for key in cells)) for axis in (0, 1))
    counts = {verdict: sum(row.verdict == verdict for row in table) for verdict in worst}
    head = "".join(f"<th><div>{html.escape(subject)}</div></th>" for subject in subjects)
    body = []
    for case in cases:
        line = [f"<th title='{html.escape(CASES[case].sentence)}'>{html.escape(case)}</th>"]
        for subject in subjects:
            found = cells.get((case, subject), [])
            verdict = max((row.verdict for row in found), key=worst.__getitem__, default="none")
            errors = [row.error for row in found if row.error is not None and row.direction == "forward"]
            told = "; ".join(f"{row.precision}, {row.direction}: {row.told}" for row in found if row.told)
            shown = f"{max(errors):.0e}" if errors and max(errors) > 0 else "0" if errors else ""
            line.append(f"<td class='{verdict}' title='{html.escape(told)}'>{shown}</td>")
        body.append(f"<tr>{''.join(line)}</tr>")
    page = folder / "table.html"
    page.write_text(
        f"""<!doctype html><meta charset="utf-8"><title>Hard cases</title><style>
body{{font:14px system-ui;margin:2em}}table{{border-collapse:collapse}}
td{{min-width:3em;text-align:center;border:1px solid #ccc}}th{{text-align:left;font-weight:normal;padding:2px 8px}}
thead th div{{writing-mode:vertical-rl;transform:rotate(180deg)}}
.green{{background:#cfe8cf}}.red{{background:#f0b0a8}}.input{{background:#eee}}</style>
<h1>Hard cases</h1><p>{counts["green"]} green, {counts["red"]} red, {counts["input"]} handed on what was no number in
the input (a pure function need not hide it). Cells show the worst forward error against double precision, relative to
the largest value; point at a cell to read what was found, at a case to read where it happens.</p>
<table><thead><tr><th></th>{head}</tr></thead><tbody>{"".join(body)}</tbody></table>"""
    )
    return page


def main() -> int:
    """Run everything, write the page, list what is red; the exit code says whether anything is."""
    table: list[Row] = []
    for subject in [*operation_subjects(), *denoiser_subjects()]:
        table += rows(CASES.values(), [subject])
        red = [row for row in table if row.subject == subject.name and row.verdict == "red"]
        print(f"{subject.name}: {'green' if not red else f'{len(red)} red'}", flush=True)
    page = write_page(table, Path("runs/hard-cases"))
    red = [row for row in table if row.verdict == "red"]
    for row in red:
        print(f"red: {row.subject}, {row.case}, {row.precision}, {row.direction}: {row.told}")
    print(f"{len(table)} cells, {len(red)} red: {page}")
    return 1 if red else 0


if __name__ == "__main__":
    sys.exit(main())
