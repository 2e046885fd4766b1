"""Writing files so that they are either complete or absent: the one place that writes."""

import hashlib
import json
import os
import platform
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_ABANDONED_S = 24 * 3600
_LONGEST = 128
"""Bytes of a name that a host, a process, a thread and an ending are added to."""


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
    # Two machines, processes, or threads of one, may write the same file: each needs its own temporary file.
    writer = f"{_host()}.{os.getpid()}.{threading.get_ident()}"
    temporaries = [path.with_name(f".{_shorten(path.name)}.{writer}.tmp") for path in paths]
    try:
        yield temporaries
        for temporary in temporaries:
            _sync(temporary)
        for temporary, path in zip(temporaries, paths, strict=True):
            os.replace(temporary, path)
    finally:
        for temporary in temporaries:
            temporary.unlink(missing_ok=True)


def remove_abandoned(folder: str | Path) -> None:
    """Remove the temporary files that killed processes left in a folder: of this machine, and any that is a day old.

    What cannot be removed stays: another user's file in a shared folder, or one that another program holds open.
    """
    for path in Path(folder).glob(".*.tmp"):
        match = re.fullmatch(r"\..+\.(?P<host>[\w-]+)\.(?P<process>\d+)\.\d+\.tmp", path.name)
        if match is None:
            continue
        try:
            old = time.time() - path.stat().st_mtime > _ABANDONED_S
            if old or (match["host"] == _host() and not _runs(int(match["process"]))):
                path.unlink()
        except OSError:
            continue


def _shorten(name: str) -> str:
    """The name of a file, or a digest of one that leaves no room for more: a name has at most 255 bytes."""
    coded = name.encode(errors="surrogatepass")
    return name if len(coded) <= _LONGEST else hashlib.sha256(coded).hexdigest()


def _host() -> str:
    """This machine's name, as a part of a file's name: process numbers say nothing on a shared disk."""
    return re.sub(r"[^\w-]", "-", platform.node(), flags=re.ASCII)[:40] or "here"


def _runs(process: int) -> bool:
    """Whether a process of this machine may still run."""
    if os.name == "nt":  # where the call below would send Ctrl-C
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _sync(path: Path) -> None:
    """Wait until a file is on disk: a full or failing disk may report its error only here."""
    handle = os.open(path, os.O_RDWR)  # Windows does not flush what is open for reading alone
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
