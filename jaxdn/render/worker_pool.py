"""Render many clips in parallel by a pool of workers, one process a clip.

Several processes with few threads are about a third faster than one process with many, and a process that dies affects
only one clip. A frame's file gets its name when it is complete, so an interrupted rendering can always be resumed.
"""

import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

from jaxdn.data.clip.folder import begun_record, frame_path, is_clip, read_record
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.settings import RenderSettings
from jaxdn.runtime.parent import end_with_parent

_THREADS = 2
"""Renderer threads of each process. With only one, Mitsuba's loader waits forever for some scenes' textures."""


class ClipJob(NamedTuple):
    """One clip to render."""

    scene: dict[str, Any]
    """The record of the scene, such as ``{"family": "robot", "seed": 3}``."""
    folder: str
    frames: int
    settings: RenderSettings
    """Without a variant, that is the one that the clip in the folder was started with, else the fastest that works."""


class _Worker(NamedTuple):
    job: ClipJob
    process: BaseProcess
    messages: Connection
    finished: list[int]
    """Frames that it has reported."""


def render_clips(
    jobs: Iterable[ClipJob],
    *,
    workers: int | None = None,
    progress: bool | Callable[[int, int], None] = True,
) -> list[Path]:
    """Render clips in ``workers`` processes (default: one for every core) and return their folders.

    ``progress`` shows the frames done, the total and the time left, or is called with the first two. Ctrl-C stops the
    processes and keeps every finished frame; another call resumes. A failed clip does not stop the others: at the end
    RenderError names each failed clip, its frame and the reason.
    """
    waiting = [_keep_variant(job) for job in jobs]
    folders = [job.folder for job in waiting]
    if len({os.path.abspath(folder) for folder in folders}) != len(folders):
        raise ValueError("render_clips: expected a different folder for every clip.")
    total = sum(job.frames for job in waiting)
    waiting = [job for job in waiting if not _is_finished(job)]
    limit = max(1, min(workers or os.cpu_count() or 1, len(waiting)))
    for job in waiting:
        try:
            choose_variant(job.settings.variant)  # probed once, here: the processes inherit the result
        except ValueError as error:
            raise ValueError(f"clip in {job.folder}: {error}") from error

    done = total - sum(job.frames for job in waiting)
    running: list[_Worker] = []
    failures: list[str] = []
    with _open_display(progress, total) as show:
        show(done, total)
        try:
            while waiting or running:
                while waiting and len(running) < limit:
                    running.append(_start_worker(waiting.pop(0), threads=_THREADS if limit > 1 else 0))
                wait([item for worker in running for item in (worker.messages, worker.process.sentinel)])
                for worker in list(running):
                    frames, failure, ended = _read_messages(worker)
                    done += frames
                    if ended:
                        worker.process.join()
                        worker.messages.close()
                        running.remove(worker)
                    if failure:
                        failures.append(failure)
                show(done, total)
        finally:
            for worker in running:
                worker.process.terminate()
            for worker in running:
                worker.process.join()
    if failures:
        raise RenderError(f"{len(failures)} of {len(folders)} clips failed:\n" + "\n".join(failures))
    return [Path(folder) for folder in folders]


def _keep_variant(job: ClipJob) -> ClipJob:
    """The job with a variant: a clip is completed, and checked for completeness, with the one it was started with."""
    begun = begun_record(job.folder) if job.settings.variant is None else None
    return job if begun is None else job._replace(settings=replace(job.settings, variant=begun.get("variant")))


def _is_finished(job: ClipJob) -> bool:
    """Whether the clip exists with all its frames and the wanted settings; this needs no separate process."""
    if not is_clip(job.folder):
        return False
    record = read_record(job.folder)
    wanted = {"scene": job.scene, "frames": job.frames, **job.settings.record()}
    # What a job leaves open was chosen when the clip was started.
    open_names = {name for name in ("max_depth", "variant") if wanted[name] is None}
    # A frame's file gets its name only when it is complete.
    return all(record.get(name) == value for name, value in wanted.items() if name not in open_names) and all(
        frame_path(job.folder, frame).is_file() for frame in range(job.frames)
    )


def _start_worker(job: ClipJob, *, threads: int) -> _Worker:
    # A forked child would inherit an inconsistent state of the renderer's and JAX's threads; a spawned one does not.
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_render_in_worker, args=(job, sender, threads), daemon=True)
    process.start()
    sender.close()
    return _Worker(job, process, receiver, [])


def _render_in_worker(job: ClipJob, messages: Connection, threads: int) -> None:
    """Runs in a separate process: render one clip and report each frame."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    end_with_parent()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    warnings.filterwarnings("ignore", message="scene ")  # whoever opened the scene has been warned
    try:
        from jaxdn.render.clip import render_clip
        from jaxdn.render.mitsuba.variant import use_variant

        use_variant(job.settings.variant)
        if threads:
            import drjit

            drjit.set_thread_count(threads)
        try:
            scene = scene_from_record(job.scene)
        except Exception as error:
            raise ValueError(f"clip in {job.folder}: the scene {job.scene} does not load: {error}") from error
        render_clip(scene, job.folder, job.settings, frames=job.frames, progress=messages.send)
        messages.send("done")
    except BaseException as error:
        messages.send(f"{error}" if str(error) else repr(error))
    finally:
        messages.close()


def _read_messages(worker: _Worker) -> tuple[int, str, bool]:
    """A worker's messages: newly finished frames, the reason of a failure ("" for none), whether it has ended."""
    frames = 0
    while True:
        try:
            if not worker.messages.poll():
                return frames, "", False
            message = worker.messages.recv()
        except (EOFError, OSError):
            # The pipe was closed without a message: the process was ended from outside.
            worker.process.join()
            return frames, _describe_death(worker), True
        if isinstance(message, int):
            worker.finished.append(message)
            frames += 1
        else:
            return frames, "" if message == "done" else message, True


def _describe_death(worker: _Worker) -> str:
    code = worker.process.exitcode
    cause = f"exit code {code}"
    if code is not None and code < 0:
        cause = signal.Signals(-code).name
        cause += {"SIGKILL": " (out of memory?)", "SIGABRT": " (an LLVM that does not work?)"}.get(cause, "")
    frame = worker.finished[-1] + 1 if worker.finished else 0
    return f"clip in {worker.job.folder}, frame {frame}: the renderer's process died: {cause}. Start again to resume."


def _open_display(
    progress: bool | Callable[[int, int], None], total: int
) -> AbstractContextManager[Callable[[int, int], None]]:
    if progress is not True:
        return nullcontext(progress if callable(progress) else lambda done, total: None)
    return _Bar(total)


class _Bar:
    """A progress bar: frames done, total, elapsed and remaining time."""

    def __init__(self, total: int) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

        columns: Sequence[Any] = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self._bar = Progress("rendering frames", *columns)
        self._bar.disable = not self._bar.console.is_terminal
        self._task = self._bar.add_task("frames", total=total)
        self._tenths = -1

    def __enter__(self) -> Callable[[int, int], None]:
        self._bar.start()
        return self._show if self._bar.console.is_terminal else self._say

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _show(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total)

    def _say(self, done: int, total: int) -> None:
        """Print a line per tenth where there is no terminal for a bar."""
        self._show(done, total)
        if 10 * done // max(total, 1) > self._tenths:
            self._tenths = 10 * done // max(total, 1)
            print(f"rendered {done} of {total} frames", flush=True)
