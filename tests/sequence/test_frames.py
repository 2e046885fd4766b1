"""Which frames are denoised: gaps, numbers, parts of a shot, several shots, and what is told meanwhile."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.commands.progress import reporter
from jaxdn.data.foreign.shots import Shot, find_shots, ranges
from jaxdn.sequence.jobs import WARM_UP, Job, find_jobs
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.sharing import share_model
from tests.training.test_training import make_clip

SIZE = (8, 8)


def write(folder: Path, *names: str) -> Path:
    """Constant frames with the number in their name as their brightness."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        digits = re.search(r"\d+$", name)
        light = np.full(SIZE, 1.0 if digits is None else float(digits[0]), np.float32)
        clips.write_exr(folder / f"{name}.exr", dict.fromkeys("RGB", light))
    return folder


def numbered(folder: Path, numbers: Any, prefix: str = "a.") -> Path:
    return write(folder, *(f"{prefix}{number:04d}" for number in numbers))


def denoise(sources: Any, out: Path, name: str = "noisy", **settings: Any) -> tuple[list[str], list[str]]:
    """The files written, below ``out``, and what was told besides the noise that was measured."""
    told: list[str] = []
    sources = sources if isinstance(sources, list) else [sources]
    written = denoise_files(sources, out, share_model(name), Settings(**settings), log=told.append)
    return [str(path.relative_to(out)) for path in written.files], [line for line in told if "noise is" not in line]


def test_shots_are_found_by_their_names(tmp_path: Path) -> None:
    numbered(tmp_path, [3, 1], "a.")
    numbered(tmp_path, [7, 8, 10], "b_")
    write(tmp_path, "still")
    found = find_shots(tmp_path)
    assert [(len(shot.files), shot.numbers) for shot in found] == [(2, (1, 3)), (3, (7, 8, 10)), (1, ())]
    assert found[1].label == f"{tmp_path}/b_#.exr 7-8, 10"
    assert found[2].label == f"{tmp_path}/still.exr"
    write(tmp_path, "a.1")
    with pytest.raises(clips.ClipError, match="has the same number"):
        find_shots(tmp_path)


def test_gaps_are_said_and_the_history_begins_anew(tmp_path: Path) -> None:
    """Of constant frames, each run is as bright as its own frames and takes nothing of the run before."""
    source = numbered(tmp_path / "in", [1, 2, 100, 101])
    files, told = denoise(source, tmp_path / "out", "taa")
    assert files == [f"a.{number:04d}.exr" for number in (1, 2, 100, 101)]
    assert len(told) == 1
    assert "3-99 missing; after a gap there is no history at first" in told[0]
    np.testing.assert_allclose(clips.read_exr(tmp_path / "out" / "a.0100.exr")["R"], 100.0, rtol=1e-6)
    with pytest.raises(clips.ClipError, match="frames are missing between 1 and 101"):
        clips.read_clip(source)


def test_only_the_wanted_frames_are_written(tmp_path: Path) -> None:
    source = numbered(tmp_path / "in", range(8, 15))
    files, _ = denoise(source, tmp_path / "out", frames=range(10, 13))
    assert files == ["a.0010.exr", "a.0011.exr", "a.0012.exr"]
    files, told = denoise(source, tmp_path / "out", skip_existing=True)
    assert files == ["a.0008.exr", "a.0009.exr", "a.0013.exr", "a.0014.exr"]
    assert "3 frames are there already" in told[0]
    (tmp_path / "out" / "a.0012.exr").write_bytes(b"")  # somebody's placeholder is no result
    files, _ = denoise(source, tmp_path / "out", skip_existing=True)
    assert files == ["a.0012.exr"]
    with pytest.raises(ValueError, match=r"--frames 20-21: expected frames that are there, got none of .* 8-14"):
        denoise(source, tmp_path / "out", frames=[20, 21])


def test_a_wanted_frame_in_a_gap_is_nothing_to_do_and_one_beyond_is_told(tmp_path: Path) -> None:
    source = numbered(tmp_path / "in", [1, 2, 5])
    files, told = denoise(source, tmp_path / "out", frames=[4])
    assert files == []
    assert "3-4 missing" in told[0]
    with pytest.raises(ValueError, match=r"--frames 20-21: expected frames that are there, got none of .* 1-2, 5"):
        denoise(source, tmp_path / "out", frames=[20, 21])


