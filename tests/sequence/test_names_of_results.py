"""Results keep the names of their frames: files named one by one, links, upper case, and frames that are held."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.core.options import numbers
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model


def write(folder: Path, *names: str) -> Path:
    """Constant frames, each as bright as its place in the list."""
    folder.mkdir(parents=True, exist_ok=True)
    for light, name in enumerate(names, start=1):
        (folder / name).parent.mkdir(exist_ok=True)
        clips.write_exr(folder / name, dict.fromkeys("RGB", np.full((8, 8), light, np.float32)))
    return folder


def brightness(path: Path) -> float:
    return float(clips.read_exr(path)["R"][4, 4])


def denoise(sources: list[Path], out: Path, **settings: Any) -> tuple[list[str], list[str]]:
    """The files that were written, in order, and what was told."""
    told: list[str] = []
    written = denoise_files(sources, out, find_model("noisy"), Settings(**settings), log=told.append)
    return [str(path.relative_to(out)) for path in written.files], [line for line in told if "noise is" not in line]


@pytest.mark.parametrize(
    "names",
    [
        ["s.0001.exr", "s.0002.exr", "s.0003.exr"],
        ["s.-0001.exr", "s.0000.exr", "s.0001.exr"],
        ["0001_L.exr", "0002_L.exr", "0003_L.exr"],
        ["s.1.0.exr", "s.1.5.exr", "s.2.0.exr"],
        ["S_8.EXR", "S_9.EXR", "S_10.EXR"],
        ["0001/beauty.exr", "0002/beauty.exr", "0003/beauty.exr"],
        ["shot_0001_v02.exr", "shot_0002_v02.exr", "shot_0003_v02.exr"],
        ["render.0001.1.exr", "render.0002.1.exr", "render.0003.1.exr"],
    ],
)
def test_one_shot_in_order_however_it_is_named(names: list[str], tmp_path: Path) -> None:
    """One shot has one line about its noise; a gap or an image of its own would be told."""
    source = write(tmp_path / "in", *names)
    for number, sources in enumerate(([source], [source / name for name in names])):
        assert denoise(sources, tmp_path / str(number)) == (names, [])
        assert [brightness(tmp_path / str(number) / name) for name in names] == [1.0, 2.0, 3.0]


def test_a_folder_for_each_frame_with_files_for_its_passes(tmp_path: Path, capsys: Any) -> None:
    """Messages and pages name the folder too, as all files are called alike."""
    source = write(tmp_path / "in", *(f"{number:04d}/beauty.exr" for number in range(1, 5)))
    for number in range(1, 5):
        normal = np.full((8, 8), number / 9, np.float32)
        clips.write_exr(source / f"{number:04d}/normal.exr", dict.fromkeys("RGB", normal))
    (source / "0003/beauty.exr").write_bytes(b"")
    files, told = denoise([source], tmp_path / "out")
    assert files == ["0001/beauty.exr", "0002/beauty.exr", "0004/beauty.exr"]
    assert any("a file for each pass, normal from normal.exr" in line for line in told)
    assert any(line.startswith("0003/beauty.exr is left out, as a missing frame") for line in told)
    main.main(["inspect", str(source)])
    text = capsys.readouterr().out
    assert "0003/beauty.exr counts as a missing frame" in text
    assert "0001/beauty.exr counts" not in text


def test_links_keep_their_own_names(tmp_path: Path) -> None:
    store = write(tmp_path / "store", "c0ffee", "0badf00d")
    (tmp_path / "in").mkdir()
    for number, name in enumerate(("c0ffee", "0badf00d"), start=1):
        os.symlink(store / name, tmp_path / "in" / f"s.{number:04d}.exr")
    os.symlink(tmp_path / "in", tmp_path / "latest")
    for number, source in enumerate(("in/*.exr", "latest")):
        assert denoise([tmp_path / source], tmp_path / str(number)) == (["s.0001.exr", "s.0002.exr"], [])
    assert brightness(tmp_path / "0" / "s.0002.exr") == 2.0


def test_a_link_to_a_file_that_is_missing_is_a_missing_frame(tmp_path: Path, capsys: Any) -> None:
    source = write(tmp_path / "in", "s.0001.exr", "s.0003.exr")
    os.symlink(tmp_path / "nowhere.exr", source / "s.0002.exr")
    names = [source / f"s.{number:04d}.exr" for number in (1, 2, 3)]
    for number, sources in enumerate(([source], [source / "*.exr"], names)):
        files, told = denoise(sources, tmp_path / str(number))
        assert files == ["s.0001.exr", "s.0003.exr"]
        assert any("s.0002.exr is left out, as a missing frame: No such file" in line for line in told)
    main.main(["inspect", *map(str, names)])
    assert "s.0002.exr counts as a missing frame: No such file" in capsys.readouterr().out


@pytest.mark.parametrize("hard", [False, True])
def test_a_held_frame_is_that_frame(hard: bool, tmp_path: Path) -> None:
    source = write(tmp_path / "in", "s.0001.exr", "s.0002.exr", "s.0005.exr")
    link = os.link if hard else os.symlink
    link(source / "s.0002.exr", source / "s.0003.exr")
    link(source / "s.0003.exr", source / "s.0004.exr")
    files, told = denoise([source], tmp_path / "out", preview=True)
    assert files == [f"s.{number:04d}.exr" for number in range(1, 6)]
    assert [brightness(tmp_path / "out" / name) for name in files] == [1.0, 2.0, 2.0, 2.0, 3.0]
    assert (tmp_path / "out" / "s.0004.png").read_bytes() == (tmp_path / "out" / "s.0002.png").read_bytes()
    assert told[0].startswith("s.0003.exr is s.0002.exr once more, and so is its result")
    assert not any("missing" in line for line in told)
    assert denoise([source], tmp_path / "some", frames=[4])[0] == ["s.0002.exr", "s.0004.exr"]


def test_a_held_frame_has_the_folder_of_its_own(tmp_path: Path) -> None:
    source = write(tmp_path / "in", "0001/beauty.exr", "0003/beauty.exr")
    (source / "0002").mkdir()
    os.symlink(source / "0001/beauty.exr", source / "0002/beauty.exr")
    files, _ = denoise([source], tmp_path / "out")
    assert files == [f"{number:04d}/beauty.exr" for number in (1, 2, 3)]
    assert brightness(tmp_path / "out/0002/beauty.exr") == 1.0


def test_what_is_held_of_a_damaged_frame_is_not_waited_for(tmp_path: Path) -> None:
    source = write(tmp_path / "in", "s.0001.exr", "s.0002.exr")
    (source / "s.0002.exr").write_bytes(b"")
    os.symlink(source / "s.0002.exr", source / "s.0003.exr")
    told: list[tuple[int, int]] = []
    denoise_files(
        [source], tmp_path / "out", find_model("noisy"), on_frame=lambda path, done, total: told.append((done, total))
    )
    assert told == [(1, 1)]


def test_inspect_takes_files_and_several_shots(tmp_path: Path, capsys: Any) -> None:
    source = write(tmp_path, "a.0001.exr", "a.0003.exr", "still.exr")
    main.main(["inspect", *(str(source / name) for name in ("a.0001.exr", "a.0003.exr"))])
    text = capsys.readouterr().out
    assert "2 frames of 8 x 8 pixels\n2 missing; after a gap" in text
    main.main(["inspect", str(source / "a.0001.exr"), str(source / "still.exr"), "--json"])
    found = json.loads(capsys.readouterr().out)["shots"]
    assert [(shot["shot"].rpartition("/")[2], shot["frames"]) for shot in found] == [
        ("a.0001.exr", 1),
        ("still.exr", 1),
    ]
    with pytest.raises(SystemExit) as ended:
        main.main(["inspect", "fruit", "robot"])
    assert ended.value.code == 2
    assert "fruit: expected one scene" in capsys.readouterr().err


def test_numbers_below_zero_can_be_named(tmp_path: Path) -> None:
    source = write(tmp_path / "in", *(f"s.{number:05d}.exr" for number in range(-3, 3)))
    for word, names in {"-3": ["s.-0003.exr"], "-1-1": ["s.-0001.exr", "s.00000.exr", "s.00001.exr"]}.items():
        main.main(["denoise", str(source), "-o", str(tmp_path / word), "--method", "noisy", f"--frames={word}"])
        assert sorted(path.name for path in (tmp_path / word).iterdir()) == names
    with pytest.raises(ValueError, match="expected a range from low to high, got '-1--3'"):
        numbers(["-1--3"], "--frames", negative=True)
    with pytest.raises(ValueError, match="expected whole numbers >= 0"):
        numbers(["-1"], "--seeds")


def test_a_range_that_would_fill_the_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="--frames: expected ranges of at most 10,000,000 numbers, got '1-10000001'"):
        numbers(["1-10000001"], "--frames")


@pytest.mark.parametrize("name", ["render.*", "render.####", "render.0001"])
def test_inspect_takes_what_is_denoised_without_a_suffix_too(name: str, tmp_path: Path, capsys: Any) -> None:
    for number in (1, 2):
        clips.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", np.ones((4, 4), np.float32)))
        (tmp_path / "a.exr").rename(tmp_path / f"render.{number:04d}")
    main.main(["inspect", str(tmp_path / name)])
    text = capsys.readouterr().out
    assert text.count("1 frame of 4 x 4 pixels") == (1 if name == "render.0001" else 2)
    with pytest.raises(SystemExit):
        main.main(["inspect", str(tmp_path / "none.*")])
    assert "expected a folder of EXR files, a pattern that fits some" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(SystemExit):
        main.main(["inspect", str(tmp_path / "none")])
    assert "expected a Mitsuba scene (.xml)" in " ".join(capsys.readouterr().err.split())
