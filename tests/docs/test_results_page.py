"""The page of results and the README's tables are what the command makes of docs/results/*.json."""

import json
import re

import pytest

from experiments import results_page
from experiments.results_page import RESULTS, ROOT, read_results, with_block

TABLE = {
    "kind": "table",
    "title": "A table",
    "section": "Quality",
    "order": 1,
    "measured": {"revision": "a5d75e0", "date": "2026-11-27", "machine": "two cores"},
    "what": "Two methods.",
    "columns": [
        {"name": "method"},
        {"name": "PSNR", "decimals": 1, "best": "higher"},
        {"name": "FLIP", "best": "lower"},
    ],
    "rows": [["a", 30.0, 0.25], ["b", 31.5, None]],
}


def written(folder, *results):
    for number, result in enumerate(results):
        (folder / f"{number}.json").write_text(json.dumps(result))
    return read_results(folder)


def rows_of(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]


def test_the_committed_page_is_what_the_command_makes():
    assert (RESULTS / "index.md").read_text("utf-8") == results_page.results_page(read_results())


def test_the_readme_has_what_the_command_makes():
    readme = (ROOT / "README.md").read_text("utf-8")
    assert readme == with_block(readme, results_page.readme_block(read_results()))


def test_every_measurement_has_a_revision_a_date_and_a_machine():
    for result in read_results():
        assert re.fullmatch(r"[0-9a-f]{7,40}", result["measured"]["revision"])
        assert re.fullmatch(r"\d{4}-\d{2}-\d{2}", result["measured"]["date"])
        assert result["measured"]["machine"]


def test_every_raw_file_and_picture_is_linked():
    results = read_results()
    page = results_page.results_page(results)
    for result in results:
        assert f"]({result['file']})" in page
        if "picture" in result:
            assert (RESULTS / result["picture"]["file"]).is_file()


def test_the_lead_on_cycles_frames_is_what_its_rows_say():
    cycles = next(result for result in read_results() if result["file"] == "quality-cycles.json")
    leads = {"default": [], "better": []}
    for _, _, _, default, without_blend, peer in cycles["rows"]:
        leads["default"].append(peer - default)
        leads["better"].append(peer - max(default, without_blend or default))
    for lead in leads.values():
        assert f"{min(lead):.1f} to {max(lead):.1f} dB" in cycles["notes"][0]


def test_the_best_of_a_column_is_bold(tmp_path):
    page = results_page.results_page(written(tmp_path, TABLE))
    assert rows_of(page)[2:] == [["a", "30.0", "**0.25**"], ["b", "**31.5**", ""]]
    assert "*Revision a5d75e0, 2026-11-27. Machine: two cores. [JSON](0.json).*" in page


def test_the_best_is_that_of_its_group(tmp_path):
    grouped = {**TABLE, "group": "method", "rows": [["a", 30.0, 0.5], ["a", 29.0, 0.4], ["b", 20.0, 0.6]]}
    page = results_page.results_page(written(tmp_path, grouped))
    bold = [[cell.startswith("**") for cell in row] for row in rows_of(page)]
    assert bold[2:] == [[False, True, False], [False, False, True], [False, True, True]]
    block = results_page.readme_block(written(tmp_path, {**grouped, "readme": {}}))
    assert rows_of(block) == rows_of(page)
    without = {"columns": ["PSNR"]}  # the column of the groups is not shown
    block = results_page.readme_block(written(tmp_path, {**grouped, "readme": without}))
    assert [row[0] for row in rows_of(block)[2:]] == ["**30.0**", "29.0", "20.0"]


def test_the_best_of_a_row_is_bold(tmp_path):
    columns = [{"name": "clip"}, {"name": "a", "decimals": 1}, {"name": "b", "decimals": 1}]
    across = {**TABLE, "best_in_row": "higher", "columns": columns}
    page = results_page.results_page(written(tmp_path, {**across, "rows": [["x", 1.0, 2.0], ["y", None, 3.0]]}))
    assert rows_of(page)[2:] == [["x", "1.0", "**2.0**"], ["y", "", "**3.0**"]]


def test_frames_are_methods_by_engines_beside_open_image_denoise(tmp_path):
    rows = [("Open Image Denoise high", 200.0), ("svgf, xla", 50.0), ("steady-fast, onednn-float32", 150.0)]
    frames = [{"run": 1, "width": 4, "height": 2, "implementation": name, "ms": ms} for name, ms in rows]
    page = results_page.results_page(written(tmp_path, {**TABLE, "kind": "frames", "rows": frames}))
    head, _, *lines = rows_of(page)
    assert head == ["4 x 2", "run", "oneDNN, float32", "XLA", "Open Image Denoise high"]
    assert lines == [["`svgf`", "1", "", "50.0 (0.25)", "200"], ["`steady-fast`", "1", "150 (0.75)", "", "200"]]


def test_a_benchmark_has_a_column_for_each_peer(tmp_path):
    row = {"work": "warp", "implementation": "xla", "median_ms": 1234.5, "peak_mib": None}
    rows = [{**row, "against": "torch-eager", "ratio": 0.5}, {**row, "against": "roofline", "ratio": 3.0}]
    page = results_page.results_page(written(tmp_path, {**TABLE, "kind": "bench", "rows": rows}))
    assert rows_of(page)[0][4:] == ["of PyTorch eager", "of the roofline"]
    assert rows_of(page)[2] == ["warp", "xla", "1,234", "", "0.50", "3.00"]


def test_the_readme_has_a_part_of_a_table(tmp_path):
    chosen = {"columns": ["method", "FLIP"], "rows": ["b", "a"], "where": {"PSNR": 30.0}}
    same = {**TABLE, "rows": [["a", 30.0, 0.25], ["b", 30.0, 0.5], ["b", 31.0, 0.125]], "readme": chosen}
    block = results_page.readme_block(written(tmp_path, same, {**TABLE, "title": "Another"}))
    assert rows_of(block) == [["method", "FLIP"], ["---", "---"], ["b", "0.5"], ["a", "**0.25**"]]
    assert "Another" not in block


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"measured": {"date": "2026-11-27", "machine": "two cores"}}, "expected revision"),
        ({"what": None}, "expected what"),
        ({"kind": "poem"}, "expected a kind out of table, frames, bench, raw, got 'poem'"),
        ({"rows": [["a", 30.0]]}, "expected 3 values in each row"),
    ],
)
def test_a_file_that_lacks_something_is_refused_by_its_name(tmp_path, change, message):
    result = {key: value for key, value in {**TABLE, **change}.items() if value is not None}
    with pytest.raises(ValueError, match=rf"0\.json: {re.escape(message)}"):
        written(tmp_path, result)


def test_a_readme_without_markers_is_refused():
    with pytest.raises(ValueError, match="expected the markers"):
        with_block("# A readme\n", "tables")


def test_lab_notes_say_their_date_and_revision():
    notes = [note for note in (ROOT / "lab").glob("*.md") if note.name != "README.md"]
    assert notes
    for note in notes:
        first = note.read_text("utf-8").splitlines()[0]
        assert re.match(r"\*Lab note of \d{4}-\d{2}-\d{2}, revision [0-9a-f]{7}.* Not maintained", first), note.name
        assert note.name.startswith(first[13:23])


def test_lab_notes_are_not_shipped():
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    included = re.search(r"\[tool\.hatch\.build\.targets\.sdist\]\ninclude = (\[.*\])", project)
    assert included
    assert "lab" not in json.loads(included[1])
    assert 'packages = ["jaxdn"]' in project
