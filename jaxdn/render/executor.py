"""Render clips by an executor of PEP 3148 (``concurrent.futures``): threads of this machine, or a cluster.

The disk is the only thing that the machines share. A clip that two of them render at once, as where one was given up
for lost too early, comes out right: both write the same files.
"""

import os
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future
from concurrent.futures import wait as wait_for
from dataclasses import replace

from jaxdn.data.clip.folder import count_frames, is_clip
from jaxdn.render.clip import finish_clip
from jaxdn.render.clip_job import ClipJob, UnplannedClip, is_finished, keep_variant
from jaxdn.render.frame_counter import open_counter
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.mitsuba.variant import pin_variant
from jaxdn.render.separate_process import ClipTask, render_apart

_COUNT_EVERY_S = 2.0
_SEEN_WITHIN_S = 70.0
"""How long another machine's files may stay unseen here: NFS keeps what it knows of a folder for up to a minute."""

_Clip = ClipJob | UnplannedClip


def render_by_executor(
    executor: Executor,
    clips: Sequence[_Clip],
    *,
    threads: int,
    frames_per_task: int | None,
    progress: bool | Callable[[int, int], None],
) -> list[str]:
    """Render clips, a task each or one for so many frames, and return the reasons of those that failed.

    Finished clips are left out. The arguments are those of :func:`jaxdn.render.worker_pool.render_clips`. When it is
    left early, as by Ctrl-C, tasks that have not begun are cancelled; those that have go on to the end of their frames.
    """
    total = sum(clip.frames for clip in clips)
    waiting = [clip for clip in map(_keep_variant, clips) if not (isinstance(clip, ClipJob) and is_finished(clip))]
    variant = pin_variant() if any(map(_is_open, waiting)) else None
    tasks: dict[Future[None], _Clip] = {}
    failures: dict[str, str] = {}
    pending: set[Future[None]] = set()
    with open_counter(progress, total) as show:
        try:
            for clip in waiting:
                for only in _split(clip.frames, frames_per_task):
                    task = ClipTask(_pin(clip, variant), only, threads, variant, os.getcwd())
                    tasks[executor.submit(render_apart, task)] = clip
            pending = set(tasks)
            counted = -_COUNT_EVERY_S
            while pending:
                if time.monotonic() - counted >= _COUNT_EVERY_S:
                    counted = time.monotonic()
                    show(_count(clips, {tasks[future].folder for future in pending}), total)
                ended, pending = wait_for(pending, timeout=_COUNT_EVERY_S, return_when=FIRST_COMPLETED)
                for future in ended:
                    if reason := _tell_failure(future, tasks[future]):
                        failures.setdefault(tasks[future].folder, reason)
        finally:
            for future in pending or tasks:
                future.cancel()
        _finish([clip for clip in waiting if clip.folder not in failures], failures)
        show(_count(clips, {clip.folder for clip in waiting}), total)
    return list(failures.values())


def _keep_variant(clip: _Clip) -> _Clip:
    return keep_variant(clip) if isinstance(clip, ClipJob) else clip


def _is_open(clip: _Clip) -> bool:
    """Whether a clip is to be rendered with whatever variant is the fastest."""
    return isinstance(clip, UnplannedClip) or clip.settings.variant is None


def _pin(clip: _Clip, variant: str | None) -> _Clip:
    """The clip with a variant: machines that have different ones must not choose theirs."""
    if isinstance(clip, UnplannedClip) or clip.settings.variant is not None:
        return clip
    return clip._replace(settings=replace(clip.settings, variant=variant))


def _split(frames: int, frames_per_task: int | None) -> Iterable[range | None]:
    if frames_per_task is None or frames_per_task >= frames:
        return [None]
    return [range(first, min(first + frames_per_task, frames)) for first in range(0, frames, frames_per_task)]


def _count(clips: Sequence[_Clip], in_work: set[str]) -> int:
    """Frames that are there: all of the clips that have ended, those on the disk of the others."""
    return sum(count_frames(clip.folder, clip.frames) if clip.folder in in_work else clip.frames for clip in clips)


def _tell_failure(future: Future[None], clip: _Clip) -> str:
    """Why a task failed; "" if it did not."""
    if future.cancelled():
        return f"clip in {clip.folder}: the executor has given it up; start again to resume."
    error = future.exception()
    if error is None:
        return ""
    return str(error) if isinstance(error, RenderError) else f"clip in {clip.folder}: {error!r}"


def _finish(clips: Iterable[_Clip], failures: dict[str, str]) -> None:
    """Make the folders clips whose tasks have all ended, where none of those saw all frames; add those that fail."""
    deadline = time.monotonic() + _SEEN_WITHIN_S  # one for all: every frame was written before
    for clip in clips:
        while not finish_clip(clip.folder) and time.monotonic() < deadline:
            time.sleep(0.5)
        if not is_clip(clip.folder):
            failures[clip.folder] = (
                f"clip in {clip.folder}: its frames were rendered, but {count_frames(clip.folder, clip.frames)} of "
                f"{clip.frames} are seen from here; the machines must share this disk, under the same path."
            )
