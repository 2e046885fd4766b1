"""``--distributed``: this process joins others, of this machine or of many, and leaves when all are done."""

import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import jax

from jaxdn.runtime.interrupt import Stopped

LOST_EXIT_CODE = 1
"""Of a process whose others have gone: the same commands, given again, go on from the newest checkpoint."""
_HEARTBEAT_S = 60
"""After so long without a sign of life a process counts as lost."""
_TELL_S = 10.0
"""How long a process that has failed waits for the others, which may have failed by the same."""


class Place(NamedTuple):
    """Where the processes meet, as ``jax.distributed.initialize`` names it; None is found by jax: Slurm, Open MPI,
    Kubernetes."""

    coordinator: str | None = None
    processes: int | None = None
    process: int | None = None


@contextmanager
def join_processes(place: Place) -> Iterator[None]:
    """Join the processes of a run, and wait for the others at the end, also where all have stopped at Ctrl-C.

    Where another process is lost, or does not come within five minutes, this one ends with a message and exit code 1,
    or is ended by jax with 134. An error of this process itself, as a damaged file or full memory, is raised, and the
    others count it as lost soon after.
    Raises ValueError for a place that is incomplete or has no port, or one that is taken, where no cluster is found,
    and where jax cannot join the processes.
    """
    given = place.coordinator, place.processes, place.process
    if any(value is not None for value in given) and None in given:
        raise ValueError(
            "--distributed: expected all of --coordinator, --processes and --process, or none where jax finds them "
            "(Slurm, Open MPI, Kubernetes), got some; give the others too."
        )
    if place.coordinator is not None:
        _check_port(place.coordinator, opens=place.process == 0)
    # Signals are agreed upon by the training loop; jax's own service would take SIGTERM away from it.
    if hasattr(jax.config, "jax_enable_preemption_service"):
        jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            *given, heartbeat_timeout_seconds=_HEARTBEAT_S, shutdown_timeout_seconds=_HEARTBEAT_S
        )
    except ValueError as error:
        raise ValueError(
            f"--distributed: jax cannot tell which processes there are ({error}). Start it under Slurm, Open MPI or "
            "Kubernetes, or give --coordinator HOST:PORT, --processes and --process."
        ) from error
    except jax.errors.JaxRuntimeError as error:
        raise ValueError(
            f"--distributed: jax cannot join the processes ({_shorten(error)}). Take a port of process 0's machine "
            "that is free and that the others can reach."
        ) from error
    try:
        yield
    except Stopped:  # all processes have; without the first, which is where they meet, jax would abort the others
        _leave()
        raise
    except jax.errors.JaxRuntimeError as error:
        if not _is_of_this_process(error):
            _end_alone(error)
        _end_soon(1)
        raise
    except Exception as error:
        if "Gloo" in str(error):  # not every failed exchange is a JaxRuntimeError
            _end_alone(error)
        _end_soon(2 if isinstance(error, (ValueError, OSError, ModuleNotFoundError)) else 1)
        raise
    _leave()


def _leave() -> None:
    """Wait until all processes leave."""
    try:
        jax.distributed.shutdown()
    except jax.errors.JaxRuntimeError as error:
        _end_alone(error)


def _check_port(address: str, *, opens: bool) -> None:
    """Raise ValueError for no HOST:PORT, and for a port that this process ``opens`` and cannot: jax may crash there."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 1 << 16):
        raise ValueError(f"--coordinator: expected HOST:PORT, such as head:5731, got {address}.")
    if not opens:
        return
    try:
        socket.create_server(("", int(port))).close()
    except OSError as error:
        raise ValueError(
            f"--coordinator: expected a free port of process 0's machine, got {address} ({error.strerror or error}); "
            "give all processes another."
        ) from error


def _is_of_this_process(error: Exception) -> bool:
    """Whether this process's memory is full, or Ctrl-C has ended one of its callbacks
    (:func:`jaxdn.runtime.interrupt.keep_interrupts`)."""
    message = str(error).rstrip()
    return "RESOURCE_EXHAUSTED" in message or message.endswith("KeyboardInterrupt:")


def _end_soon(code: int) -> None:
    """End in a moment, with the exit code that an error has (:func:`jaxdn.commands.errors.plain_errors`).

    At its end this process waits for the others, which may wait for it in an update: jax would abort all of them after
    a minute.
    """
    timer = threading.Timer(_TELL_S, _end, [code])
    timer.daemon = True
    timer.start()


def _end(code: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _shorten(error: Exception) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__


def _end_alone(error: Exception) -> None:
    """End at once: whatever else waits for the lost process would wait for minutes."""
    print(
        f"jaxdn: another process of this run has gone, or cannot be reached ({_shorten(error)}). Give the same "
        "commands again: training goes on from the newest checkpoint.",
        file=sys.stderr,
        flush=True,
    )
    _end(LOST_EXIT_CODE)
