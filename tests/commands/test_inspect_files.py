"""``jaxdn inspect`` on files of other renderers: what is read, what is missing, what to state, and nothing else."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.commands.channel_table import CONSEQUENCES
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.data.foreign.vectors import MOTION_CONVENTIONS
from jaxdn.methods.registry import methods
from tests.programs import HEIGHT, PROGRAMS, WIDTH, layer, truth, write_shot
from tests.training.test_training import make_clip

PLAN = ("integrator", "compiled", "rendered once", "on disk", "left out", "emission", "dual ", "uncertain", "effect")
"""Words of the effects and the plan of a scene."""
UNSTATED = [name for name, program in PROGRAMS.items() if program.motion_convention]
"""Programs with motion vectors that their files do not explain."""


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three frames of every program."""
    folder = tmp_path_factory.mktemp("programs")
    return {name: write_shot(name, folder / name) for name in PROGRAMS}


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """``run(path, *options)``: what ``jaxdn inspect`` prints."""
    monkeypatch.setenv("COLUMNS", "250")  # no line is broken

    def inspect(*arguments: Any) -> str:
        main.main(["inspect", *map(str, arguments)])
        return capsys.readouterr().out

    return inspect


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Any:
    """``fails(verb, path, *options)``: the message with which a command ends."""

    def ended(*arguments: Any) -> str:
        with pytest.raises(SystemExit) as error:
            main.main([*map(str, arguments)])
        assert error.value.code == 2
        return capsys.readouterr().err

    return ended


def proposed(text: str) -> list[str]:
    """The conventions in the list that is printed."""
    lines = [line.split() for line in text.splitlines()]
    return [line[1] for line in lines if line[:1] == ["--motion-convention"]]


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_plan_is_printed_and_the_convention_is_named(name: str, shots: dict[str, Path], run: Any) -> None:
    text, program = run(shots[name]), PROGRAMS[name]
    assert [word for word in PLAN if word in text] == []
    assert proposed(text) == ([program.motion_convention] if program.motion_convention else [])
    if program.motion_convention:
        assert MOTION_CONVENTIONS[program.motion_convention] in text
        assert "shot.0001.exr and shot.0002.exr" in text
    elif "motion" in program.buffers:
        assert MOTION_CONVENTIONS["cycles"].partition(" (")[0] in text
    else:
        assert CONSEQUENCES["motion"] in text
    assert "3 frames of " in text


@pytest.mark.parametrize("name", UNSTATED)
def test_what_is_stated_is_not_asked_for(name: str, shots: dict[str, Path], run: Any) -> None:
    text = run(shots[name], "--motion-convention", PROGRAMS[name].motion_convention)
    assert proposed(text) == []
    assert "nothing says" not in text.lower()
    assert proposed(run(shots[name], "--motion-convention", "none")) == []


@pytest.mark.parametrize("name", PROGRAMS)
def test_json_says_the_same_as_the_text(name: str, shots: dict[str, Path], run: Any) -> None:
    text, record = run(shots[name]), json.loads(run(shots[name], "--json"))
    assert set(record) == {
        "frames",
        "width",
        "height",
        "sources",
        "missing",
        "notes",
        "fitting_conventions",
        "unusable",
        "looked_at",
    }
    assert len(record["looked_at"]) == record["frames"]  # a short shot: all
    assert record["sources"] == [
        {**one._asdict(), "channels": list(one.channels)} for one in read_channel_mapping(shots[name])
    ]
    for source in record["sources"]:
        assert source["convention"] in text
    for buffer, consequence in record["missing"].items():
        assert [buffer, "missing", *consequence.split()] in [line.split() for line in text.splitlines()]
    assert text.count(" missing ") == len(record["missing"])
    for note in record["notes"]:
        assert note in text
    assert (record["fitting_conventions"] or []) == proposed(text)
    assert (record["fitting_conventions"] is None) == (name not in UNSTATED)
    assert f"{record['frames']} frames of {record['width']} x {record['height']} pixels" in text


def test_notes_and_what_a_denoiser_lacks_are_in_both(shots: dict[str, Path], run: Any) -> None:
    record = json.loads(run(shots["RenderMan"], "--json", "--denoiser", "svgf", "--motion-convention", "cycles"))
    assert set(record["missing"]) <= methods()["svgf"].factory().reads
    stated = ("--motion-convention", "previous-current")
    note = "'View Layer.Vector' looks like Blender's, whose convention is 'cycles'; read as stated"
    assert json.loads(run(shots["Blender"], "--json", *stated))["notes"] == [note]
    assert note in run(shots["Blender"], *stated)


def test_one_frame_cannot_tell_and_all_conventions_are_listed(shots: dict[str, Path], run: Any) -> None:
    alone = shots["Arnold"] / "shot.0001.exr"
    text = run(alone)
    assert proposed(text) == [*MOTION_CONVENTIONS, "none"]
    assert "One frame alone does not tell, and needs no motion" in text
    assert f"1 frame of {WIDTH - 2} x {HEIGHT - 2} pixels" in text
    assert json.loads(run(alone, "--json"))["fitting_conventions"] == []


