"""Render a clip into a folder of OpenEXR frames, resumable at any point."""

import importlib.metadata
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.checks import check_at_least
from jaxdn.data.clip.folder import begin_record, begun_record, finish_record, frame_path, is_clip
from jaxdn.data.clip.frames import read_frame, write_frame
from jaxdn.data.errors import ClipError
from jaxdn.render.buffers.geometry import View
from jaxdn.render.frame import RenderedFrame, render_frame
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.resume import check_resumable
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.tracer import choose_tracer


def render_clip(
    scene: AnimatedScene,
    folder: str | Path,
    settings: RenderSettings,
    *,
    frames: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render the frames 0 ... ``frames`` - 1 into ``folder``: one ``frame_0000.exr`` each, and then ``clip.json``.

    Existing complete frames are kept, so that an interrupted rendering is resumed; the folder must have been started
    with the same settings (ClipError otherwise). It only becomes a clip when all frames exist
    (:func:`jaxdn.data.clip.folder.begin_record`); a clip that has them all is left as it is. Returns the folder. Raises
    RenderError, naming the clip and the frame, if a frame cannot be rendered or written.

    Args:
      scene: to render.
      folder: of the clip.
      settings: how; they are stored in the record.
      frames: number of frames; default: that of the scene.
      progress: called with the index of every frame that is finished or already exists.
    """
    folder = Path(folder)
    frames = scene.frames if frames is None else frames
    check_at_least(1, frames=frames)
    if settings.plan is not None and len(settings.plan.frames) != frames:
        raise ValueError(f"plan: expected one for {frames} frames, got one for {len(settings.plan.frames)}.")
    settings = settings.complete(scene)
    record = _make_record(scene, frames, settings)
    before = begun_record(folder)
    if before is not None:
        check_resumable(folder, record, before)
        record["bad_samples"] = before.get("bad_samples", 0)
    progress = progress or (lambda frame: None)
    # To begin a record removes clip.json: a second renderer of a finished clip that is killed must not have done so.
    if before is not None and _has_frames(folder, before, frames):
        for frame in range(frames):
            progress(frame)
        return folder
    begin_record(record, folder)
    _render_missing(scene, folder, settings, record, progress)
    finish_record(record, folder)
    return folder


def _has_frames(folder: Path, begun: Mapping[str, Any], frames: int) -> bool:
    """Whether a folder is a finished clip of so many frames, all of which are complete."""
    complete = (_is_complete(frame_path(folder, frame)) for frame in range(frames))
    return is_clip(folder) and begun["frames"] == frames and all(complete)


def _render_missing(
    scene: AnimatedScene,
    folder: Path,
    settings: RenderSettings,
    record: dict[str, Any],
    progress: Callable[[int], None],
) -> None:
    """Render the frames that a folder lacks; samples that were not finite are counted in its record."""
    previous: View | None = None
    for frame in range(record["frames"]):
        path = frame_path(folder, frame)
        if _is_complete(path):
            previous = None
        else:
            try:
                rendered = render_frame(scene, frame, settings, previous=previous)
                _write(path, rendered)
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                raise RenderError(f"clip {scene.name!r} in {folder}, frame {frame}: {reason}") from error
            previous = rendered.view
            if rendered.bad_samples:
                record["bad_samples"] += rendered.bad_samples
                begin_record(record, folder)
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
        **{name: importlib.metadata.version(name) for name in ("mitsuba", "drjit")},
    }


def _is_complete(path: Path) -> bool:
    if not path.exists():
        return False
    try:
        read_frame(path)
    except ClipError:
        return False
    return True
