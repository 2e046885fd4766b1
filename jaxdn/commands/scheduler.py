"""The machines of a Dask cluster as an executor: what ``--scheduler`` names."""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path

_RETRIES = 3
"""How often a task that failed, or whose worker was lost, is begun again before the failure counts."""
_CONNECT_S = 30


@contextmanager
def open_scheduler(scheduler: str) -> Iterator[Executor]:
    """The executor of a running Dask cluster, by its scheduler's address or the path of its scheduler file (.json).

    Raises ValueError where no scheduler answers and for a file that is missing, and ModuleNotFoundError without the
    extra ``farm``.
    """
    from distributed import Client

    if scheduler.endswith(".json"):
        if not Path(scheduler).is_file():
            raise ValueError(
                f"scheduler {scheduler}: there is no such file; start `dask scheduler --scheduler-file {scheduler}`."
            )
        place = {"scheduler_file": scheduler}
    else:
        place = {"address": scheduler}
    try:
        client = Client(**place, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"scheduler {scheduler}: none answers ({error}); give the address that `dask scheduler` prints."
        ) from error
    try:
        print(f"{len(client.scheduler_info(n_workers=-1)['workers'])} workers at {scheduler}", flush=True)
        # Not pure: two tasks with equal arguments are two tasks, and a result is not taken from an earlier one.
        yield client.get_executor(retries=_RETRIES, pure=False)
    finally:
        client.close()
