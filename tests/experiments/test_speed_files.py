"""From command to file: what is run, and how the figures follow from it."""

import sys
from pathlib import Path
from typing import Any

import pytest

from experiments.results_page import read_results, results_page
from experiments.speed import bench
from experiments.speed.peers import oidn_files
from experiments.speed.works import files, on_device
from jaxdn.data.exr.exr import read_exr
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.read import read_clip
from jaxdn.runtime.program_cache import VARIABLE
from tests.needs import require

unix = pytest.mark.skipif(sys.platform == "win32", reason="what a child process took is only known on Unix")


def test_a_shot_reads_as_blender_s(tmp_path: Path) -> None:
    source = files.write_shot(tmp_path / "shot", 3, 24, 32)
    frames = read_clip(source).frames
    assert frames.radiance.shape == (3, 24, 32, 3)
    for name in ("albedo", "normal", "depth", "motion"):
        assert getattr(frames, name) is not None, name


def test_open_image_denoise_goes_from_file_to_file(tmp_path: Path) -> None:
    """Its results keep all but the beauty, as ours do; each is that of its own file."""
    require("pyoidn")
    source = files.write_shot(tmp_path / "shot", 3, 32, 48)
    written = oidn_files.denoise_files(source, tmp_path / "out")
    assert [path.name for path in written] == [path.name for path in sorted(source.iterdir())]
    images = []
    for path in written:
        before, after = read_exr(source / path.name), read_exr(path)
        assert list(before) == list(after)
        changed = {name for name in before if (before[name] != after[name]).any()}
        assert changed == set(oidn_files.names_of("color"))
        images.append(after["ViewLayer.Combined.R"])
    assert (images[0] != images[1]).any()
    assert not any(ExrFile(path).path.name.startswith(".") for path in (tmp_path / "out").iterdir())


def test_commands_keep_what_users_runs_keep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without bytecode each run compiles the modules of jax and NumPy from their source: a second of a first frame."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    monkeypatch.setenv("HOME_OF_THE_TEST", "stays")
    given = files.environment(tmp_path)
    assert not {"PYTHONDONTWRITEBYTECODE", "JAX_COMPILATION_CACHE_DIR"} & given.keys()
    assert given["HOME_OF_THE_TEST"] == "stays"
    assert given[VARIABLE] == str(tmp_path)


def runs(*walls: float, peak: float = 100.0) -> list[files.Run]:
    """Runs of these milliseconds, with twice as many on all cores together."""
    return [files.Run(wall, 2 * wall, peak) for wall in walls]


def test_a_frame_is_what_each_further_one_takes() -> None:
    taken = {
        "svgf": files.Taken(runs(9000)[0], runs(3000, 3200), runs(7000, 8000, peak=700)),
        files.PEER: files.Taken(None, runs(500, 500), runs(2500, 3300, peak=300)),
    }
    works = files.timings(taken, frames=9)
    assert {name: timing.median_ms for name, (timing, _) in works["files-first-frame"].items()} == {
        "svgf-cold": 9000,
        "svgf-warm": 3100,
        files.PEER: 500,
    }
    timing, peak = works["files-frame"]["svgf"]
    assert (timing.min_ms, timing.max_ms, peak) == (500, 600, 700)
    assert works["files-cpu"]["svgf"][0].median_ms == 1100
    assert works["files-frame"][files.PEER][0].median_ms == 300


def test_rows_are_in_relation_to_open_image_denoise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require("pyoidn")
    monkeypatch.setattr(files, "measurable", lambda: True)

    def measure(methods: Any, place: Path, **options: Any) -> dict[str, files.Taken]:
        assert methods == [files.PEER, "svgf"]
        own = files.Taken(runs(9000)[0], runs(3000), runs(11000))
        return {files.PEER: files.Taken(None, runs(1000), runs(3000)), "svgf": own}

    def step_ms(name: str, height: int, width: int, rounds: int) -> float:
        assert (name, height, width) == ("svgf", files.HEIGHT, files.WIDTH)
        return 800.0

    monkeypatch.setattr(files, "measure", measure)
    monkeypatch.setattr(bench, "apart", lambda function, *arguments: function(*arguments))
    monkeypatch.setattr(on_device, "step_ms", step_ms)
    said: list[str] = []
    rows = bench.file_rows(["svgf"], said.append)
    ratios = {(row["work"], row["implementation"]): row["ratio"] for row in rows if row["against"] == files.PEER}
    assert ratios["files-first-frame", "svgf-cold"] == 9
    assert ratios["files-first-frame", "svgf-warm"] == 3
    assert ratios["files-frame", "svgf"] == 4
    assert ratios["files-frame", files.PEER] == 1
    assert [row["ratio"] for row in rows if row["against"] == "step"] == [1.25]
    assert [line for line in said if "frames a second" in line] == [
        "oidn-files: 4.00 frames a second",
        "svgf: 1.00 frames a second",
    ]
    bench.Report(tmp_path / "bench.json", "command").add(rows)
    page = results_page(read_results(tmp_path))
    assert "of Open Image Denoise, file to file |" in page
    assert "| files-frame | svgf | 1,000 | 100 | 4.00 | 1.25 |" in page


@unix
def test_a_command_that_fails_is_told_with_its_last_words(tmp_path: Path) -> None:
    source = files.write_shot(tmp_path / "shot", 1, 16, 16)
    with pytest.raises(RuntimeError, match=r"(?s)status 2.*expected one of"):
        files.run_apart(files.command("no-such-method", source, tmp_path / "out"), tmp_path / "programs")


@unix
def test_a_run_is_told_with_its_memory_and_all_processors(tmp_path: Path) -> None:
    work = "x = bytearray(200 << 20); x[::4096] = bytes(len(x[::4096])); sum(range(3_000_000))"
    run = files.run_apart([sys.executable, "-c", work], tmp_path)
    assert 200 < run.peak_mib < 400
    assert 20 < run.processor_ms < 20_000
    assert run.wall_ms > 0.5 * run.processor_ms / 4
