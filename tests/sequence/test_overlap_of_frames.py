"""Reading, denoising and writing at the same time: the same files, lines and errors as one after the other."""

import threading
from collections import Counter
from pathlib import Path
from typing import Any

import OpenEXR
import pytest

from jaxdn.data.errors import DamagedFile
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.sequence.frame_denoiser import estimate_bytes
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.data.test_kept import box_blur
from tests.programs import PROGRAMS, write_shot

FRAMES = 5


def tight(source: Path) -> float:
    """Memory for one frame at a time."""
    first = ExrFile(sorted(source.iterdir())[0])
    return estimate_bytes(*first.display.size, len(first.windows))


def denoise(source: Path, out: Path, **settings: Any) -> list[str]:
    """All that is told, in its order."""
    told: list[str] = []
    naming = ChannelNaming(PROGRAMS["Arnold"].motion_convention)
    denoise_files(
        [source],
        out,
        box_blur(),
        Settings(naming=naming, **settings),
        on_frame=lambda path, done, total: told.append(f"{path.name}: {done} of {total}"),
        log=told.append,
    )
    return told


def rot(path: Path) -> None:
    """Damage that no header tells."""
    data = bytearray(path.read_bytes())
    data[-20:] = bytes(20)
    path.write_bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"aovs": "additive", "preview": True}, {"bidirectional": True}], ids=str)
def test_files_and_lines_are_those_of_one_frame_at_a_time(settings: Any, tmp_path: Path) -> None:
    """A damaged frame in the middle is told after the frames before it."""
    source = write_shot("Arnold", tmp_path / "in", FRAMES)
    rot(sorted(source.iterdir())[2])
    told = denoise(source, tmp_path / "beside", **settings)
    assert told == denoise(source, tmp_path / "alone", max_memory=tight(source), **settings)
    files = {path.name: path.read_bytes() for path in (tmp_path / "beside").iterdir()}
    assert files == {path.name: path.read_bytes() for path in (tmp_path / "alone").iterdir()}
    done = [line.rpartition(": ")[2] for line in told if line.endswith(("of 4", "of 5"))]
    first = "of 4" if "bidirectional" in settings else "of 5"  # backwards, the damage is found first
    assert done == [f"1 {first}", f"2 {first}", "3 of 4", "4 of 4"]
    assert any("is left out, as a missing frame" in line for line in told)


@pytest.mark.parametrize("alone", [False, True])
def test_files_are_read_and_written_in_threads_where_memory_allows(
    alone: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first file is needed at once; every other one, and all results, are for threads."""
    source = write_shot("Arnold", tmp_path / "in", FRAMES)
    limit = tight(source) if alone else None
    counts: Counter[tuple[str, str]] = Counter()
    opened = OpenEXR.File

    def count(*arguments: Any, **options: Any) -> Any:
        if not options.get("header_only"):
            written = not isinstance(arguments[0], str)
            where = threading.current_thread().name.partition("_")[0]
            if written or Path(arguments[0]).parent == source:
                counts["written" if written else "read", where] += 1
        return opened(*arguments, **options)

    monkeypatch.setattr(OpenEXR, "File", count)
    denoise(source, tmp_path / "out", max_memory=limit)
    main = threading.current_thread().name
    if alone:
        assert counts == {("read", main): FRAMES, ("written", main): FRAMES}
    else:
        assert counts == {("read", main): 1, ("read", "jaxdn-read"): FRAMES - 1, ("written", "jaxdn-write"): FRAMES}


def fill_disk(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """OpenEXR cannot write more than so many files."""
    opened, written = OpenEXR.File, [0]

    class Full:
        def write(self, path: str) -> None:
            Path(path).write_bytes(b"half")
            raise RuntimeError("No space left on device.")

    def count(*arguments: Any, **options: Any) -> Any:
        if isinstance(arguments[0], str):
            return opened(*arguments, **options)
        written[0] += 1
        return opened(*arguments, **options) if written[0] <= after else Full()

    monkeypatch.setattr(OpenEXR, "File", count)


def test_a_full_disk_ends_the_run_and_leaves_whole_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_shot("Arnold", tmp_path / "in", FRAMES)
    fill_disk(monkeypatch, 2)
    names = [path.name for path in sorted(source.iterdir())]
    with pytest.raises(OSError, match="could not write the frame") as error:
        denoise(source, tmp_path / "out")
    assert str(error.value.filename).endswith(names[2])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names[:2]


def test_a_full_disk_is_told_before_a_damaged_frame_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_shot("Arnold", tmp_path / "in", FRAMES)
    rot(sorted(source.iterdir())[2])
    fill_disk(monkeypatch, 1)
    with pytest.raises(OSError, match="could not write the frame"):
        denoise(source, tmp_path / "out", strict=True)


def test_strict_ends_at_a_damaged_frame_with_those_before_it_written(tmp_path: Path) -> None:
    source = write_shot("Arnold", tmp_path / "in", FRAMES)
    files = sorted(source.iterdir())
    rot(files[3])
    with pytest.raises(DamagedFile, match=files[3].name):
        denoise(source, tmp_path / "out", strict=True)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [file.name for file in files[:3]]


def test_ctrl_c_leaves_whole_files_and_no_threads(tmp_path: Path) -> None:
    source = write_shot("Arnold", tmp_path / "in", FRAMES)

    def interrupt(path: Path, done: int, total: int) -> None:
        raise KeyboardInterrupt

    naming = ChannelNaming(PROGRAMS["Arnold"].motion_convention)
    with pytest.raises(KeyboardInterrupt):
        denoise_files([source], tmp_path / "out", box_blur(), Settings(naming=naming), on_frame=interrupt)
    written = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in written] == [file.name for file in sorted(source.iterdir())[: len(written)]]
    for path in written:
        ExrFile(path).decode()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("jaxdn-read", "jaxdn-write"))]