def test_a_second_file_that_is_damaged_tells_nothing_of_conventions(
    shots: dict[str, Path], tmp_path: Path, run: Any, fails: Any
) -> None:
    name = UNSTATED[0]
    source = Path(shutil.copytree(shots[name], tmp_path / "in"))
    first, second, third = sorted(source.iterdir())
    data = second.read_bytes()
    second.write_bytes(data[:-20] + bytes(20))
    text = run(source)
    assert f"{second.name} counts as a missing frame: the pixel data is truncated or damaged" in text
    assert "2 frames of " in text
    assert f"{first.name} and {third.name}" in text
    message = fails("denoise", source, "-o", tmp_path / "out", "--method", "taa")
    assert "state --motion-convention" in " ".join(message.split())
    assert not list((tmp_path / "out").glob("*.exr"))


def test_where_nothing_moves_that_is_said(tmp_path: Path, run: Any) -> None:
    for frame in (1, 2):
        PROGRAMS["RenderMan"].write(tmp_path / f"shot.{frame:04d}.exr", 0)
    text = run(tmp_path)
    assert proposed(text) == [*MOTION_CONVENTIONS, "none"]
    assert "None brings shot.0001.exr and shot.0002.exr onto each other" in text


def test_a_convention_that_does_not_exist_lists_those_that_do(shots: dict[str, Path], fails: Any) -> None:
    message = fails("inspect", shots["Arnold"], "--motion-convention", "backwards")
    assert "got 'backwards'" in message
    assert all(f"  {name} " in message for name in MOTION_CONVENTIONS)


@pytest.mark.parametrize("option", [("--frames", 2), ("--animation", "moves.json")])
def test_options_of_scenes_are_refused(option: tuple[str, Any], shots: dict[str, Path], fails: Any) -> None:
    assert "expected none of --animation, --frames" in fails("inspect", shots["Arnold"], *option)


@pytest.mark.parametrize("more", [(), ("--json",)])
def test_an_unfinished_clip_is_no_folder_of_files(more: tuple[str, ...], tmp_path: Path, fails: Any) -> None:
    clips.write_clip(make_clip(0), tmp_path)
    (tmp_path / "clip.json").unlink()
    assert "the clip was not finished" in fails("inspect", tmp_path, *more)


def test_a_finished_clip_keeps_its_effects_and_plan(tmp_path: Path, run: Any) -> None:
    clips.write_clip(make_clip(0), tmp_path / "clip")
    text = run(tmp_path / "clip")
    assert all(words in text for words in ("integrator", "rendered once", "on disk", "motion        dual"))
    record = json.loads(run(tmp_path / "clip", "--json"))
    assert set(record) == {"effects", "plan", "uncertain", "sources"}


FIRST = next(iter(MOTION_CONVENTIONS))


@pytest.mark.parametrize("option", [("--channels", "albedo=a"), ("--layer", "a"), ("--motion-convention", FIRST)])
def test_a_finished_clip_needs_no_options_of_files(option: tuple[str, str], tmp_path: Path, fails: Any) -> None:
    clips.write_clip(make_clip(0), tmp_path / "clip")
    message = fails("inspect", tmp_path / "clip", *option)
    assert "expected none of --channels, --layer, --motion-convention" in message
    assert "a clip of jaxdn's own" in message


def test_the_help_says_that_files_are_read(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main.main(["inspect", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "files of other renderers, what is read from which layer" in text
    assert "fitting_conventions" in text


def write_frames(folder: Path, count: int, odd: int | None = None) -> Path:
    """Frames with an albedo and a roughness; the odd one has a few values that no picture has."""
    folder.mkdir(parents=True)
    for frame in range(1, count + 1):
        now = truth(frame % 4)
        channels = layer("", now.light, "RGB") | layer("albedo", now.albedo, "RGB")
        channels["roughness.Y"] = np.full((HEIGHT, WIDTH), 0.5, np.float32)
        if frame == odd:
            channels["roughness.Y"][3, 4] = 1.3
            channels["R"][5, 6:8] = np.nan
            channels["albedo.G"][0, 0] = np.nan
        clips.write_exr(folder / f"s.{frame:04d}.exr", channels)
    return folder


def test_brackets_and_colons_in_names_are_printed(tmp_path: Path, run: Any) -> None:
    source = write_frames(tmp_path / "[red] sh[010] :cat:", 1)
    text = run(source)
    assert "[red] sh[010] :cat:/s.0001.exr: what is read" in text
    channels = clips.read_exr(source / "s.0001.exr")
    channels = {f"[bold]x[/bold] :cat:.{name}" if name in "RGB" else name: pixels for name, pixels in channels.items()}
    clips.write_exr(source / "s.0001.exr", channels)
    assert "[bold]x[/bold] :cat:" in run(source, "--channels", "radiance=[bold]x[/bold] :cat:")


@pytest.mark.parametrize(("count", "odd", "looked"), [(3, 2, "all"), (9, 5, "s.0001.exr, s.0003.exr, s.0005.exr")])
def test_odd_values_of_later_frames_are_told(count: int, odd: int, looked: str, tmp_path: Path, run: Any) -> None:
    source = write_frames(tmp_path / "in", count, odd)
    text = run(source)
    assert f"s.{odd:04d}.exr: roughness: 1 pixel of 'roughness' beyond [0, 1], such as 1.3: clamped" in text
    assert f"s.{odd:04d}.exr: 2 pixels of radiance are NaN or infinite; they are replaced" in text
    assert f"s.{odd:04d}.exr: 1 pixel of albedo is NaN or infinite; it is replaced" in text
    assert f"values were looked at in {looked}" in text
    told = json.loads(run(source, "--json"))
    assert any("such as 1.3" in note for note in told["notes"])
    assert "NaN" not in run(write_frames(tmp_path / "sound", 2))
