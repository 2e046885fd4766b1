"""A folder for files of one run, which goes with it; what a killed run left behind is removed by the next."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxdn.runtime.locks import try_lock


@contextmanager
def scratch_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """A new folder ``parent/prefix...``, removed when the block is left, however it is left.

    A killed process cannot remove its folder. The next one does: it finds the folders whose process has gone by the
    lock on the file beside each of them, which the system gives up with the process. Folders of other processes that
    still work stay, also those of other machines that share a disk with locks.
    """
    remove_abandoned_folders(parent, prefix)
    lock, handle = _new_lock(parent, prefix)
    folder = lock.with_suffix("")
    try:
        folder.mkdir()
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)
        _remove(lock)


def _new_lock(parent: Path, prefix: str) -> tuple[Path, int]:
    """A file that is locked before anybody can see its folder, and its handle."""
    while True:
        lock = parent / f"{prefix}{secrets.token_hex(4)}.lock"
        handle = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_RDWR)
        # Another process may take it for abandoned before it is locked: it has the lock, or has removed the file.
        if try_lock(handle) is not False and lock.exists():
            return lock, handle
        os.close(handle)
        _remove(lock)


def remove_abandoned_folders(parent: Path, prefix: str) -> None:
    """Remove the scratch folders, and the files beside them, whose process has gone."""
    names = {path.name.removesuffix(".lock") for path in parent.iterdir() if path.name.startswith(prefix)}
    for name in names:
        lock = parent / f"{name}.lock"
        try:
            handle = os.open(lock, os.O_RDWR)
        except FileNotFoundError:  # the lock comes before the folder and goes after it
            shutil.rmtree(parent / name, ignore_errors=True)
            continue
        except OSError:
            continue
        try:
            free = try_lock(handle)
            if free:
                shutil.rmtree(parent / name, ignore_errors=True)
                _remove(lock)  # while it is locked: once it is not, whoever has made it may lock it and go on
        finally:
            os.close(handle)
        if free:  # Windows does not remove what is open
            _remove(lock)


def _remove(lock: Path) -> None:
    """Remove a file; on Windows it stays while another process looks at it, and the next run removes it."""
    with suppress(OSError):
        lock.unlink()
