"""What one frame of a clip needs, decided before anything is traced, and the scenes and surfaces that it is made from.

These are its own, and those of the frame before.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import AVERAGED, GUIDES, OF_SAMPLES, ON_REQUEST
from jaxdn.planning.catalogue import OF_PRIMARY_SURFACES, OF_SHADOWS, THROUGH_CENTRES
from jaxdn.render.buffers.gbuffer import check_scene, trace_gbuffer
from jaxdn.render.buffers.geometry import View
from jaxdn.render.mitsuba.variant import advice, separates_lobes
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing import jitter as jitters
from jaxdn.render.tracing.pixel_filters import PixelFilter
from jaxdn.render.tracing.radiance import NOTHING_ELSE, TraceRequest
from jaxdn.render.tracing.seeds import NOISY, SampleStream
from jaxdn.render.tracing.surfaces import AveragesReflectance, SurfaceRequest
from jaxdn.render.tracing.volume_path_tracer import scatters

DISOCCLUSION = frozenset({"dual_motion", "visible"})
MOTION = frozenset({"motion", "previous_depth", "far_motion"}) | DISOCCLUSION
LOBES = frozenset({"specular", "hit_distance", "specular_hit_distance"})
VECTORS = frozenset({"shadow_motion", "glossy_motion"})
"""Motion of what the samples of one noisy image have met."""
GRADIENT = "luminance_gradient"


class FrameRequest(NamedTuple):
    """The buffers and the light of one frame."""

    buffers: frozenset[str]
    """Buffers that do not belong to one noisy image; none in a frame that shares those of an earlier one."""
    sampled: frozenset[str]
    """Buffers of the noisy layer with the fewest samples (:data:`jaxdn.core.frame.OF_SAMPLES`)."""
    shared: bool
    """It shows the same as an earlier frame, whose buffers and reference it shares: only its noise is its own."""
    lit: bool
    """The scene has light."""
    noisy: bool
    """The noisy layers may hold light."""
    reflected: bool
    """They hold all light that surfaces reflect."""
    pixel_filter: PixelFilter
    """Where samples lie."""

    @property
    def averaged(self) -> tuple[str, ...]:
        """The buffers that are means over the samples of each noisy image and of the reference."""
        return () if self.pixel_filter == "centre" else tuple(name for name in AVERAGED if name in self.buffers)

    @property
    def needs_view(self) -> bool:
        """Whether there is a buffer of surfaces."""
        return bool(self.buffers | self.sampled & VECTORS)

    @property
    def needs_previous_scene(self) -> bool:
        """Whether rays are traced in the frame before, too."""
        return not self.shared and (bool(self.sampled & VECTORS) or GRADIENT in self.buffers)

    @property
    def needs_previous_view(self) -> bool:
        """Whether the surfaces of the frame before are needed."""
        return self.needs_previous_scene or bool(self.buffers & MOTION)

    def describe_samples(self, reflectances: AveragesReflectance | None) -> TraceRequest:
        """What is asked of all samples; ``reflectances`` of the scene, where they are asked for."""
        if self.pixel_filter == "centre":
            return NOTHING_ELSE
        return TraceRequest(pixel_filter=self.pixel_filter, surfaces=SurfaceRequest(reflectances))

    def describe_own_samples(self, others: TraceRequest) -> TraceRequest:
        """What is asked of the samples of the noisy layer with the fewest, besides what is asked of the others."""
        if not self.sampled:
            return others
        lobes, shadows = bool(self.sampled & LOBES), bool(self.sampled & OF_SHADOWS)
        return others._replace(lobes=lobes, shadows=shadows, direct=self.reflected)


def request_frame(settings: RenderSettings, frame: int) -> FrameRequest:
    """Decide what a frame needs.

    Raises ValueError for settings that their variant, which is not None, cannot render.
    """
    plan = settings.plan
    planned = frozenset(GUIDES) - ON_REQUEST if plan is None else frozenset(plan.frames[frame])
    if settings.see_through:
        planned -= OF_PRIMARY_SURFACES
    if settings.light == "reflected":
        planned -= {"direct"}
    if settings.pixel_filter != "centre":
        planned -= THROUGH_CENTRES
    shared = plan is not None and plan.shared_with[frame] != frame
    request = FrameRequest(
        buffers=frozenset() if shared else planned - OF_SAMPLES,
        sampled=planned & OF_SAMPLES,
        shared=shared,
        lit=plan is None or plan.integrator != "none",
        noisy=plan is None or (plan.indirect and plan.integrator != "none"),
        reflected=settings.light == "reflected",
        pixel_filter=settings.pixel_filter,
    )
    _check_variant(settings, request)
    return request


def _check_variant(settings: RenderSettings, request: FrameRequest) -> None:
    variant = settings.variant or ""
    if separates_lobes(variant):
        return
    if settings.jitter:
        raise ValueError(f"jitter: {variant} spreads its samples over the pixels itself; leave it out. {advice()}")
    if settings.see_through:
        raise ValueError(f"see_through: {variant} cannot follow rays past mirrors and glass; leave it out. {advice()}")
    if request.sampled:
        names = ", ".join(sorted(request.sampled))
        raise ValueError(f"plan: {variant} cannot render {names}; plan without them. {advice()}")


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
