"""Scratch folders: gone with the run, of a killed run with the next, and never those of a run that still works."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxdn.runtime.scratch import scratch_folder

WORK = """
import pathlib, sys
from jaxdn.runtime.scratch import scratch_folder
with scratch_folder(pathlib.Path(sys.argv[1]), ".work-") as folder:
    (folder / "a.npy").write_text("")
    print(flush=True)
    sys.stdin.readline()
"""


def start(folder: Path) -> "subprocess.Popen[str]":
    """A process with a scratch folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", WORK, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "\n"
    return process


@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt])
def test_nothing_is_left_however_it_ends(error: type[BaseException] | None, tmp_path: Path) -> None:
    try:
        with scratch_folder(tmp_path, ".work-") as folder:
            (folder / "a.npy").write_text("")
            if error is not None:
                raise error
    except (ValueError, KeyboardInterrupt):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_removed_by_the_next_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / ".work-older").mkdir()  # of a version without locks
    (tmp_path / ".work-older" / "a.npy").write_text("")
    (tmp_path / "frame.exr").write_text("")
    killed, working = start(tmp_path), start(tmp_path)
    killed.kill()
    killed.communicate()
    before = {path.name for path in tmp_path.iterdir() if path.is_dir()}
    with scratch_folder(tmp_path, ".work-") as mine:
        there = {path.name for path in tmp_path.iterdir() if path.is_dir()}
        assert len(there - before) == 1
        assert len(there & before) == 1  # that of the process that works
        assert (mine.is_dir(), (tmp_path / ".work-older").exists()) == (True, False)
        assert [path.name for path in tmp_path.glob(".work-*/*.npy")] == ["a.npy"]
    working.communicate("\n", timeout=30)
    assert working.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["frame.exr"]
