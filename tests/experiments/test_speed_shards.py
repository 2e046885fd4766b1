"""The measurement of shards, on small ones: all of it, with real processes and a damaged file."""

import json
import sys
from pathlib import Path

import pytest

from experiments.speed import shards
from experiments.speed.shards import Part, Settings, join, main

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="ArrayRecord does not support Windows")


def test_the_elements_of_several_processes_come_in_the_order_of_one() -> None:
    parts = [Part([[f"{batch}{process}", f"{batch}{2 + process}"] for batch in "ab"], 0, 0, None) for process in (0, 1)]
    assert join(parts) == [["a0", "a1", "a2", "a3"], ["b0", "b1", "b2", "b3"]]


@pytest.mark.slow
def test_shards_are_measured_and_damage_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {"mib": 2.0, "crop": 16, "frames": 2, "side": 32, "batch": 4, "batches": 2}
    monkeypatch.setattr(shards, "PROCESSES", (1, 2))  # four: tests/data/test_shards.py
    main(Settings(**small, folder=tmp_path, out=tmp_path / "out.json"))
    told = json.loads((tmp_path / "out.json").read_text())
    found, said = dict(told["rows"]), capsys.readouterr().out
    assert all(name in said for name in found)
    assert "the same batches" not in found["read by 1"]
    assert all(found[f"read by {count}"].endswith(", the same batches") for count in (2,))
    assert found["one bit flipped in the largest"].startswith("windows-00000.arrayrecord: the shard is damaged: ")
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]
