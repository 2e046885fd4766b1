"""The classical family side by side: each filter has a row with its errors and its time, and with each demodulation."""

import json
import re

import pytest

from experiments.papers import classical, preintegration
from experiments.results_page import read_results, results_page
from jaxdn.zoo.ready import NOISY

WEIGHTS, FILTER = "ntd-small", "taa"


@pytest.mark.slow
@pytest.mark.needs("mitsuba")
@pytest.mark.usefixtures("plain_processes")
def test_filters_are_scored_and_timed(tmp_path, capsys, monkeypatch):
    # One of the shipped weights and the filter that is compiled soonest stand for all: each is compiled for the images
    # and for its time. The weights are timed on another backend, and compared with the filter.
    monkeypatch.setattr(classical, "shipped_names", lambda: [WEIGHTS])
    monkeypatch.setattr(classical, "filter_names", lambda: [FILTER])
    monkeypatch.setattr(classical, "AGAINST", FILTER)
    settings = classical.Settings(
        families=("fruit",),
        size=24,
        frames=2,
        reference_spp=4,
        timed=(24, 32),
        rounds=1,
        data=tmp_path / "data",
        out=tmp_path / "out",
        workers=1,
    )
    classical.main(settings)
    written, said = (tmp_path / "out" / "table.md").read_text(), capsys.readouterr().out
    assert written.strip() in said
    for light in classical.LIGHTS:
        assert (tmp_path / "out" / light / "report.html").is_file()
        assert (tmp_path / "out" / light / "pictures" / "fruit-2000" / f"{FILTER}.png").is_file()
    rows = [line.split(" | ") for line in written.splitlines() if line.startswith("| ")]
    for name in (FILTER, WEIGHTS):
        own = [row for row in rows if row[0] == f"| {name}"]
        assert len(own) == 2
        for row in own:
            assert float(row[1]) > 0
            # Where memory is short, as beside other work, a method is left out of the times, and this is said.
            timed = f"{name} is left out" not in said
            assert re.fullmatch(r"\d+ \((\d+\.\d\d|nan)\) \|" if timed else r" ?\|", row[-1])
    assert {row[-1].strip() for row in rows if row[0] == f"| {NOISY}"} == {"|"}
    # The page of results takes what is written for it: PSNR of both lights, as in the table.
    page = results_page(read_results(tmp_path / "out"))
    (shown,) = (line for line in page.splitlines() if line.startswith(f"| `{FILTER}` | ") and line.count("|") == 10)
    psnr = [row[1] for row in rows if row[0] == f"| {FILTER}"]
    cells = [cell.strip(" *") for cell in shown.split("|")]
    assert [cells[2], cells[6]] == psnr
    # Clips of all reflected light are those on which ways to demodulate are compared.
    monkeypatch.setattr(preintegration, "shipped_names", list)
    monkeypatch.setattr(preintegration, "filter_names", lambda: [FILTER, "svgf"])
    preintegration.main(preintegration.Settings([tmp_path / "data" / "reflected"], out=tmp_path / "demodulation"))
    recorded = json.loads((tmp_path / "demodulation" / "demodulation.json").read_text())
    assert [column["name"] for column in recorded["columns"]] == ["method", "`brdf`", "`albedo`", "`none`"]
    ((name, *scores),) = recorded["rows"]
    assert name == "`svgf`"
    assert len(set(scores)) == 3
    assert "### Demodulation factors" in results_page([recorded | {"file": "demodulation.json"}])
