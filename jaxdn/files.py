"""Files that are either whole or not there: the one place that writes."""

import json
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """Give a temporary path next to ``path``; rename it to ``path`` if the block succeeds, remove it if it does not.

    Readers therefore see the old file or the new one, never half of one, whatever interrupts the writer (Ctrl-C, a full
    disk, a kill: the last leaves a hidden ``.tmp`` file, never a broken one). The data is on disk before the rename.
    Raises FileNotFoundError if the folder is missing, and OSError as the system reports it.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; create it first.")
    # Two processes, or two threads of one, may write the same file: each needs its own.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.tmp")
    try:
        yield temporary
        handle = os.open(temporary, os.O_RDONLY)
        try:
            os.fsync(handle)  # a full or failing disk may only say so here
        finally:
            os.close(handle)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_whole(contents: Mapping[Path, bytes | str]) -> None:
    """Write files, text as UTF-8, and then rename them in this order; on an error while writing none is replaced."""
    with ExitStack() as stack:
        for path, content in reversed(contents.items()):  # the stack renames in the opposite order
            stack.enter_context(whole(path)).write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: str | Path, value: Any) -> None:
    """Write strict JSON (no NaN, no Infinity), indented, whole or not at all.

    Raises ValueError, naming the file, if ``value`` holds something that JSON has no word for.
    """
    try:
        text = json.dumps(value, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: cannot be written as JSON ({error}); use plain lists, strings and finite numbers."
        ) from error
    write_whole({Path(path): text + "\n"})
