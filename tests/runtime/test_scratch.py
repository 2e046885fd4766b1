"""Scratch folders: gone with the run, of a killed run with the next, and never those of a run that still works."""

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from jaxdn.runtime.scratch import remove_abandoned_folders, scratch_folder
from tests.needs import require_module

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


def refuse_locks(monkeypatch: pytest.MonkeyPatch, refusals: Iterator[int | None]) -> None:
    """Locking a file fails with these error numbers, one a call; None: it succeeds."""
    fcntl = require_module("fcntl")

    def lock(handle: int, mode: int) -> None:
        if (number := next(refusals)) is not None:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", lock)


def test_a_folder_whose_file_another_process_has_locked_first_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other process takes it for abandoned and removes it in a moment."""
    refuse_locks(monkeypatch, iter([errno.EWOULDBLOCK, None]))
    names = iter(["taken", "mine"])
    monkeypatch.setattr("secrets.token_hex", lambda count: next(names))
    with scratch_folder(tmp_path, ".work-") as folder:
        assert folder.name == ".work-mine"
        assert not (tmp_path / ".work-taken").exists()
    assert list(tmp_path.iterdir()) == []


def test_a_disk_without_locks_has_scratch_folders_that_nobody_removes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_locks(monkeypatch, iter([errno.ENOLCK] * 2))
    with scratch_folder(tmp_path, ".work-") as folder:
        remove_abandoned_folders(tmp_path, ".work-")
        assert folder.is_dir()
    assert list(tmp_path.iterdir()) == []
