"""Windows and macOS, as far as Linux can tell: what their systems refuse is refused here, and nothing needs it."""

import ast
import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxdn
from jaxdn.clips import write_exr
from jaxdn.runtime import atomic_files, locks
from jaxdn.runtime.atomic_files import remove_abandoned, write_atomically
from jaxdn.runtime.scratch import scratch_folder
from jaxdn.sequence.frame_denoiser import measure_machine_memory
from tests.needs import require

SOURCES = sorted(Path(jaxdn.__file__).parent.rglob("*.py"))
POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog"}
POSIX_NAMES = {
    "os": {
        *("fork", "kill", "killpg", "getuid", "geteuid", "getgid", "getpgid", "setsid", "sysconf", "statvfs", "chown"),
        *("sched_getaffinity", "uname", "nice", "getloadavg", "wait", "register_at_fork", "O_DIRECTORY", "mkfifo"),
    },
    "signal": {"SIGKILL", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGALRM", "SIGCHLD", "SIGQUIT", "alarm", "pause"},
    "select": {"poll", "epoll", "kqueue"},
}
"""What Windows lacks, or does differently."""
GUARDS = ("sys.platform", "os.name", "hasattr(", "getattr(", "except (AttributeError")


def find_unguarded(source: str) -> list[str]:
    """Uses of what Windows lacks in functions that do not ask where they run, and outside functions."""
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    guarded = [
        node for node in functions if any(guard in (ast.get_source_segment(source, node) or "") for guard in GUARDS)
    ]
    found = []
    for node in ast.walk(tree):
        names: set[str] = set()
        if isinstance(node, ast.Import):
            names = {alias.name for alias in node.names} & POSIX_MODULES
        elif isinstance(node, ast.ImportFrom):
            names = {node.module or ""} & POSIX_MODULES
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names = {node.attr} & POSIX_NAMES.get(node.value.id, set())
        inside = any(one.lineno <= getattr(node, "lineno", 0) <= (one.end_lineno or 0) for one in guarded)
        found += [] if inside else [f"{node.lineno}: {name}" for name in names]  # type: ignore[attr-defined]
    return found


@pytest.mark.slow
def test_nothing_that_windows_lacks_is_called_without_asking() -> None:
    unguarded = {path.name: found for path in SOURCES if (found := find_unguarded(path.read_text("utf-8")))}
    assert unguarded == {}


def test_the_search_finds_what_it_looks_for() -> None:
    assert find_unguarded("import fcntl\n") == ["1: fcntl"]
    assert find_unguarded("def f():\n    os.kill(1, 0)\n") == ["2: kill"]
    assert find_unguarded("def f():\n    if os.name == 'nt':\n        return\n    os.kill(1, 0)\n") == []


@pytest.fixture
def windows_flushes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows flushes no file that is open for reading alone: ``FlushFileBuffers`` asks for write access."""
    require("fcntl")
    import fcntl

    flush = os.fsync

    def refuse_readers(handle: int) -> None:
        if fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        flush(handle)

    monkeypatch.setattr(os, "fsync", refuse_readers)


@pytest.mark.usefixtures("windows_flushes")
def test_files_are_written_where_only_writers_may_flush(tmp_path: Path) -> None:
    write_atomically({tmp_path / "a.json": "{}"})
    write_exr(tmp_path / "a.exr", {"R": np.zeros((4, 4), np.float32)})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.json"]


def test_on_windows_no_process_is_sent_a_signal_to_see_whether_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(process: int, number: int) -> None:
        raise AssertionError("os.kill(process, 0) is Ctrl-C there")

    left = tmp_path / f".a.exr.{atomic_files._host()}.4000000.1.tmp"
    left.touch()
    monkeypatch.setattr(atomic_files, "os", SimpleNamespace(**{**vars(os), "name": "nt", "kill": refuse}))
    remove_abandoned(tmp_path)
    assert left.exists()
    os.utime(left, (0, 0))
    remove_abandoned(tmp_path)
    assert not left.exists()


def test_scratch_folders_are_locked_as_windows_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Byte ranges that one handle alone holds, and files that cannot be removed while anybody has them open."""
    held: set[tuple[int, int]] = set()

    def lock(handle: int, mode: int, count: int) -> None:
        about = os.fstat(handle)
        if mode != 2 or (about.st_dev, about.st_ino) in held:
            raise OSError(errno.EACCES, "Permission denied")
        held.add((about.st_dev, about.st_ino))

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=lock, LK_NBLCK=2))
    monkeypatch.setattr(locks, "sys", SimpleNamespace(platform="win32"))
    left = tmp_path / ".backwards-dead.lock"
    left.touch()
    left.with_suffix("").mkdir()
    with scratch_folder(tmp_path, ".backwards-") as first:
        assert not left.exists()
        assert not left.with_suffix("").exists()
        with scratch_folder(tmp_path, ".backwards-") as second:
            assert first.is_dir()
            assert second != first
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_another_process_looks_at_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".backwards-dead.lock").touch()

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "The process cannot access the file", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", refuse)
        with scratch_folder(tmp_path, ".backwards-") as folder:
            assert folder.is_dir()
    with scratch_folder(tmp_path, ".backwards-"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_system_that_does_not_tell_its_memory_limits_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sysconf")
    assert measure_machine_memory() == float("inf")


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_names_that_a_terminal_cannot_show_end_nothing(tmp_path: Path, encoding: str) -> None:
    """A shot's name in three scripts is printed, and so is a message about a file whose name is Latin-1."""
    shot = tmp_path / "Küche 影絵"
    shot.mkdir()
    write_exr(shot / "影.0001.exr", {name: np.ones((8, 8), np.float32) for name in "RGB"})
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    lost = os.fsdecode(b"K\xfcche.exr") if os.name == "posix" else "Küche.exr"
    for path, code in ((str(shot), 0), (str(tmp_path / lost), 2)):
        command = [sys.executable, "-m", "jaxdn.commands.main", "inspect", path]
        done = subprocess.run(command, env=environment, capture_output=True, check=False, timeout=600)
        assert done.returncode == code, done.stderr
        assert b"Traceback" not in done.stderr
    assert b"che" in done.stderr
