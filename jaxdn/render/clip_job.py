"""One clip to render: what every way of rendering many clips hands to the process that renders it."""

import os
import signal
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from jaxdn.data.clip.folder import begun_record, frame_path, is_clip, read_record
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.scene_digest import digest_scene_file, find_edited
from jaxdn.render.settings import RenderSettings


class ClipJob(NamedTuple):
    """One clip to render."""

    scene: dict[str, Any]
    """The record of the scene, such as ``{"family": "robot", "seed": 3}``."""
    folder: str
    frames: int
    settings: RenderSettings
    """Without a variant, that is the one that the clip in the folder was started with, else the fastest that works."""


class UnplannedClip(NamedTuple):
    """One clip whose scene is built and planned where it is rendered, which may take longer than a frame."""

    folder: str
    frames: int
    plan: Callable[[], ClipJob]
    """Gives the job, with the same folder and frames; a function that can be pickled."""


def keep_variant(job: ClipJob) -> ClipJob:
    """The job with a variant: a clip is completed, and checked for completeness, with the one it was started with."""
    begun = begun_record(job.folder) if job.settings.variant is None else None
    return job if begun is None else job._replace(settings=replace(job.settings, variant=begun.get("variant")))


def is_finished(job: ClipJob) -> bool:
    """Whether the clip exists with all its frames, the wanted settings and scene files that nobody has edited since.

    This needs no separate process.
    """
    if not is_clip(job.folder):
        return False
    record = read_record(job.folder)
    if find_edited(record, digest_scene_file(job.scene)):
        return False
    wanted = {"scene": job.scene, "frames": job.frames, **job.settings.record()}
    # What a job leaves open was chosen when the clip was started.
    open_names = {name for name in ("max_depth", "variant") if wanted[name] is None}
    # A frame's file gets its name only when it is complete.
    return all(record.get(name) == value for name, value in wanted.items() if name not in open_names) and all(
        frame_path(job.folder, frame).is_file() for frame in range(job.frames)
    )


def render_job(
    job: ClipJob, *, threads: int, only: range | None = None, progress: Callable[[int], None] | None = None
) -> None:
    """Render a clip, or of its frames ``only`` some, in this process with ``threads`` threads (0: one a core).

    ``progress`` is called with the index of each frame that is there. Raises ValueError for a scene that does not load
    and a variant that does not run here, and as :func:`jaxdn.render.clip.render_clip` does.
    """
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    warnings.filterwarnings("ignore", message="scene ")  # whoever opened the scene has been warned
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
    render_clip(scene, job.folder, job.settings, frames=job.frames, only=only, progress=progress)


def describe_death(folder: str, frame: int, code: int | None) -> str:
    """Why a clip failed whose process ended with an exit code, or by a signal (a negative one), and said nothing."""
    cause = f"exit code {code}"
    if code is not None and code < 0:
        cause = signal.Signals(-code).name
        cause += {"SIGKILL": " (out of memory?)", "SIGABRT": " (an LLVM that does not work?)"}.get(cause, "")
    return f"clip in {folder}, frame {frame}: the renderer's process died: {cause}. Start again to resume."
