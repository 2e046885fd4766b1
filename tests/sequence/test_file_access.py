"""How often ``jaxdn denoise`` opens and decodes the files of another renderer: measured at the OpenEXR package."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import OpenEXR
import pytest

from experiments.stability.memory import write_sequence
from jaxdn.commands.arguments import Denoise
from jaxdn.commands.denoise import run_denoise
from jaxdn.data.clip.folder import refuse_unfinished
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.read import read_clip
from jaxdn.sequence.frame_denoiser import STEP, estimate_bytes
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model
from tests.data.test_kept import box_blur
from tests.programs import PROGRAMS, write_shot

FRAMES = 4


@contextmanager
def counted(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[Counter[tuple[str, str]]]:
    """(name of a file of the folder, or "results" for all others; "header" or "pixels") -> how often it was opened."""
    counts: Counter[tuple[str, str]] = Counter()
    opened = OpenEXR.File

    def count(*arguments: Any, **options: Any) -> Any:
        if arguments and isinstance(arguments[0], str):  # else a file is written
            path = Path(arguments[0])
            name = path.name if path.parent == folder else "results"
            counts[name, "header" if options.get("header_only") else "pixels"] += 1
        return opened(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(OpenEXR, "File", count)
        yield counts


def expected(folder: Path, *, headers: int, decodes: int, results: int) -> dict[tuple[str, str], int]:
    """So many openings of every file for its header and its pixels, and one for the header of every result."""
    names = sorted(file.name for file in folder.iterdir())
    found = {(name, "header"): headers for name in names} | {(name, "pixels"): decodes for name in names}
    return found | {("results", "header"): results}


@pytest.mark.parametrize("aovs", ["keep", "additive"])
@pytest.mark.parametrize("name", ["Blender", "Arnold", "Houdini"])
def test_a_file_is_opened_and_decoded_once(name: str, aovs: Any, tmp_path: Path, monkeypatch: Any) -> None:
    """One look at each header for the size of the sequence, one decoding: frame, additive layers, result share it.

    Results are not: whether all of one was written is told by its size and the places of its chunks.
    """
    source = write_shot(name, tmp_path / "in", FRAMES)
    settings = Settings(naming=ChannelNaming(PROGRAMS[name].motion_convention), aovs=aovs)
    with counted(monkeypatch, source) as counts:
        denoise_files([source], tmp_path / "out", box_blur(), settings)
    assert counts == expected(source, headers=1, decodes=1, results=FRAMES)


def test_the_table_of_the_command_shares_the_first_file(tmp_path: Path, monkeypatch: Any) -> None:
    source = write_shot("Blender", tmp_path / "in", FRAMES)
    with counted(monkeypatch, source) as counts:
        run_denoise(Denoise([source], tmp_path / "out", method="noisy"))
    assert counts == expected(source, headers=1, decodes=1, results=FRAMES)


def test_both_directions_decode_once_each(tmp_path: Path, monkeypatch: Any) -> None:
    """The first file decides for all, so the backward direction reads it first and last; channels are counted once."""
    source = write_shot("Blender", tmp_path / "in", FRAMES)
    with counted(monkeypatch, source) as counts:
        denoise_files([source], tmp_path / "out", box_blur(), Settings(bidirectional=True))
    first = {("shot.0001.exr", "pixels"): 3}
    assert counts == expected(source, headers=1, decodes=2, results=FRAMES) | first


@pytest.mark.slow
def test_pixels_are_dropped_while_a_frame_is_denoised_in_tiles(tmp_path: Path, monkeypatch: Any) -> None:
    """Memory is short then: they are decoded once more to be written."""
    height, width = 300, 520
    source = tmp_path / "in"
    write_sequence(source, 2, height, width)
    channels = len(ExrFile(source / "frame_0001.exr").windows)
    limit = estimate_bytes(height, width, channels) - STEP * (height * width - 288 * 288)
    settings = Settings(naming=ChannelNaming("previous-current"), max_memory=limit, safe=False)
    with counted(monkeypatch, source) as counts:
        denoise_files([source], tmp_path / "out", find_model("taa"), settings)
    assert counts == expected(source, headers=1, decodes=2, results=2)


def test_frames_before_the_wanted_ones_are_decoded_once(tmp_path: Path, monkeypatch: Any) -> None:
    source = write_shot("Blender", tmp_path / "in", FRAMES)
    with counted(monkeypatch, source) as counts:
        denoise_files([source], tmp_path / "out", box_blur(), Settings(frames=[FRAMES]))
    assert counts == expected(source, headers=1, decodes=1, results=1)


def test_a_folder_is_recognised_by_headers_alone(tmp_path: Path, monkeypatch: Any) -> None:
    """A ``frame_0000.exr`` of another renderer is not decoded to see that it is no frame of an unfinished clip."""
    write_sequence(tmp_path / "in", 1, 20, 30)
    (tmp_path / "in" / "frame_0001.exr").rename(tmp_path / "in" / "frame_0000.exr")
    with counted(monkeypatch, tmp_path / "in") as counts:
        refuse_unfinished(tmp_path / "in")
    assert counts == {("frame_0000.exr", "header"): 1}
    assert read_clip(tmp_path / "in", motion_convention="none").frames.radiance.shape == (1, 20, 30, 3)
