"""Runs of the whole table: kept results, worker processes, progress, the summary and the exit code."""

import json

import pytest

from tests.hard_cases import __main__ as command
from tests.hard_cases import run

NAMES = ("numerics.absolute", "color.luminance")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder of results; the two functions are all that there are."""
    monkeypatch.chdir(tmp_path)
    known = {name: run.functions()[name] for name in NAMES}
    monkeypatch.setattr(run, "functions", lambda: known)
    return tmp_path / run.FOLDER


def cells(name, verdict="green"):
    return [
        ["control", name, "operation", "float32", "forward", True, 1.0, 0.0, verdict, ""],
        ["black", name, "operation", "float32", "forward", True, 1.0, 0.0, "green", ""],
    ]


def store(name, state, **result):
    run.keep(name, state, lambda: {"rows": [], "pictures": {}, **result})


def test_results_are_made_once_in_each_state(folder):
    made = []

    def make():
        made.append(1)
        return {"rows": [len(made)]}

    assert run.keep("warp, clamp", "now", make)["rows"] == [1]
    assert run.keep("warp, clamp", "now", make)["rows"] == [1]
    assert run.keep("warp, clamp", "later", make)["rows"] == [2], "results of another state are not reused"
    assert [path.name for path in (folder / "results").iterdir()] == ["warp-clamp.json"]


def test_a_failed_function_leaves_no_result(folder):
    def fail():
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError):
        run.keep("warp, clamp", "now", fail)
    assert run.stored("warp, clamp") is None


@pytest.mark.parametrize("verdict", ["green", "red"])
def test_the_exit_code_says_whether_any_cell_is_red(folder, capsys, verdict):
    state = run.fingerprint()
    store(NAMES[0], state, rows=cells(NAMES[0]))
    store(NAMES[1], state, rows=cells(NAMES[1], verdict))
    store(run.INVARIANCES, state, deviations=[["mirrored", "ntd", 0.02, 0.1]])
    red = int(verdict == "red")
    assert command.main(command.Settings()) == red
    out = capsys.readouterr().out
    assert "3 of 3 results are kept" in out
    assert f"4 cells, {red} red" in out
    assert ("red: color.luminance, control, float32, forward" in out) == bool(red)
    summary = json.loads((folder / "summary.json").read_text())
    assert {name: summary[name] for name in ("functions", "cases", "cells", "green", "input", "red")} == {
        **{"functions": 2, "cases": 2, "cells": 4},
        **{"green": 4 - red, "input": 0, "red": red},
    }
    assert len(summary["red_cells"]) == red
    assert summary.keys() >= {"revision", "machine", "date", "seconds", "process_seconds"}
    assert "mirrored" in (folder / "table.html").read_text()


def test_results_of_another_state_are_said_to_be_computed_anew(folder, capsys):
    store(NAMES[0], "another", rows=cells(NAMES[0], "red"))
    command.announce(NAMES, run.fingerprint(), 2)
    out = capsys.readouterr().out
    assert "1 of 2 results are of another state of the code" in out
    assert "2 to run" in out


def test_a_name_without_a_function_is_refused(folder):
    with pytest.raises(ValueError, match=r"expected some out of numerics.absolute, color.luminance, got svfg"):
        command.main(command.Settings(["svfg"]))
    with pytest.raises(ValueError, match="workers: expected at least 1"):
        command.main(command.Settings(workers=0))


@pytest.mark.slow
def test_workers_run_functions_and_resume(folder, capsys):
    assert command.main(command.Settings(["numerics.absolute"], workers=2)) == 0
    first = (folder / "results" / "numerics.absolute.json").read_bytes()
    assert f"{run.CELLS} cells without red" in capsys.readouterr().out
    assert command.main(command.Settings(list(NAMES), workers=2)) == 0
    assert (folder / "results" / "numerics.absolute.json").read_bytes() == first, "kept"
    out = capsys.readouterr().out
    assert "1 of 2 results are kept" in out
    assert f"[2/2] color.luminance: {run.CELLS} cells without red" in out
    assert f"{2 * run.CELLS:,} of {2 * run.CELLS:,} cells, 0 red, 0 min left" in out
