"""Render one frame: noisy layers, a reference, G-buffers and motion vectors."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.ops.motion import dual_motion
from jaxdn.render.buffers.frame_pair import BuiltFrame, FramePair
from jaxdn.render.buffers.geometry import View, compute_far_motion, compute_motion, compute_ray_length
from jaxdn.render.buffers.glossy_vectors import compute_glossy_motion
from jaxdn.render.buffers.gradient_samples import compute_luminance_gradient
from jaxdn.render.buffers.reflectance import Reflectances
from jaxdn.render.buffers.shadow_vectors import compute_shadow_motion
from jaxdn.render.frame_blur import trace_blurred_samples
from jaxdn.render.frame_request import (
    DISOCCLUSION,
    GRADIENT,
    MOTION,
    VECTORS,
    FrameGeometry,
    FrameRequest,
    build_geometry,
    request_frame,
)
from jaxdn.render.frame_samples import FrameSamples, trace_samples
from jaxdn.render.scenes.optics import get_shutter
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.radiance import RadianceSums, TraceRequest
from jaxdn.render.tracing.seeds import NOISY, SampleStream
from jaxdn.render.tracing.tracer import Tracer, choose_tracer
from jaxdn.render.tracing.volume_path_tracer import scatters

_SURFACE = ("albedo", "normal", "depth", "roughness", "reflectance", "specular_reflectance", "ids")


class RenderedFrame(NamedTuple):
    """Everything that a clip stores of one frame, as NumPy arrays."""

    frame: Frame
    """``radiance`` is the noisy layer with the fewest samples."""
    layers: dict[int, np.ndarray]
    """Samples per pixel -> [H, W, 3] independent noisy radiance."""
    reference: np.ndarray | None
    """[H, W, 3] the same converged, of samples that no noisy layer contains."""
    reference_half: np.ndarray | None
    """[H, W, 3] the same from the first half of its samples."""
    draws: np.ndarray | None
    """[n, H, W, 6] independent single samples of indirect and direct light."""
    layer_guides: dict[int, dict[str, np.ndarray]]
    """Samples per pixel -> the guides of that layer that are means over its samples; empty but for filtered pixels.
    Those of the layer with the fewest are in ``frame``."""
    reference_guides: dict[str, np.ndarray]
    """The same of the reference; empty without one, too."""
    view: View | None
    """Input of the next frame's motion vectors; None if the plan needs no G-buffer."""
    bad_samples: int
    """Samples that were not finite and count as black."""


def render_frame(
    scene: AnimatedScene, frame: int, settings: RenderSettings, *, previous: View | None = None
) -> RenderedFrame:
    """Render one frame of an animated scene: noisy layers, a reference, G-buffers and motion vectors.

    ``direct`` and ``emission`` are means over the reference's samples, or over the noisy ones if ``reference_spp`` is
    0; with filtered pixels each image has its own (``layer_guides``). The result depends only on the arguments: the
    same frame rendered again, alone or in another process, is the same bit for bit. Raises ValueError for scenes with
    unsupported effects, and, with the scalar variant, for jitter, for seeing through, and for a plan with buffers of
    samples (:data:`jaxdn.core.frame.OF_SAMPLES`), which it cannot render.

    Args:
      scene: to render.
      frame: index of the frame.
      settings: how.
      previous: the ``view`` of the frame before, computed if it is not given; frame 0 has none, and its motion is 0.
    """
    settings = settings.complete(scene)
    tracer = choose_tracer(settings.variant or "")
    request = request_frame(settings, frame)
    geometry = build_geometry(scene, frame, settings, request, previous)
    samples = _trace_frame(tracer, scene, geometry.scene, frame, settings, request)
    buffers = _average_light(samples, settings)
    buffers |= _describe_samples(samples.noisy[settings.layers[0]], settings.layers[0])
    buffers |= _describe_surfaces(geometry, request)
    buffers |= _follow_samples(tracer, geometry, frame, settings, request)
    guides = {count: _average_guides(sums, count, request) for count, sums in samples.noisy.items()}
    buffers |= guides.pop(settings.layers[0])
    rendered = _assemble(buffers, samples, geometry.view, settings, request)
    clean = _average_guides(samples.best(), settings.reference_spp, request) if samples.halves else {}
    return rendered._replace(layer_guides=guides if request.averaged else {}, reference_guides=clean)


def _trace_frame(
    tracer: Tracer, scene: AnimatedScene, built: Any, frame: int, settings: RenderSettings, request: FrameRequest
) -> FrameSamples:
    """Trace all samples of a frame: in its own ``mi.Scene``, or at several times while the shutter is open."""

    def describe(of: Any) -> TraceRequest:
        asked = {"reflectance", "specular_reflectance"} & set(request.averaged)
        return request.describe_samples(Reflectances(of) if asked else None)

    blurred = get_shutter(scene) > 0
    if request.sampled and (blurred or scatters(built)):
        names = ", ".join(sorted(request.sampled))
        raise ValueError(f"plan: expected none of {names} with motion blur or fog; plan without them.")
    if not blurred:
        return trace_samples(tracer, built, frame, settings, request, describe(built))
    if settings.pixel_filter == "centre":
        raise ValueError(
            "scene: motion blur needs filtered pixels, as its first hits are random; expected pixel_filter "
            "'blackman-harris', 'gaussian' or 'box' (`jaxdn render --pixel-filter`), got 'centre'."
        )
    return trace_blurred_samples(tracer, scene, frame, settings, request, describe)


