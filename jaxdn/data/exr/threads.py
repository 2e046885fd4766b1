"""Blocks of rows of an EXR file, compressed and decompressed side by side."""

from collections.abc import Iterator
from contextlib import contextmanager

import OpenEXR

from jaxdn.runtime.cores import count_cores


@contextmanager
def exr_on_all_cores() -> Iterator[None]:
    """While it is entered, files are read and written by as many threads as this process may use cores; same bytes.

    OpenEXR begins without threads. Its threads are those of the process: one that is forked meanwhile waits for them
    for ever, so that a library does not start them unasked. An OpenEXR whose number of threads cannot be set has none.
    """
    if not hasattr(OpenEXR, "set_global_thread_count"):
        yield
        return
    before, cores = OpenEXR.global_thread_count(), count_cores()
    OpenEXR.set_global_thread_count(cores if cores > 1 else 0)
    try:
        yield
    finally:
        OpenEXR.set_global_thread_count(before)
