"""Files that are no frames of their shot: left out as missing, named, and the run goes on."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.data.errors import DamagedFile
from jaxdn.data.exr.completeness import check_complete
from jaxdn.sequence.jobs import WARM_UP
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model
from tests.data.test_kept import box_blur
from tests.programs import PROGRAMS, layer, part, truth, write_shot

FRAMES = 5
Damage = Callable[[Path], object]


def write(path: Path, *left: str, size: tuple[int, int] = (24, 32)) -> None:
    """A frame without some of its layers."""
    now = truth(0)
    channels = layer("", now.light, "RGB") | layer("albedo", now.albedo, "RGB") | layer("Z", now.depth, "Z")
    height, width = size
    kept = {name: np.ascontiguousarray(pixels[:height, :width]) for name, pixels in channels.items()}
    clips.write_exr(path, {name: pixels for name, pixels in kept.items() if name.partition(".")[0] not in left})


def rot(path: Path) -> None:
    """Damage that no header tells."""
    data = bytearray(path.read_bytes())
    data[-20:] = bytes(20)
    path.write_bytes(data)


def rename(path: Path) -> None:
    """A channel with a name in Latin letters of one byte, as an old program writes it."""
    path.write_bytes(path.read_bytes().replace(b"albedo.R", b"alb\xe9do.R"))


DAMAGES: dict[str, tuple[Damage, str]] = {
    "placeholder": (lambda path: path.write_bytes(b""), "the file is empty (0 bytes), as a placeholder"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-40]), "the file is incomplete"),
    "cut in its header": (lambda path: path.write_bytes(path.read_bytes()[:60]), "the file is incomplete"),
    "another kind": (lambda path: path.write_bytes(b"\x89PNG" * 99), "the file is incomplete, or not an OpenEXR file"),
    "rotten": (rot, "the pixel data is truncated or damaged"),
    "size": (lambda path: write(path, size=(20, 30)), "expected 32 x 24 pixels as in the other frames, got 30 x 20"),
    "fewer passes": (
        lambda path: write(path, "Z"),
        "expected the buffers of the other frames, got a file without depth",
    ),
    "letters": (rename, "a channel has a name that is not in UTF-8"),
    "no light": (lambda path: write(path, "R", "G", "B"), "no radiance among the channels"),
}


def shot(folder: Path, damage: Damage, *broken: int) -> Path:
    """Frames of which some are damaged."""
    folder.mkdir()
    for number in range(1, FRAMES + 1):
        write(folder / f"s.{number:04d}.exr")
    for number in broken:
        damage(folder / f"s.{number:04d}.exr")
    return folder


def denoise(source: Path, out: Path, **settings: Any) -> tuple[list[str], list[str]]:
    """The files that were written, and what was told of files that were left out."""
    told: list[str] = []
    denoise_files([source], out, find_model("noisy"), Settings(**settings), log=told.append)
    return sorted(path.name for path in out.iterdir()), [line for line in told if "left out" in line]


CASES = [(kind, 3, False) for kind in DAMAGES]
CASES += [(kind, broken, both) for kind in ("rotten", "size") for broken in (1, FRAMES) for both in (False, True)]


@pytest.mark.parametrize(("kind", "broken", "both"), CASES)
def test_the_run_goes_on_and_names_the_file(kind: str, broken: int, both: bool, tmp_path: Path) -> None:
    damage, why = DAMAGES[kind]
    source = shot(tmp_path / "in", damage, broken)
    files, told = denoise(source, tmp_path / "out", bidirectional=both)
    assert files == [f"s.{number:04d}.exr" for number in range(1, FRAMES + 1) if number != broken]
    assert len(told) == 1
    assert told[0].startswith(f"s.{broken:04d}.exr is left out, as a missing frame: ")
    assert why in told[0]
    with pytest.raises(clips.ClipError, match=rf"s\.{broken:04d}\.exr: ") as error:
        denoise(source, tmp_path / "strict", strict=True)
    assert why in str(error.value)


def test_the_history_begins_anew_after_it(tmp_path: Path) -> None:
    """Of constant frames, each run is as bright as its own frames and takes nothing of the run before."""
    (tmp_path / "in").mkdir()
    for number in range(1, 5):
        pixels = np.full((8, 8), 100.0 if number > 2 else 1.0, np.float32)
        clips.write_exr(tmp_path / "in" / f"a.{number}.exr", dict.fromkeys("RGB", pixels))
    rot(tmp_path / "in" / "a.3.exr")
    denoise_files([tmp_path / "in"], tmp_path / "out", find_model("taa"))
    np.testing.assert_allclose(clips.read_exr(tmp_path / "out" / "a.4.exr")["R"], 100.0, rtol=1e-6)


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_shot_of_which_nothing_is_left_is_an_error(kind: str, tmp_path: Path) -> None:
    damage, why = DAMAGES[kind]
    source = shot(tmp_path / "in", damage, *range(1, FRAMES + 1))
    if kind in ("size", "fewer passes"):  # all alike are a shot
        assert len(denoise(source, tmp_path / "out")[0]) == FRAMES
        return
    with pytest.raises(clips.ClipError, match=r"s\.000\d\.exr: ") as error:
        denoise_files([source], tmp_path / "out", find_model("noisy"))
    assert why in str(error.value)


@pytest.mark.parametrize("kind", ["truncated", "rotten"])
def test_a_shot_of_which_nothing_is_left_ends_no_run_of_others(kind: str, tmp_path: Path, capsys: Any) -> None:
    """Whether a header tells of the damage or not; the damaged shot comes first, or last."""
    sources = [shot(tmp_path / name, lambda path: None) for name in ("a", "b", "c")]
    for source in (sources[0], sources[2]):
        for path in source.iterdir():
            DAMAGES[kind][0](path)
    command = ["denoise", *map(str, sources), "-o", str(tmp_path / "out"), "--method", "noisy"]
    main.main(command)
    assert [path.parent.name for path in (tmp_path / "out").rglob("*.exr")] == ["b"] * FRAMES
    text = " ".join(capsys.readouterr().out.split())
    assert f"s.#.exr 1-{FRAMES} is left out: " in text
    with pytest.raises(SystemExit) as ended:
        main.main([*command, "--strict"])
    assert ended.value.code == 2
    with pytest.raises(SystemExit) as ended:
        main.main(["denoise", *map(str, sources[::2]), "-o", str(tmp_path / "none"), "--method", "noisy"])
    assert ended.value.code == 2


def test_frames_of_a_shot_that_is_left_out_are_no_frames_to_come(tmp_path: Path) -> None:
    sources, totals = [shot(tmp_path / name, lambda path: None) for name in ("a", "b")], list[int]()
    for path in sources[0].iterdir():
        rot(path)

    def note(path: Path, done: int, total: int) -> None:
        totals.append(total)

    denoise_files(sources, tmp_path / "out", find_model("noisy"), on_frame=note)
    assert totals == [FRAMES] * FRAMES


def test_most_frames_say_what_the_shot_is_among_those_that_are_read(tmp_path: Path) -> None:
    source = shot(tmp_path / "in", lambda path: write(path, "Z"), 1, 2)
    assert denoise(source, tmp_path / "out")[0] == ["s.0003.exr", "s.0004.exr", "s.0005.exr"]
    assert denoise(source, tmp_path / "few", frames=[1, 2]) == (["s.0001.exr", "s.0002.exr"], [])


def test_a_damaged_frame_that_is_not_read_is_no_matter(tmp_path: Path) -> None:
    """Neither for its own history, nor to tell of what all frames consist."""
    (tmp_path / "in").mkdir()
    for number in range(WARM_UP + 2):
        write(tmp_path / "in" / f"s.{number:04d}.exr", size=(2, 3))
    (tmp_path / "in" / "s.0000.exr").write_bytes(b"")
    last = WARM_UP + 1
    done = denoise_files([tmp_path / "in"], tmp_path / "out", box_blur(), Settings(frames=[last]))
    assert [path.name for path in done.files] == [f"s.{last:04d}.exr"]
    assert not done.left_out


def test_the_command_line_ends_with_their_names(tmp_path: Path, capsys: Any) -> None:
    source = shot(tmp_path / "in", DAMAGES["placeholder"][0], 1, 4)
    rot(source / "s.0002.exr")
    command = ["denoise", str(source), "-o", str(tmp_path / "out"), "--method", "noisy"]
    main.main(command)
    text = " ".join(capsys.readouterr().out.split())
    assert "left out as missing: 3 frames: s.0001.exr, s.0004.exr, s.0002.exr (--strict: end there)" in text
    assert "2 frames denoised by noisy" in text
    with pytest.raises(SystemExit) as ended:
        main.main([*command, "--strict"])
    assert ended.value.code == 2
    assert "s.0001.exr: the file is empty (0 bytes)" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("kind", [kind for kind in DAMAGES if kind != "rotten"])
def test_inspect_says_it_too(kind: str, tmp_path: Path, capsys: Any) -> None:
    damage, why = DAMAGES[kind]
    source = shot(tmp_path / "in", damage, 1)
    main.main(["inspect", str(source)])
    text = capsys.readouterr().out
    assert "4 frames of 32 x 24 pixels" in text
    assert "s.0001.exr counts as a missing frame: " in text
    main.main(["inspect", str(source), "--json"])
    found = json.loads(capsys.readouterr().out)["unusable"]
    assert list(found) == ["s.0001.exr"]
    assert why in found["s.0001.exr"]


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_file_that_ends_anywhere_is_incomplete(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Scan lines, tiles, several parts, and windows, as each program writes them."""
    path = write_shot(name, tmp_path, frames=1) / "shot.0001.exr"
    check_complete(path)
    data = path.read_bytes()
    for end in [0, 3, 8, len(data) - 1, *rng.integers(9, len(data) - 1, 30)]:
        path.write_bytes(data[:end])
        with pytest.raises(DamagedFile, match=r"shot\.0001\.exr: the file is (empty|incomplete)"):
            check_complete(path)


@pytest.mark.parametrize("order", [OpenEXR.LineOrder.INCREASING_Y, OpenEXR.LineOrder.DECREASING_Y])
@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA", "DWAB"])
def test_every_compression_and_order_of_lines_is_known_to_be_complete(
    compression: str, order: Any, tmp_path: Path
) -> None:
    about = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "lineOrder": order}
    path = tmp_path / "a.exr"
    OpenEXR.File([part(layer("", truth(0).light, "RGB", np.float16), **about)]).write(str(path))
    check_complete(path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DamagedFile):
        check_complete(path)


def test_programs_are_compiled_as_before(tmp_path: Path) -> None:
    """Leaving a frame out costs no compilation."""
    source = shot(tmp_path / "in", DAMAGES["rotten"][0], 3)
    assert denoise_files([source], tmp_path / "out", box_blur()).programs == 1
