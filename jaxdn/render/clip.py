"""Render a clip into a folder of OpenEXR frames, resumable at any point."""

import importlib.metadata
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.checks import check_at_least
from jaxdn.data.clip.folder import begin_record, begun_record, finish_record, frame_path
from jaxdn.data.clip.frames import read_frame, write_frame
from jaxdn.data.errors import ClipError
from jaxdn.planning.catalogue import NoisyLight
from jaxdn.planning.plan import Plan
from jaxdn.render.buffers.geometry import View
from jaxdn.render.frame import Rendered, check_options, path_length, render_frame, tracer
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import check_settings


def render_clip(
    scene: AnimatedScene,
    folder: str | Path,
    *,
    width: int,
    height: int,
    frames: int | None = None,
    layers: Sequence[int] = (1,),
    reference_spp: int = 0,
    max_depth: int | None = None,
    seed: int = 0,
    variant: str | None = None,
    draws: int = 0,
    light: NoisyLight = "indirect",
    jitter: bool = False,
    see_through: bool = False,
    plan: Plan | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render the frames 0 ... ``frames`` - 1 into ``folder``: one ``frame_0000.exr`` each, and then ``clip.json``.

    Existing complete frames are kept, so that an interrupted rendering is resumed; the folder must have been started
    with the same settings (ClipError otherwise). It only becomes a clip when all frames exist
    (:func:`jaxdn.data.clip.folder.begin_record`). Returns the folder. Raises RenderError, naming the clip and the
    frame, if a frame cannot be rendered or written.

    Args:
      scene: to render.
      folder: of the clip.
      width: in pixels.
      height: in pixels.
      frames: number of frames; default: that of the scene.
      layers: as in :func:`render_frame`, like the next nine.
      reference_spp: samples per pixel of the reference; 0 for none.
      max_depth: path length.
      seed: of the random numbers.
      variant: Mitsuba's.
      draws: further images of one sample each.
      light: what the radiance holds.
      jitter: another point of the pixels in every frame.
      see_through: guides of what mirrors and glass show.
      plan: for these frames; it is stored in the record.
      progress: called with the index of every frame that is finished or already exists.
    """
    folder = Path(folder)
    frames = scene.frames if frames is None else frames
    check_at_least(1, frames=frames)
    check_options(width, height, layers, reference_spp, draws, light, jitter, see_through, plan)
    if plan is not None and len(plan.frames) != frames:
        raise ValueError(f"plan: expected one for {frames} frames, got one for {len(plan.frames)}.")
    chosen = use_variant(variant)
    record: dict[str, Any] = {
        "name": scene.name,
        "frames": frames,
        "width": width,
        "height": height,
        "layers": sorted(layers),
        "reference_spp": reference_spp,
        "draws": draws,
        "light": light,
        "jitter": jitter,
        "see_through": see_through,
        "variant": chosen,
        "max_depth": path_length(scene, max_depth, plan),
        "plan": None if plan is None else plan.record(),
        "seed": seed,
        "jittered": tracer(chosen).jittered,
        "cameras": [_camera_record(scene, frame) for frame in range(frames)],
        "scene": dict(scene.record),
        "versions": _versions(),
        "bad_samples": 0,
    }
    before = begun_record(folder)
    if before is not None:
        check_settings(folder, record, before)
        record["bad_samples"] = before.get("bad_samples", 0)
    begin_record(record, folder)
    options: dict[str, Any] = {"width": width, "height": height, "layers": layers, "reference_spp": reference_spp}
    options |= {"max_depth": max_depth, "seed": seed, "variant": chosen, "draws": draws, "light": light}
    options |= {"jitter": jitter, "see_through": see_through, "plan": plan}
    previous: View | None = None
    for frame in range(frames):
        path = frame_path(folder, frame)
        if _is_whole(path):
            previous = None
        else:
            try:
                rendered = render_frame(scene, frame, previous=previous, **options)
                _write(path, rendered)
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                raise RenderError(f"clip {scene.name!r} in {folder}, frame {frame}: {reason}") from error
            previous = rendered.view
            if rendered.bad_samples:
                record["bad_samples"] += rendered.bad_samples
                begin_record(record, folder)
        if progress is not None:
            progress(frame)
    finish_record(record, folder)
    return folder


def _write(path: Path, rendered: Rendered) -> None:
    write_frame(
        path,
        rendered.frame,
        layers=rendered.layers,
        reference=rendered.reference,
        reference_half=rendered.reference_half,
        draws=rendered.draws,
    )


def _camera_record(scene: AnimatedScene, frame: int) -> dict[str, Any]:
    camera = scene.camera(frame)
    return {"to_world": np.asarray(camera.to_world, np.float64).tolist(), "x_fov": float(camera.x_fov)}


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("mitsuba", "drjit")},
    }


def _is_whole(path: Path) -> bool:
    if not path.exists():
        return False
    try:
        read_frame(path)
    except ClipError:
        return False
    return True
