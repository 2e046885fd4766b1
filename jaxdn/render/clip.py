"""Render a clip into a folder of OpenEXR frames, resumable at any point."""

import json
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.checks import check_at_least
from jaxdn.data.clip.folder import begin_record, begun_record, count_frames, finish_record, frame_path, is_clip
from jaxdn.data.clip.frames import read_frame, write_frame
from jaxdn.data.clip.record import FORMAT
from jaxdn.data.errors import ClipError
from jaxdn.render.bad_samples import count_noted, note_bad_samples, remove_notes
from jaxdn.render.buffers.geometry import View
from jaxdn.render.frame import RenderedFrame, render_frame
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.resume import check_resumable
from jaxdn.render.scene_digest import digest_scene_file
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.tracer import choose_tracer
from jaxdn.runtime.atomic_files import remove_abandoned
from jaxdn.runtime.optional import find_version


def render_clip(
    scene: AnimatedScene,
    folder: str | Path,
    settings: RenderSettings,
    *,
    frames: int | None = None,
    only: range | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render the frames 0 ... ``frames`` - 1 into ``folder``: one ``frame_0000.exr`` each, and then ``clip.json``.

    Existing complete frames are kept, so that an interrupted rendering is resumed; the folder must have been started
    with the same settings and no more frames (ClipError otherwise). It only becomes a clip when all frames exist
    (:func:`jaxdn.data.clip.folder.begin_record`); a clip that has them all is left as it is. Returns the folder. Raises
    RenderError, naming the clip and the frame, if a frame cannot be rendered or written.

    Args:
      scene: to render.
      folder: of the clip.
      settings: how; they are stored in the record.
      frames: number of frames; default: that of the scene.
      only: render only these of the frames; default: all. Whoever renders the last one makes the folder a clip: several
        processes may render ranges of one clip, which comes out bit for bit as from one.
      progress: called with the index of every frame, of ``only``, that is finished or already exists.
    """
    folder = Path(folder)
    frames = scene.frames if frames is None else frames
    check_at_least(1, frames=frames)
    if settings.plan is not None and len(settings.plan.frames) != frames:
        raise ValueError(f"plan: expected one for {frames} frames, got one for {len(settings.plan.frames)}.")
    settings = settings.complete(scene)
    record = _make_record(scene, frames, settings)
    only = range(frames) if only is None else only
    if not all(0 <= frame < frames for frame in only):
        raise ValueError(f"only: expected frames from 0 to {frames - 1}, got {only}.")
    progress = progress or (lambda frame: None)
    if _begin(folder, record):
        _render_missing(scene, folder, settings, only, progress)
        finish_clip(folder)
    else:
        for frame in only:
            progress(frame)
    return folder


def _begin(folder: Path, record: dict[str, Any]) -> bool:
    """Begin or resume a clip with its record; False if it has all its frames already.

    To begin a record removes ``clip.json``. A second renderer of a clip, which may be killed at any time, must not do
    that to a clip that the first one has finished: it begins none that has all frames, and none that is begun already.
    """
    finished = is_clip(folder)  # asked first: a clip that is finished from now on was begun with this record
    before = begun_record(folder)
    if before is not None:
        check_resumable(folder, record, before)
        record["bad_samples"] = before.get("bad_samples", 0)
        if _has_frames(folder, before, record["frames"]):
            return False
    if finished or before != json.loads(json.dumps({"format": FORMAT, **record})):
        begin_record(record, folder)
    return True


def finish_clip(folder: str | Path) -> bool:
    """Make a folder whose frames are all there a clip; False if it lacks some. A clip is left as it is.

    Its record gets the number of samples that were not finite. What killed processes left behind is removed.
    """
    folder = Path(folder)
    if is_clip(folder):
        return True
    record = begun_record(folder)
    if record is None or count_frames(folder, record["frames"]) < record["frames"]:
        return False
    record["bad_samples"] = record.get("bad_samples", 0) + count_noted(folder)
    if not is_clip(folder):  # else another process has finished it, and removes its notes
        finish_record(record, folder)
        remove_notes(folder)
        remove_abandoned(folder)
    return True


def _has_frames(folder: Path, begun: Mapping[str, Any], frames: int) -> bool:
    """Whether a folder is a finished clip of so many frames, all of which are complete."""
    complete = (_is_complete(frame_path(folder, frame)) for frame in range(frames))
    return is_clip(folder) and begun["frames"] == frames and all(complete)


def _render_missing(
    scene: AnimatedScene,
    folder: Path,
    settings: RenderSettings,
    only: range,
    progress: Callable[[int], None],
) -> None:
    """Render those of the frames ``only`` that a folder lacks, and note how many samples were not finite."""
    previous: View | None = None
    for frame in only:
        path = frame_path(folder, frame)
        if _is_complete(path):
            previous = None
        else:
            try:
                rendered = render_frame(scene, frame, settings, previous=previous)
                if rendered.bad_samples:
                    note_bad_samples(folder, frame, rendered.bad_samples)
                _write(path, rendered)
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                raise RenderError(f"clip {scene.name!r} in {folder}, frame {frame}: {reason}") from error
            previous = rendered.view
        progress(frame)


def _write(path: Path, rendered: RenderedFrame) -> None:
    write_frame(
        path,
        rendered.frame,
        layers=rendered.layers,
        reference=rendered.reference,
        reference_half=rendered.reference_half,
        draws=rendered.draws,
        layer_guides=rendered.layer_guides,
        reference_guides=rendered.reference_guides,
    )


def _make_record(scene: AnimatedScene, frames: int, settings: RenderSettings) -> dict[str, Any]:
    """The record of a clip, with complete settings."""
    return {
        "name": scene.name,
        "frames": frames,
        **settings.record(),
        "jittered": choose_tracer(settings.variant or "").jittered or settings.pixel_filter != "centre",
        "cameras": [_record_camera(scene, frame) for frame in range(frames)],
        "scene": dict(scene.record),
        **digest_scene_file(scene.record),
        "versions": _list_versions(),
        "bad_samples": 0,
    }


def _record_camera(scene: AnimatedScene, frame: int) -> dict[str, Any]:
    camera = scene.camera(frame)
    record = {"to_world": np.asarray(camera.to_world, np.float64).tolist(), "x_fov": float(camera.x_fov)}
    if camera.aperture_radius > 0:
        record |= {"aperture_radius": camera.aperture_radius, "focus_distance": camera.focus_distance}
    return record


def _list_versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{name: find_version(name) for name in ("mitsuba", "drjit")},
    }


def _is_complete(path: Path) -> bool:
    if not path.exists():
        return False
    try:
        read_frame(path)
    except ClipError:
        return False
    return True
