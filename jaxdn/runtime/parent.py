"""Worker processes that end with the process that started them, however that ends."""

import multiprocessing
import multiprocessing.connection
import os
import threading


def end_with_parent() -> None:
    """End this process, which ``multiprocessing`` started, as soon as its parent has ended: killed or not.

    Without it a worker whose parent is killed goes on until its task is done, and nobody reads the result. It does
    nothing in a process that ``multiprocessing`` did not start.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_and_exit, args=(parent.sentinel,), daemon=True).start()


def _wait_and_exit(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)  # not sys.exit: this is not the main thread, which may be in compiled code
