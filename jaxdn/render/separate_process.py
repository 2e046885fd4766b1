"""Render one clip in a process of its own and wait for it: what a task of an executor does.

A crash of the renderer then ends neither the executor's worker nor its other tasks, the renderer cannot keep Python's
lock from a worker that has to answer, and its memory goes back. It is a new Python and not a child of
``multiprocessing``, which the workers of some executors may not have. It ends with the worker: the pipe that it has
read its task from closes then, however the worker ends.
"""

import contextlib
import os
import pickle
import platform
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import NamedTuple

from jaxdn.data.clip.folder import frame_path
from jaxdn.render.clip_job import ClipJob, UnplannedClip, describe_death, is_finished, keep_variant, render_job
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.mitsuba.variant import OVERRIDE, choose_variant

_PACKAGES = Path(__file__).parents[2]
"""The folder that jaxdn is imported from."""

_DONE = "done"


class ClipTask(NamedTuple):
    """What one process renders. It can be pickled."""

    clip: ClipJob | UnplannedClip
    only: range | None
    """The frames to render; None: all."""
    threads: int
    variant: str | None
    """Mitsuba's, for a clip that none was chosen for; None: the fastest that works there."""
    directory: str
    """Where relative paths begin."""


def render_apart(task: ClipTask) -> None:
    """Render a task in a process of its own, and return when it has ended.

    Raises RenderError, which names the machine: where the process says why it failed or dies, where the variant does
    not run, and where the directory of relative paths is missing.
    """
    where = f"clip in {task.clip.folder}, on {platform.node() or 'an unnamed machine'}"
    if not os.path.isdir(task.directory):
        raise RenderError(
            f"{where}: there is no folder {task.directory}, where the command was given; the machines of a farm must "
            "see the same files under the same paths."
        )
    try:
        choose_variant(task.variant)  # probed once for all tasks of this worker
    except ValueError as error:
        raise RenderError(f"{where}: {error}") from error
    failure, code = _run(task)
    if failure is None:
        frames = range(task.clip.frames) if task.only is None else task.only
        missing = (frame for frame in frames if not frame_path(_locate(task), frame).is_file())
        raise RenderError(f"{where}: {describe_death(task.clip.folder, next(missing, frames.stop), code)}")
    if failure != _DONE:
        raise RenderError(f"{where}: {failure}")


def _locate(task: ClipTask) -> Path:
    return Path(task.directory, task.clip.folder)


def _run(task: ClipTask) -> tuple[str | None, int]:
    """The message of the process (None if it died without one) and its exit code."""
    environment = dict(os.environ) | ({} if task.variant is None else {OVERRIDE: task.variant})
    paths = [str(_PACKAGES), *filter(None, [environment.get("PYTHONPATH")])]
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name],
        env=environment | {"PYTHONPATH": os.pathsep.join(paths)},
        cwd=task.directory,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        with contextlib.suppress(BrokenPipeError):  # it has died already
            process.stdin.write(pickle.dumps(task))
            process.stdin.flush()
        message = process.stdout.read()
    finally:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()  # it ends now if it has not
        process.stdout.close()
        code = process.wait()
    return message.decode() if message else None, code


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever submitted the task handles Ctrl-C
    # What Mitsuba prints must not get among the messages.
    messages = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with os.fdopen(os.dup(sys.stdin.fileno()), "rb") as pipe:
        task = pickle.load(pipe)
    threading.Thread(target=_end_with_pipe, daemon=True).start()
    messages.write(_render(task).encode())
    messages.close()


def _end_with_pipe() -> None:
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)  # not sys.exit: this is not the main thread, which may be in compiled code


def _render(task: ClipTask) -> str:
    """The message of the process: that it is done, or why it failed."""
    try:
        job = keep_variant(task.clip.plan() if isinstance(task.clip, UnplannedClip) else task.clip)
        if not is_finished(job):
            render_job(job, threads=task.threads, only=task.only)
    except BaseException as error:
        return str(error) or repr(error)
    return _DONE


if __name__ == "__main__":
    _main()
