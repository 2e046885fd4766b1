"""Files of Blender, there and back: the table, and a few kinds by the real Blender."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.cycles.round_trip_table import COLUMNS, table
from experiments.results_page import results_page

ROOT = Path(__file__).parents[2]


def test_the_rows_become_a_table_of_the_results_page() -> None:
    row = {key: number for number, key in enumerate(COLUMNS)} | {"kind": "half, DWAA", "seam": {"step": 1.0}}
    settings = {"blender": "5.0.1", "size": [160, 90], "samples": 1, "reference": 256, "method": "svgf"}
    found = table({"settings": settings, "rows": [row]}, "The machine was loaded.")
    assert len(found["columns"]) == len(found["rows"][0])
    assert "that Blender 5.0.1 writes, 1 sample a pixel, through `jaxdn denoise` by svgf" in found["what"]
    assert found["what"].endswith("The machine was loaded.")
    page = results_page([found | {"file": "files-blender.json"}])
    assert "| half, DWAA | 1 |" in page


KINDS = ("files", "subframes")


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_kinds_come_back_from_blender_and_openimageio(blender: Path, tmp_path: Path) -> None:
    command = [blender, "-m", "experiments.cycles.round_trip", tmp_path, "--python", sys.executable, "--kinds", *KINDS]
    command += ["--size", "48", "32", "--method", "taa", "--reference", "16"]
    ended = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, (ended.stdout + ended.stderr)[-3000:]
    rows = {row["kind"]: row for row in json.loads((tmp_path / "round-trip.json").read_text("utf-8"))["rows"]}
    assert tuple(rows) == KINDS
    for row in rows.values():
        assert (row["frames"], row["OpenImageIO"], row["Blender"]) == (3, 0, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["round-trip.json"]  # frames are kept on request alone
