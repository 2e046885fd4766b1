"""Locks of files, which the system gives up with the process that has them."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOCK = ".lock"
"""The file that is locked for its folder. It stays there: if it were removed, two processes could lock two of them."""


@contextmanager
def lock_folder(folder: Path, busy: str) -> Iterator[None]:
    """Have a folder, which is made if it does not exist, to oneself.

    Raises ValueError, with the folder and ``busy``, if another process has locked it, on this machine or on another
    that shares the disk. Where a disk has no locks, nobody is kept out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR)
    try:
        if try_lock(handle) is False:
            raise ValueError(f"{folder}: {busy}")
        yield
    finally:
        os.close(handle)


def try_lock(handle: int) -> bool | None:
    """Lock a file for as long as it is open in this process; False if another has locked it, None if nobody can."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):  # the second on Windows
        return False
    except OSError:  # the disk has no locks
        return None
    return True
