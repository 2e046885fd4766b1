"""Render many clips in parallel, one process a clip: on this machine, or by an executor on others.

Several processes with few threads are about a third faster than one process with many, and a process that dies affects
only one clip. A frame's file gets its name when it is complete, so an interrupted rendering can always be resumed.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

from jaxdn.core.checks import check_at_least
from jaxdn.render.clip_job import ClipJob, UnplannedClip, describe_death, is_finished, keep_variant, render_job
from jaxdn.render.executor import render_by_executor
from jaxdn.render.frame_counter import open_counter
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.mitsuba.variant import LEAST_THREADS, choose_variant
from jaxdn.runtime.cores import count_cores
from jaxdn.runtime.parent import end_with_parent


class _Worker(NamedTuple):
    job: ClipJob
    process: BaseProcess
    messages: Connection
    finished: list[int]
    """Frames that it has reported."""


def render_clips(
    jobs: Iterable[ClipJob | UnplannedClip],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    threads: int | None = None,
    frames_per_task: int | None = None,
    progress: bool | Callable[[int, int], None] = True,
) -> list[Path]:
    """Render clips in ``workers`` processes (default: one for every core) and return their folders.

    Ctrl-C stops the processes and keeps every finished frame; another call resumes. A failed clip does not stop the
    others: at the end RenderError names each failed clip, its frame and the reason.

    Args:
      jobs: the clips, each with a folder of its own.
      workers: number of processes on this machine.
      executor: renders elsewhere instead: any executor of PEP 3148, such as that of a Dask cluster. The machines share
        the disk with the clips and the scenes, under the same paths. Each of its tasks renders a clip in a process of
        its own, with the Mitsuba variant that is chosen here. Ctrl-C cancels the tasks that have not begun.
      threads: renderer threads of each process, at least 2; default: 2, and for one process on this machine all cores.
      frames_per_task: with an executor, a clip is rendered in ranges of so many frames, a task each, bit-equal to one
        task for all; default: all its frames.
      progress: shows the frames done, the total and the time left, or is called with the first two. With an executor
        frames are counted on the disk.
    """
    waiting = list(jobs)
    folders = [job.folder for job in waiting]
    if len({os.path.abspath(folder) for folder in folders}) != len(folders):
        raise ValueError("render_clips: expected a different folder for every clip.")
    check_at_least(LEAST_THREADS, threads=LEAST_THREADS if threads is None else threads)
    check_at_least(1, workers=1 if workers is None else workers)
    if executor is None and frames_per_task is not None:
        raise ValueError("frames_per_task: expected none without an executor; leave it out, or pass an executor.")
    if executor is not None and workers is not None:
        raise ValueError("workers: expected none with an executor, which has its own; leave it out.")
    if executor is not None:
        check_at_least(1, frames_per_task=1 if frames_per_task is None else frames_per_task)
        failures = render_by_executor(
            executor, waiting, threads=threads or LEAST_THREADS, frames_per_task=frames_per_task, progress=progress
        )
    else:
        planned = [job.plan() if isinstance(job, UnplannedClip) else job for job in waiting]
        failures = _render_here(planned, workers, threads, progress)
    if failures:
        raise RenderError(f"{len(failures)} of {len(folders)} clips failed:\n" + "\n".join(failures))
    return [Path(folder) for folder in folders]


def _render_here(
    jobs: Sequence[ClipJob], workers: int | None, threads: int | None, progress: bool | Callable[[int, int], None]
) -> list[str]:
    """Render in processes of this machine; returns the reasons of the clips that failed."""
    total = sum(job.frames for job in jobs)
    waiting = [job for job in map(keep_variant, jobs) if not is_finished(job)]
    limit = max(1, min(workers or count_cores(), len(waiting)))
    threads = threads or (LEAST_THREADS if limit > 1 else 0)
    for job in waiting:
        try:
            choose_variant(job.settings.variant)  # probed once, here: the processes inherit the result
        except ValueError as error:
            raise ValueError(f"clip in {job.folder}: {error}") from error

    done = total - sum(job.frames for job in waiting)
    running: list[_Worker] = []
    failures: list[str] = []
    with open_counter(progress, total) as show:
        show(done, total)
        try:
            while waiting or running:
                while waiting and len(running) < limit:
                    running.append(_start_worker(waiting.pop(0), threads=threads))
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
    return failures


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
    try:
        render_job(job, threads=threads, progress=messages.send)
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
            frame = worker.finished[-1] + 1 if worker.finished else 0
            return frames, describe_death(worker.job.folder, frame, worker.process.exitcode), True
        if isinstance(message, int):
            worker.finished.append(message)
            frames += 1
        else:
            return frames, "" if message == "done" else message, True
