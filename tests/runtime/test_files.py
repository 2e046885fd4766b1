"""However a writer is interrupted, a file is the old one or the new one, and no other file is left in its folder."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from jaxdn.runtime import atomic_files
from jaxdn.runtime.atomic_files import atomic_write, write_atomically, write_json


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the old versions of two files."""
    for name in ("a", "b"):
        (tmp_path / name).write_text("old")
    return tmp_path


OLD = {"a": "old", "b": "old"}


def test_a_file_appears_when_it_is_complete(folder: Path) -> None:
    with atomic_write(folder / "a") as temporary:
        temporary.write_text("new")
        assert (folder / "a").read_text() == "old"
        assert temporary.parent == folder  # a rename from another disk would be a copy
        assert temporary.name.startswith(".")
    assert contents(folder) == {"a": "new", "b": "old"}


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt, SystemExit])
def test_a_writer_that_stops_leaves_only_the_old_file(folder: Path, error: type[BaseException]) -> None:
    def write() -> None:
        with atomic_write(folder / "a") as temporary:
            temporary.write_text("half of the n")
            raise error

    with pytest.raises(error):
        write()
    assert contents(folder) == OLD


def test_a_writer_that_wrote_nothing_is_an_error(folder: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_write(folder / "a"):
        pass
    assert contents(folder) == OLD


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_late_disk_error_leaves_the_old_file(folder: Path, monkeypatch, name: str) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_files.os, name, refuse)
    with pytest.raises(OSError, match="No space left"):
        write_atomically({folder / "a": "new"})
    assert contents(folder) == OLD


def test_a_disk_error_for_one_of_several_files_replaces_none(folder: Path, monkeypatch) -> None:
    synced: list[int] = []
    sync = os.fsync

    def refuse_the_second(handle: int) -> None:
        synced.append(handle)
        if len(synced) == 2:
            raise OSError(28, "No space left on device")
        sync(handle)

    monkeypatch.setattr(atomic_files.os, "fsync", refuse_the_second)
    with pytest.raises(OSError, match="No space left"):
        write_atomically({folder / "a": "new", folder / "b": "new"})
    assert contents(folder) == OLD


def test_several_files_are_renamed_in_their_order_and_after_all_are_written(folder: Path, monkeypatch) -> None:
    renamed: list[str] = []
    replace = os.replace

    def noted(temporary: Path, path: Path) -> None:
        assert len([name for name in os.listdir(folder) if name.endswith(".tmp")]) == 2 - len(renamed)
        renamed.append(path.name)
        replace(temporary, path)

    monkeypatch.setattr(atomic_files.os, "replace", noted)
    write_atomically({folder / "b": "é", folder / "a": b"\x00"})
    assert renamed == ["b", "a"]
    assert (folder / "b").read_bytes() == "é".encode()
    assert (folder / "a").read_bytes() == b"\x00"


@pytest.mark.parametrize("bad", [3, None, "\ud800"])
def test_contents_that_cannot_be_written_replace_nothing(folder: Path, bad: object) -> None:
    with pytest.raises((TypeError, ValueError)):
        write_atomically({folder / "a": "new", folder / "b": bad})  # type: ignore[dict-item]
    assert contents(folder) == OLD


def test_a_folder_that_is_missing_is_named_before_anything_is_written(folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist; create it first"):
        write_atomically({folder / "a": "new", folder / "nowhere" / "b": "new"})
    assert contents(folder) == OLD


def test_threads_do_not_write_into_each_others_file(tmp_path: Path) -> None:
    texts = [str(digit) * 10_000 for digit in range(8)]
    threads = [threading.Thread(target=write_atomically, args=({tmp_path / "a": text},)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() in texts


@pytest.mark.parametrize("letter", ["a", "\N{CJK UNIFIED IDEOGRAPH-5F71}"])
def test_names_may_be_as_long_as_the_system_allows(tmp_path: Path, letter: str) -> None:
    stem = letter * (240 // len(letter.encode()))
    write_atomically({tmp_path / f"{stem}.{ending}": ending for ending in ("exr", "png")})
    assert contents(tmp_path) == {f"{stem}.exr": "exr", f"{stem}.png": "png"}


def test_json_round_trips(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"é": [1, 2.5, None, True]})
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"é": [1, 2.5, None, True]}
    assert text.endswith("\n")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}, b"x", object()])
def test_values_without_a_json_form_are_refused_by_name(folder: Path, value: object) -> None:
    with pytest.raises(ValueError, match=r"a: cannot be written as JSON .*finite numbers"):
        write_json(folder / "a", {"value": value})
    assert contents(folder) == OLD


def test_what_killed_processes_left_behind_is_removed_and_nothing_of_living_ones(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = atomic_files._host()
    names = {
        f".a.exr.{host}.{dead.pid}.1.tmp": os.name == "nt",  # where nobody can tell
        f".a.exr.{host}.{os.getpid()}.1.tmp": True,
        f".a.exr.another-{host}.{dead.pid}.1.tmp": True,
        ".a.exr.elsewhere.7.1.tmp": False,  # a day old
        ".mine.tmp": True,
    }
    for name in names:
        (tmp_path / name).write_text("half")
    os.utime(tmp_path / ".a.exr.elsewhere.7.1.tmp", (0, 0))
    atomic_files.remove_abandoned(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {name for name, kept in names.items() if kept}


def test_what_cannot_be_removed_stays_and_the_rest_is_removed(tmp_path: Path) -> None:
    other, own = (tmp_path / f".{name}.exr.elsewhere.7.1.tmp" for name in ("a", "b"))
    other.mkdir()  # no user may unlink it, root neither
    own.write_text("half")
    for path in (other, own):
        os.utime(path, (0, 0))
    atomic_files.remove_abandoned(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [other.name]


def test_temporary_names_differ_between_machines(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = set()
    for host in ("node-1", "node-2", "", "a strange/name", "n" * 300):
        monkeypatch.setattr("platform.node", lambda host=host: host)
        with atomic_write(folder / "a") as temporary:
            temporary.write_text("new")
            names.add(temporary.name)
    assert len(names) == 5
