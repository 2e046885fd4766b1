"""The scenes and the surfaces that one frame is rendered from: its own, and those of the frame before."""

from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.buffers.gbuffer import check_scene, trace_gbuffer
from jaxdn.render.buffers.geometry import View
from jaxdn.render.frame_request import FrameRequest
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing import jitter as jitters
from jaxdn.render.tracing.seeds import NOISY, SampleStream
from jaxdn.render.tracing.volume_path_tracer import scatters


class FrameGeometry(NamedTuple):
    """What a frame and the one before it consist of, as far as it is needed."""

    scene: Any
    """The ``mi.Scene`` of the frame."""
    view: View | None
    """Its surfaces."""
    previous_scene: Any | None
    previous: View | None


def build_geometry(
    scene: AnimatedScene, frame: int, settings: RenderSettings, request: FrameRequest, previous: View | None
) -> FrameGeometry:
    """Build a frame's scene and trace its surfaces, and those of the frame before if they are needed and not given.

    Raises ValueError for scenes with unsupported effects.
    """
    before = None
    if frame > 0 and (request.needs_previous_scene or (request.needs_previous_view and previous is None)):
        before = _build(scene, frame - 1, settings)
        previous = previous or _trace_view(scene, frame - 1, before, frozenset(), settings)
    built = _build(scene, frame, settings)
    check_scene(built, filtered=settings.pixel_filter != "centre")
    if request.shared:
        return FrameGeometry(built, previous, before, previous)
    view = _trace_view(scene, frame, built, request.buffers, settings) if request.needs_view else None
    return FrameGeometry(built, view, before, previous)


def _build(scene: AnimatedScene, frame: int, settings: RenderSettings) -> Any:
    built = scene.build(frame, settings.width, settings.height)
    return jitters.shift_principal_point(built, jitters.get_frame_offset(frame)) if settings.jitter else built


def _trace_view(
    scene: AnimatedScene, frame: int, built: Any, buffers: frozenset[str], settings: RenderSettings
) -> View:
    """Trace the surfaces of a frame, with those of ``buffers`` that take more than a ray."""
    camera = scene.camera(frame)
    gbuffer = trace_gbuffer(
        built,
        reflectance="reflectance" in buffers,
        specular="specular_reflectance" in buffers,
        see_through=settings.see_through,
        first=SampleStream(settings.seed, frame, NOISY) if camera.aperture_radius > 0 or scatters(built) else None,
    )
    pose = {name: np.asarray(matrix, np.float64) for name, matrix in scene.pose(frame).items()}
    return View(gbuffer, camera, pose)
