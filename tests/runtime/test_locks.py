"""A locked folder: for one process at a time, and free again when that one is gone, however it went."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxdn.runtime.locks import lock_folder
from tests.needs import require_module

HOLD = """
import pathlib, sys
from jaxdn.runtime.locks import lock_folder
with lock_folder(pathlib.Path(sys.argv[1]), "it is taken."):
    print(flush=True)
    sys.stdin.readline()
"""


def test_a_folder_is_for_one_process_until_that_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "run"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "\n"
        with pytest.raises(ValueError, match=r"run: it is taken\."), lock_folder(folder, "it is taken."):
            pass
        other.kill()
    with lock_folder(folder, "it is taken."):
        assert folder.is_dir()
    with lock_folder(folder, "it is taken."):
        pass


def test_a_disk_without_locks_keeps_nobody_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(handle: int, mode: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(require_module("fcntl"), "flock", refuse)
    with lock_folder(tmp_path, "it is taken."), lock_folder(tmp_path, "it is taken."):
        pass