def test_the_name_of_another_image_is_no_folder(tmp_path: Path) -> None:
    source = numbered(tmp_path / "in", [1])
    with pytest.raises(ValueError, match="expected a folder or the name of an EXR file; --preview writes a PNG"):
        denoise(source, tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


def part_of(numbers: Any, wanted: Any, **options: Any) -> list[range]:
    names = tuple(Path(f"{number}.exr") for number in numbers)
    return list(Job(Shot(names, tuple(numbers)), None, names, frozenset(wanted), ()).segments(**options))


def test_segments_have_a_warm_up_and_do_not_cross_gaps() -> None:
    everything = range(50)
    assert part_of(everything, everything) == [range(50)]
    assert part_of(everything, [30]) == [range(30 - WARM_UP, 31)]
    assert part_of(everything, [3]) == [range(4)]
    assert part_of(everything, [5, 49]) == [range(6), range(49 - WARM_UP, 50)]
    assert part_of(everything, [20, 20 + WARM_UP + 1]) == [range(20 - WARM_UP, 20 + WARM_UP + 2)]
    assert part_of(everything, []) == []
    gap = [*range(10), *range(12, 20)]
    assert part_of(gap, range(18)) == [range(10), range(10, 18)]
    assert part_of(gap, [11]) == [range(10, 12)]
    assert part_of(gap, [9]) == [range(10)]


@pytest.mark.slow
def test_a_part_of_a_shot_is_as_in_the_whole(tmp_path: Path) -> None:
    """After its warm-up, a frame differs from that of the whole run by a tenth of the noise that is left in it."""
    rng = np.random.default_rng(0)
    source = tmp_path / "in"
    source.mkdir()
    count = 2 * WARM_UP + 8
    for number in range(count):
        light = rng.exponential(1.0, (32, 32)).astype(np.float32)
        clips.write_exr(source / f"a.{number:04d}.exr", dict.fromkeys("RGB", light))
    denoise(source, tmp_path / "whole", "svgf")
    files, _ = denoise(source, tmp_path / "part", "svgf", frames=[count - 1])
    whole, part = (clips.read_exr(tmp_path / folder / files[0])["R"] for folder in ("whole", "part"))
    difference, noise = np.sqrt(np.mean((whole - part) ** 2)), np.sqrt(np.mean((whole - 1) ** 2))
    assert 0 < difference < 0.15 * noise
    assert noise < 0.2


def test_several_shots_in_one_call(tmp_path: Path) -> None:
    numbered(tmp_path / "in" / "one", [1, 2])
    numbered(tmp_path / "in" / "two", [1, 2])
    clips.write_clip(make_clip(0, frames=2, size=16), tmp_path / "in" / "ours")
    files, _ = denoise([tmp_path / "in" / "one", tmp_path / "in" / "two", tmp_path / "in" / "ours"], tmp_path / "out")
    assert files == [
        *(f"one/a.{number:04d}.exr" for number in (1, 2)),
        *(f"two/a.{number:04d}.exr" for number in (1, 2)),
        *(f"ours/frame_{number:04d}.exr" for number in (0, 1)),
    ]
    numbered(tmp_path / "mixed", [1, 2], "a.")
    numbered(tmp_path / "mixed", [5, 6], "b.")
    write(tmp_path / "mixed", "still")
    files, told = denoise(tmp_path / "mixed", tmp_path / "flat")
    assert files == ["a.0001.exr", "a.0002.exr", "b.0005.exr", "b.0006.exr", "still.exr"]
    assert told == [
        f"{tmp_path}/mixed/still.exr: no frame number in its name, so it is denoised as an image of its own"
    ]


def test_frames_of_our_clips_are_chosen_too(tmp_path: Path) -> None:
    clips.write_clip(make_clip(0, frames=4, size=16), tmp_path / "clip")
    files, _ = denoise(tmp_path / "clip", tmp_path / "out", frames=[2, 3])
    assert files == ["frame_0002.exr", "frame_0003.exr"]
    expected = clips.read_clip(tmp_path / "clip").frames.radiance[2, ..., 0]
    np.testing.assert_array_equal(clips.read_exr(tmp_path / "out" / files[0])["denoised.R"], np.nan_to_num(expected))


def test_no_input_is_overwritten(tmp_path: Path) -> None:
    source = numbered(tmp_path / "in", [1, 2])
    before = [path.read_bytes() for path in sorted(source.iterdir())]
    for sources, out in (([source], source), ([source / "a.0001.exr", source / "a.0002.exr"], source)):
        with pytest.raises(ValueError, match="expected another place than the input's"):
            find_jobs(sources, out)
    with pytest.raises(ValueError, match="expected a folder for 2 frames"):
        find_jobs([source], tmp_path / "x.exr")
    assert [path.read_bytes() for path in sorted(source.iterdir())] == before
    assert not (tmp_path / "x.exr").exists()


def test_no_file_of_a_pass_is_overwritten(tmp_path: Path) -> None:
    """Of passes in folders of their own, under one name."""
    for name in ("beauty", "albedo"):
        numbered(tmp_path / name, [1, 2])
    stated = {"albedo": str(tmp_path / "albedo" / "*.exr")}
    with pytest.raises(ValueError, match="expected another place than the input's"):
        find_jobs([tmp_path / "beauty"], tmp_path / "albedo", pass_files=stated)
    assert len(find_jobs([tmp_path / "beauty"], tmp_path / "out", pass_files=stated)) == 1


def refused(capsys: Any, *arguments: Any) -> str:
    """The message of a `jaxdn denoise` that ends with exit code 2."""
    with pytest.raises(SystemExit) as ended:
        main.main(["denoise", *map(str, arguments)])
    assert ended.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def test_inputs_have_to_be_named(tmp_path: Path, capsys: Any) -> None:
    assert "expected a folder, a pattern or a file to denoise, got none" in refused(capsys, "-o", tmp_path / "out")


def test_a_frame_that_is_named_twice_is_refused(tmp_path: Path, capsys: Any) -> None:
    source = numbered(tmp_path / "in", [1, 2])
    clips.write_clip(make_clip(0, frames=2, size=16), tmp_path / "clip")
    for sources in ([source, source / "a.0002.exr"], [tmp_path / "clip", tmp_path / "in" / ".." / "clip"]):
        message = refused(capsys, *sources, "-o", tmp_path / "out", "--method", "noisy")
        assert "expected every frame once, got" in message
        assert "twice; name it once" in message
    image = source / "a.0001.EXR"
    image.write_bytes((source / "a.0001.exr").read_bytes())
    message = refused(capsys, source / "a.0001.exr", image, "-o", tmp_path / "out", "--method", "noisy")
    assert f"{image}: expected one file for each frame, but {source}/a.0001.exr has the same number" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("below", ["", "further/down"])
def test_a_file_in_the_place_of_the_folder_is_refused_at_once(below: str, tmp_path: Path, capsys: Any) -> None:
    source, taken = numbered(tmp_path / "in", [1, 2]), tmp_path / "taken"
    taken.write_text("mine")
    message = refused(capsys, source, "-o", taken / below, "--method", "svgf")
    assert f"expected a folder, but {taken} is a file" in message
    assert "what is read" not in message
    assert taken.read_text() == "mine"


def test_sample_counts_of_files_name_the_shot_in_words(tmp_path: Path, capsys: Any) -> None:
    source = numbered(tmp_path / "in", [1, 2, 3])
    message = refused(capsys, source, "-o", tmp_path / "out", "--spp", "4", "--method", "noisy")
    assert f"{source}/a.0001.exr (3 files): expected spp 1, got 4" in message
    assert "PosixPath" not in message


def test_what_was_done_is_said_in_the_right_number(tmp_path: Path, capsys: Any) -> None:
    source = numbered(tmp_path / "in", [1])
    command = ["denoise", str(source), "-o", str(tmp_path / "out"), "--method", "noisy", "--skip-existing"]
    main.main(command)
    assert f"\n1 frame denoised by noisy in {tmp_path}/out" in capsys.readouterr().out
    main.main(command)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].endswith("1 frame is there already and stays as it is")
    assert lines[-1] == f"nothing to do in {tmp_path}/out"


