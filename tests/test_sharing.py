"""What processes share is made once, whoever asks first, and complete when the others get it."""

import threading
from pathlib import Path

import pytest

from tests.sharing import make_once


def test_who_asks_while_it_is_made_waits_and_makes_nothing(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Locks of files are held by whoever has opened them: threads are as processes are."""
    made: list[Path] = []
    found: list[list[str]] = []

    def make(folder: Path) -> None:
        made.append(folder)
        (folder / "half").touch()
        waiting.start()
        waiting.join(0.2)  # in which it would come back, if it did not wait
        (folder / "whole").touch()

    def ask() -> None:
        found.append(sorted(path.name for path in make_once(tmp_path_factory, "asked twice", make).iterdir()))

    waiting = threading.Thread(target=ask)
    ask()
    waiting.join()
    assert found == [["half", "whole"]] * 2
    assert len(made) == 1


def test_what_failed_is_made_by_who_asks_next(tmp_path_factory: pytest.TempPathFactory) -> None:
    def fail(folder: Path) -> None:
        (folder / "half").touch()
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        make_once(tmp_path_factory, "failed", fail)
    folder = make_once(tmp_path_factory, "failed", lambda folder: (folder / "whole").touch())
    assert (folder / "whole").exists()
