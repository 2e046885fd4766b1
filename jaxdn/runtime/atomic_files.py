"""Writing files so that they are either complete or absent: the one place that writes."""

import json
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary path next to ``path``; rename it to ``path`` if the block succeeds, remove it if it does not.

    Readers therefore see the old file or the new one, never an incomplete one, however the writer is interrupted
    (Ctrl-C, a full disk, a kill: the last leaves a hidden ``.tmp`` file). The data is on disk before the rename.
    Raises FileNotFoundError if the folder is missing, and OSError as the system reports it.
    """
    with _renamed([Path(path)]) as (temporary,):
        yield temporary


def write_atomically(contents: Mapping[Path, bytes | str]) -> None:
    """Write files, text as UTF-8, and rename them in this order when all are on disk.

    On an error while writing none is replaced and nothing is left behind. Raises as :func:`atomic_write` does,
    TypeError for contents that are neither bytes nor text, and ValueError for text that UTF-8 cannot encode.
    """
    with _renamed(list(contents)) as temporaries:
        for temporary, content in zip(temporaries, contents.values(), strict=True):
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: str | Path, value: Any) -> None:
    """Write strict JSON (no NaN, no Infinity), indented, complete or not at all.

    Raises ValueError, naming the file, if ``value`` holds something that JSON cannot represent, and as
    :func:`atomic_write` does.
    """
    try:
        text = json.dumps(value, indent=1, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: cannot be written as JSON ({error}); use plain lists, strings and finite numbers."
        ) from error
    write_atomically({Path(path): text + "\n"})


@contextmanager
def _renamed(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """A temporary path next to each path; renamed if the block succeeds and all their data is on disk, else removed."""
    for path in paths:
        if not path.parent.is_dir():
            raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; create it first.")
    # Two processes, or two threads of one, may write the same file: each needs its own temporary file.
    temporaries = [path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.tmp") for path in paths]
    try:
        yield temporaries
        for temporary in temporaries:
            _sync(temporary)
        for temporary, path in zip(temporaries, paths, strict=True):
            os.replace(temporary, path)
    finally:
        for temporary in temporaries:
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file is on disk: a full or failing disk may report its error only here."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