def _average_light(samples: FrameSamples, settings: RenderSettings) -> dict[str, np.ndarray]:
    """The light that has no noise."""
    sums, count = samples.best(), settings.reference_spp if samples.halves else sum(settings.layers)
    return {"direct": _to_single(sums.direct / count), "emission": _to_single(sums.emitted / count)}


def _average_guides(sums: RadianceSums, count: int, request: FrameRequest) -> dict[str, np.ndarray]:
    """The guides of one image of ``count`` samples that are means over these."""
    found: dict[str, Any] = {"direct": sums.direct, "emission": sums.emitted}
    if sums.surfaces is not None:
        found |= sums.surfaces._asdict()
    return {name: _to_single(found[name] / count) for name in request.averaged}


def _describe_samples(noisy: RadianceSums, count: int) -> dict[str, np.ndarray]:
    """The buffers of how the light of one noisy image arrived, of ``count`` samples."""
    buffers: dict[str, np.ndarray] = {}
    if noisy.lobes is not None:
        diffuse, specular = (_to_single(distance) for distance in noisy.lobes.hit_distances())
        light = _to_single(noisy.lobes.specular / count)
        buffers |= {"specular": light, "hit_distance": diffuse, "specular_hit_distance": specular}
    if noisy.shadows is not None:
        buffers |= {name: _to_single(part / count) for name, part in noisy.shadows._asdict().items()}
    return buffers


def _describe_surfaces(geometry: FrameGeometry, request: FrameRequest) -> dict[str, Any]:
    """The buffers of the surfaces and of their motion."""
    view = geometry.view
    if view is None:
        return {}
    buffers = {name: getattr(view.gbuffer, name) for name in _SURFACE}
    if "ray_length" in request.buffers:
        buffers["ray_length"] = compute_ray_length(view)
    if request.buffers & MOTION:
        buffers |= _describe_motion(view, geometry.previous, request.buffers)
    return buffers


def _describe_motion(view: View, previous: View | None, wanted: frozenset[str]) -> dict[str, Any]:
    """The motion buffers of a Frame; in the first frame nothing has moved yet."""
    if previous is None:
        zero = np.zeros((*view.gbuffer.ids.shape[:2], 2), np.float32)
        visible = np.ones_like(view.gbuffer.ids, bool)
        still = dict.fromkeys(("motion", "dual_motion", "far_motion"), zero)
        return {**still, "visible": visible, "previous_depth": view.gbuffer.depth}
    between = compute_motion(view, previous, disocclusion=bool(wanted & DISOCCLUSION))
    motion = between.motion.astype(np.float32)
    buffers = {"motion": motion, "previous_depth": between.previous_depth}
    if "far_motion" in wanted:
        buffers["far_motion"] = compute_far_motion(view, previous).astype(np.float32)
    if between.forward_motion is not None and between.visible is not None:
        forward = jnp.asarray(between.forward_motion.astype(np.float32))
        dual = dual_motion(jnp.asarray(motion), forward, visible=jnp.asarray(between.visible[..., 0]))
        buffers |= {"visible": between.visible, "dual_motion": np.asarray(dual)}
    return buffers


def _follow_samples(
    tracer: Tracer, geometry: FrameGeometry, frame: int, settings: RenderSettings, request: FrameRequest
) -> dict[str, np.ndarray]:
    """The buffers of how samples of the noisy image change from one frame to the next: 0 without a frame before."""
    followed = request.sampled & VECTORS | request.buffers & {GRADIENT}
    if geometry.view is None or not followed:
        return {}
    if frame == 0 or request.shared or geometry.previous is None:
        return dict.fromkeys(followed, np.zeros((settings.height, settings.width, 2), np.float32))
    before = BuiltFrame(geometry.previous_scene, geometry.previous)
    numbers = SampleStream(settings.seed, frame, NOISY)
    frames = FramePair(before, BuiltFrame(geometry.scene, geometry.view), numbers, settings.layers[0] - 1)
    buffers: dict[str, np.ndarray] = {}
    if GRADIENT in followed:
        assert settings.max_depth is not None
        buffers[GRADIENT] = (
            compute_luminance_gradient(
                tracer.replay, frames, max_depth=settings.max_depth, with_direct=settings.light == "reflected"
            )
            if request.noisy
            else np.zeros((settings.height, settings.width, 2), np.float32)
        )
    if followed & VECTORS:
        motion = compute_motion(geometry.view, geometry.previous, disocclusion=False).motion
        compute = {"shadow_motion": compute_shadow_motion, "glossy_motion": compute_glossy_motion}
        buffers |= {name: compute[name](frames, motion) for name in compute if name in followed}
    return buffers


def _assemble(
    buffers: dict[str, Any],
    samples: FrameSamples,
    view: View | None,
    settings: RenderSettings,
    request: FrameRequest,
) -> RenderedFrame:
    """Everything that is stored, of the buffers that the request asks for."""

    def noise(sums: RadianceSums) -> np.ndarray:
        return sums.indirect if settings.light == "indirect" else sums.indirect + sums.direct

    layers = {count: _to_single(noise(sums) / count) for count, sums in samples.noisy.items()}
    reference = half = draws = None
    if samples.halves:
        reference = _to_single(noise(samples.best()) / settings.reference_spp)
        half = _to_single(noise(samples.halves[0]) / ((settings.reference_spp + 1) // 2))
    if samples.singles:
        draws = np.stack([_to_single(np.concatenate([one.indirect, one.direct], -1)) for one in samples.singles])
    wanted = {name: buffer for name, buffer in buffers.items() if name in request.buffers | request.sampled}
    frame = Frame(radiance=layers[settings.layers[0]], **wanted)
    return RenderedFrame(frame, layers, reference, half, draws, {}, {}, view, samples.bad())


def _to_single(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float32)
