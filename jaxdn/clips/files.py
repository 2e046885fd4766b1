"""Files that are either whole or not there, and the error that everything in this room raises."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class ClipError(ValueError):
    """A clip, frame or record that cannot be used; the message names the file, the reason and what to do."""


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; rename it to ``path`` if the block succeeds, remove it if it does not.

    Readers therefore see the old file or the new one, never half of one, whatever interrupts the writer (Ctrl-C, a full
    disk, a kill: the last leaves a hidden ``.tmp`` file, never a broken frame). The data is on disk before the rename.
    Raises FileNotFoundError if the folder is missing, and OSError as the system reports it.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; create it first.")
    # Two processes, or two threads of one, may write the same frame: each needs its own file.
    beside = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.tmp")
    try:
        yield beside
        handle = os.open(beside, os.O_RDONLY)
        try:
            os.fsync(handle)  # a full or failing disk may only say so here
        finally:
            os.close(handle)
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def write_json(path: str | Path, value: Any) -> None:
    """Write strict JSON (no NaN, no Infinity), indented, whole or not at all.

    Raises ClipError if ``value`` holds something that JSON has no word for.
    """
    try:
        text = json.dumps(value, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ClipError(
            f"{path}: the record cannot be written as JSON ({error}); use plain lists, strings and finite numbers."
        ) from error
    with whole(path) as beside:
        beside.write_text(text + "\n", encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Read strict JSON. Raises ClipError, naming the file and the place, if it is missing or broken."""
    path = Path(path)

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is not a JSON number")

    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except FileNotFoundError as error:
        raise ClipError(f"{path}: there is no such file.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ClipError(f"{path}: not readable as JSON ({error}); restore it or render the clip again.") from error
