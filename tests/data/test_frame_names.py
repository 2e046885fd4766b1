"""Frame numbers in names: which files are one shot, in which order, by names as programs write them."""

from fractions import Fraction
from pathlib import Path

import pytest

from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.frame_names import read_frame_names
from jaxdn.data.foreign.shots import find_missing, find_shots, ranges


def shots(*names: str) -> dict[str, list[Fraction | None]]:
    """Shot -> the numbers of its frames."""
    found: dict[str, list[Fraction | None]] = {}
    for name in read_frame_names(map(Path, names)):
        found.setdefault(name.shot, []).append(name.number)
    return found


CASES = {
    "padded": (["a.0001.exr", "a.0002.exr"], {"a.#": [1, 2]}),
    "not padded": (["a.9.exr", "a.10.exr"], {"a.#": [9, 10]}),
    "negative": (["s.-0003.exr", "s.0000.exr", "s.0001.exr"], {"s.#": [-3, 0, 1]}),
    "a dash is no minus": (["s-003.exr", "s-004.exr"], {"s-#": [3, 4]}),
    "a date is not negative": (["2026-11-27_01.exr", "2026-11-27_02.exr"], {"2026-11-27_#": [1, 2]}),
    "first": (["0001_L.exr", "0002_L.exr", "0001_R.exr"], {"#_L": [1, 2], "#_R": [1]}),
    "a pass after it": (["s.0001.beauty.exr", "s.0002.beauty.exr"], {"s.#.beauty": [1, 2]}),
    "a version after it": (["s.0001.v3.exr", "s.0002.v3.exr"], {"s.#.v3": [1, 2]}),
    "a version that differs": (["0001_v1.exr", "0002_v1.exr", "0002_v2.exr"], {"#_v1": [1, 2], "#_v2": [2]}),
    "a shot before it": (["sh010_0001.exr", "sh020_0001.exr"], {"sh010_#": [1], "sh020_#": [1]}),
    "a longer shot": (["sh0010_0001.exr", "sh0020_0001.exr"], {"sh0010_#": [1], "sh0020_#": [1]}),
    "letters before it": (["Image0001.exr", "Image0002.exr"], {"Image#": [1, 2]}),
    "inside a word": (["frame0001_left.exr", "frame0002_left.exr"], {"frame#_left": [1, 2]}),
    "cameras": (["cam1_left.exr", "cam2_left.exr"], {"cam1_left": [None], "cam2_left": [None]}),
    "halves": (["s.1.0.exr", "s.1.5.exr", "s.2.0.exr"], {"s.#": [1, Fraction(3, 2), 2]}),
    "thirds": ([f"s.{n}.exr" for n in ("007.00", "007.33", "007.67", "008.00")],
               {"s.#": [7, Fraction(22, 3), Fraction(23, 3), 8]}),
    "negative halves": (["s.-1.5.exr", "s.-1.0.exr", "s.0.0.exr"], {"s.#": [Fraction(-3, 2), -1, 0]}),
    "whole frames without a zero": (["s.11.exr", "s.11.5.exr", "s.12.exr"], {"s.#": [11, Fraction(23, 2), 12]}),
    "whole frames, and a pass": (["s.1.v3.exr", "s.1.25.v3.exr", "s.1.5.v3.exr", "s.1.75.v3.exr", "s.2.v3.exr"],
                                 {"s.#.v3": [1, Fraction(5, 4), Fraction(3, 2), Fraction(7, 4), 2]}),
    "a shot beside its takes": (["s.1.exr", "s.2.exr", "s.2.0001.exr"], {"s.#": [1, 2], "s.2.#": [1]}),
    "round brackets": (["still (1).exr", "still (2).exr"], {"still (#)": [1, 2]}),
    "square brackets": (["s [0001].exr", "s [0002].exr"], {"s [#]": [1, 2]}),
    "a size is no frame": (["s_2048x1024.exr", "s_512x256.exr"], {"s_2048x1024": [None], "s_512x256": [None]}),
    "takes are no subframes": (["1.0001.exr", "1.0002.exr", "2.0001.exr"], {"1.#": [1, 2], "2.#": [1]}),
    "upper case": (["S_01.EXR", "S_02.EXR"], {"S_#": [1, 2]}),
    "a version after it, alike": (["shot_0001_v02.exr", "shot_0002_v02.exr"], {"shot_#_v02": [1, 2]}),
    "a last number that is alike": (["render.0001.1.exr", "render.0002.1.exr"], {"render.#.1": [1, 2]}),
    "a folder for each frame": (["0001/beauty.exr", "0002/beauty.exr"], {"#/beauty": [1, 2]}),
    "folders, and passes": (["f-1/a.exr", "f-2/a.exr", "f-2/b.exr", "f-3/b.exr"], {"#/a": [1, 2], "#/b": [2, 3]}),
    "named folders": (["Frame_08/b.exr", "Frame_10/b.exr"], {"#/b": [8, 10]}),
    "a folder alone": (["0001/beauty.exr"], {"beauty": [None]}),
    "folders of shots": (["sh010/b.exr", "sh020/b.exr", "v01/b.exr", "v02/b.exr"], {"b": [None] * 4}),
    "numbers of their own come first": (["1/b.7.exr", "2/b.7.exr"], {"b.#": [7, 7]}),
    "times": (["s_1700000000000.exr", "s_1700086400000.exr"],
              {"s_1700000000000": [None], "s_1700086400000": [None]}),
    "folders of times": (["1700000000000/b.exr", "1700086400000/b.exr"], {"b": [None, None]}),
    "times with parts": (["s.1700000000000.0.exr", "s.1700086400000.5.exr"],
                         {"s.1700000000000.0": [None], "s.1700086400000.5": [None]}),
    "a time alone": (["s_1700000000000.exr"], {"s_#": [1700000000000]}),
    "no number": (["still.exr", "v2_final.exr"], {"still": [None], "v2_final": [None]}),
    "negative, and nothing parts it": (["s-0002.exr", "s-0001.exr", "s0000.exr", "s0001.exr"], {"s#": [-2, -1, 0, 1]}),
    "two shots, one with a dash": (["s-0001.exr", "s-0002.exr", "s0001.exr"], {"s-#": [1, 2], "s#": [1]}),
    "quarters of one frame": ([f"s.0001.{n}.exr" for n in ("000", "250", "500", "750")],
                              {"s.#": [1, Fraction(5, 4), Fraction(3, 2), Fraction(7, 4)]}),
    "frames of a numbered shot": (["s.1.0.exr", "s.1.1.exr", "s.1.2.exr"], {"s.1.#": [0, 1, 2]}),
    "steps around the middle": ([f"s.{n}.exr" for n in ("10.25", "10.75", "11.25", "11.75")],
                                {"s.#": [Fraction(n, 4) for n in (41, 43, 45, 47)]}),
    "one frame": (["s.0007.beauty.exr"], {"s.#.beauty": [7]}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_names_tell_the_shot_and_the_frame(case: str) -> None:
    names, expected = CASES[case]
    assert shots(*names) == expected


def test_subframes_have_gaps_of_their_own_step() -> None:
    numbers = [Fraction(n, 2) for n in (2, 3, 4, 6, 7)]
    assert find_missing(numbers) == [Fraction(5, 2)]
    assert ranges(numbers) == "1-2, 3-3.5"
    assert ranges([-3, -2, 0]) == "-3 to -2, 0"


def touch(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text("")
    return folder


@pytest.mark.parametrize("pattern", ["*.exr", "s_###.exr", "s_%03d.exr", "s_$F3.exr", "s_<frame>.exr", "s_00[12].exr"])
def test_folders_with_brackets_and_placeholders_of_numbers(pattern: str, tmp_path: Path) -> None:
    folder = touch(tmp_path / "[2026] Film", "s_001.exr", "s_002.exr", "s_beauty.txt")
    (shot,) = find_shots(folder / pattern)
    assert [file.name for file in shot.files] == ["s_001.exr", "s_002.exr"]
    assert find_shots(folder)[0].label == f"{folder}/s_#.exr 1-2"


@pytest.mark.parametrize("pattern", ["", "*/beauty.exr", "####/beauty.exr"])
def test_a_folder_for_each_frame(pattern: str, tmp_path: Path) -> None:
    for number in (1, 2, 4):
        touch(tmp_path / f"{number:04d}", "beauty.exr")
    touch(tmp_path / "cache", "beauty.exr")
    shots = {shot.name: shot for shot in find_shots(tmp_path / pattern)}
    assert shots["#/beauty"].numbers == (1, 2, 4)
    assert shots["#/beauty"].label == f"{tmp_path}/#/beauty.exr 1-2, 4"
    assert len(shots) == (2 if pattern[:1] == "*" else 1)


def test_a_placeholder_is_a_number(tmp_path: Path) -> None:
    touch(tmp_path, "s.001.exr", "s.left.exr")
    assert [file.name for shot in find_shots(tmp_path / "s.###.exr") for file in shot.files] == ["s.001.exr"]


@pytest.mark.parametrize("pattern", ["*.exr", "s.###.exr", "*.EXR"])
def test_a_pattern_fits_both_cases_of_exr(pattern: str, tmp_path: Path) -> None:
    touch(tmp_path, "s.001.EXR", "s.002.EXR", "s.001.png")
    (shot,) = find_shots(tmp_path / pattern)
    assert [file.name for file in shot.files] == ["s.001.EXR", "s.002.EXR"]


def test_files_that_are_named_one_by_one(tmp_path: Path) -> None:
    folder = touch(tmp_path, "b_2.exr", "a.0002.exr", "a.0001.exr")
    found = find_shots([folder / "b_2.exr", folder / "a.0002.exr", folder / "a.0001.exr"])
    assert {shot.name: shot.numbers for shot in found} == {"b_#": (2,), "a.#": (1, 2)}
    with pytest.raises(ClipError, match="expected every frame once, got it twice"):
        find_shots([folder / "b_2.exr", folder / "b_2.exr"])