def test_the_command_line(tmp_path: Path, capsys: Any) -> None:
    source, out = numbered(tmp_path / "in", range(1, 6)), tmp_path / "out"
    main.main(["denoise", str(source), "-o", str(out), "--method", "noisy", "--frames", "2-3", "5", "--skip-existing"])
    lines = capsys.readouterr().out
    assert "\x1b" not in lines
    assert "\r" not in lines
    assert re.search(r"^frame 1 of 3: \S+a\.0002\.exr, \d+\.\d s; Progress: 33%$", lines, re.MULTILINE)
    assert re.search(
        r"^frame 2 of 3: \S+a\.0003\.exr, \d+\.\d s, about \d+ s left; Progress: 66%$", lines, re.MULTILINE
    )
    assert re.search(r"^frame 3 of 3: \S+a\.0005\.exr, \d+\.\d s; Progress: 100%$", lines, re.MULTILINE)
    with pytest.raises(SystemExit) as ended:
        main.main(["denoise", str(source), "-o", str(out), "--frames", "3-x"])
    assert ended.value.code == 2
    assert "--frames: expected whole numbers" in " ".join(capsys.readouterr().err.split())


def test_a_terminal_has_a_bar_with_the_time_left() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100, color_system=None)
    with reporter("svgf", console) as report:
        for done in range(1, 4):
            report.on_frame(Path(f"out/a.{done:04d}.exr"), done, 3)
        report.log("[not] used: 'x'")
    text = screen.getvalue()
    assert "3/3" in text
    assert "svgf: a.0003.exr" in text
    assert "0:00:00" in text
    assert "[not] used: 'x'" in text


def test_ranges() -> None:
    assert ranges([0, 1, 2, 5, 7, 8]) == "0-2, 5, 7-8"
    assert ranges([]) == ""
