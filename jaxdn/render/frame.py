"""Render one frame: noisy layers, a reference, G-buffers and motion vectors."""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_at_least, check_option
from jaxdn.core.frame import GUIDES, OF_SAMPLES, ON_REQUEST, Frame
from jaxdn.ops.motion import dual_motion
from jaxdn.planning.catalogue import OF_FIRST_HITS, OF_SHADOWS, THROUGH_CENTRES, NoisyLight
from jaxdn.planning.plan import Plan
from jaxdn.render.buffers.gbuffer import check_scene, gbuffer
from jaxdn.render.buffers.geometry import View, far_motion, motion_between, ray_length
from jaxdn.render.buffers.glossy_vectors import glossy_motion
from jaxdn.render.buffers.gradient_samples import Replay, luminance_gradient
from jaxdn.render.buffers.shadow_vectors import shadow_motion
from jaxdn.render.mitsuba.variant import advice, tells_lobes, use_variant
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.tracing import jitter as jitters
from jaxdn.render.tracing.seeds import DRAWS, NOISY, REFERENCE
from jaxdn.render.tracing.wavefront import Accumulated, Request, no_light

_SURFACE = ("albedo", "normal", "depth", "roughness", "reflectance", "specular_reflectance", "ids")
_DISOCCLUSION = frozenset({"dual_motion", "visible"})
_MOTION = frozenset({"motion", "previous_depth", "far_motion"}) | _DISOCCLUSION
_GRADIENT = "luminance_gradient"
_LOBES = frozenset({"specular", "hit_distance", "specular_hit_distance"})
_VECTORS = frozenset({"shadow_motion", "glossy_motion"})


class Rendered(NamedTuple):
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
    view: View | None
    """Input of the next frame's motion vectors; None if the plan needs no G-buffer."""
    bad_samples: int
    """Samples that were not finite and count as black."""


def render_frame(
    scene: AnimatedScene,
    frame: int,
    *,
    width: int,
    height: int,
    layers: Sequence[int] = (1,),
    reference_spp: int = 0,
    max_depth: int | None = None,
    seed: int = 0,
    variant: str | None = None,
    draws: int = 0,
    light: NoisyLight = "indirect",
    jitter: bool = False,
    see_through: bool = False,
    previous: View | None = None,
    plan: Plan | None = None,
) -> Rendered:
    """Render one frame of an animated scene: noisy layers, a reference, G-buffers and motion vectors.

    ``direct`` and ``emission`` are means over the reference's samples, or over the noisy ones if ``reference_spp`` is
    0. The result depends only on the arguments: the same frame rendered again, alone or in another process, is the same
    bit for bit. Raises ValueError for options out of range, scenes with unsupported effects, and, with the scalar
    variant, for a plan with buffers of samples (:data:`jaxdn.core.frame.OF_SAMPLES`), which it cannot render.

    Args:
      scene: to render.
      frame: index of the frame.
      width: in pixels.
      height: in pixels.
      layers: samples per pixel of the noisy layers, powers of two.
      reference_spp: samples per pixel of the reference; 0 for none.
      max_depth: path length; default: that of the plan, else of the scene.
      seed: of the random numbers.
      variant: Mitsuba's; default: the fastest that works here.
      draws: further images of one sample each, for training on noise that rarely repeats.
      light: what the radiance holds: ``"indirect"`` light, beside which there is ``direct``, or all that is
        ``"reflected"``, without ``direct``.
      jitter: rays go through another point of the pixels in every frame (:mod:`jaxdn.render.tracing.jitter`), and the
        reference is the mean over each pixel, instead of everything through the centres.
      see_through: the guides of flat mirrors and of glass are those of what they show
        (:mod:`jaxdn.render.buffers.replacement`); not with the scalar variant.
      previous: the ``view`` of the frame before, computed if it is not given; frame 0 has none, and its motion is 0.
      plan: what to leave out: buffers (None then), paths longer than its ``max_depth``, and, in a frame that shows the
        same as an earlier one (``plan.held``), everything except the noise. The rest is the same as without a plan, bit
        for bit. Without one there are all buffers but those on request (:data:`jaxdn.core.frame.ON_REQUEST`).
    """
    check_options(width, height, layers, reference_spp, draws, light, jitter, see_through, plan)
    chosen = use_variant(variant)
    use = tracer(chosen)
    if jitter and use.jittered:
        raise ValueError(f"jitter: {chosen} spreads its samples over the pixels itself; leave it out. {advice()}")
    if see_through and not tells_lobes(chosen):
        raise ValueError(f"see_through: {chosen} cannot follow rays past mirrors and glass; leave it out. {advice()}")
    depth = path_length(scene, max_depth, plan)
    repeated = plan is not None and plan.held[frame] != frame
    planned = frozenset(GUIDES) - ON_REQUEST if plan is None else frozenset(plan.frames[frame])
    if see_through:
        planned -= OF_FIRST_HITS
    if light == "reflected":
        planned -= {"direct"}
    apart, wanted = planned & OF_SAMPLES, frozenset() if repeated else planned - OF_SAMPLES
    if apart and not tells_lobes(chosen):
        raise ValueError(f"plan: {chosen} cannot render {', '.join(sorted(apart))}; plan without them. {advice()}")

    def built_at(index: int) -> Any:
        one = scene.build(index, width, height)
        return jitters.look_through(one, jitters.of_frame(index)) if jitter else one

    before = None
    again = bool(apart & _VECTORS) or _GRADIENT in wanted
    if frame > 0 and not repeated and (again or (wanted & _MOTION and previous is None)):
        before = built_at(frame - 1)
        previous = previous or _view(scene, frame - 1, before, frozenset(), see_through)
    built = built_at(frame)
    check_scene(built)
    needed = bool(wanted | (apart & _VECTORS))
    view = previous if repeated else _view(scene, frame, built, wanted, see_through) if needed else None

    dark = plan is not None and plan.integrator == "none"
    noise_only = plan is not None and not plan.indirect

    def traced(stream: int, first: int, count: int, request: Request | None = None) -> Accumulated:
        if dark or (noise_only and stream == NOISY and reference_spp):
            return no_light((height, width), request or Request())
        there = {"request": request} if request else {}
        numbers = {"seed": seed, "frame": frame, "stream": stream}
        return use.accumulate(built, **numbers, first=first, count=count, max_depth=depth, **there)

    def traced_sets(stream: int, count: int, sets: int) -> list[Accumulated]:
        if dark:
            return [traced(stream, 0, count)] * sets
        numbers = {"seed": seed, "frame": frame, "stream": stream}
        return use.accumulate_sets(built, sets, **numbers, first=0, count=count, max_depth=depth)

    def noise(part: Accumulated) -> np.ndarray:
        return part.indirect if light == "indirect" else part.indirect + part.direct

    # Layer n always holds the samples n-1 ... 2n-2: its image does not depend on the other layers.
    fewest = min(layers)
    request = Request(bool(apart & _LOBES), bool(apart & OF_SHADOWS), light == "reflected") if apart else None
    noisy = {count: traced(NOISY, count - 1, count, request if count == fewest else None) for count in sorted(layers)}
    halves = []
    if reference_spp and not repeated:
        if jitter:
            halves = _spread_halves(partial(traced, REFERENCE), reference_spp, built)
            jitters.look_through(built, jitters.of_frame(frame))
        elif reference_spp % 2:
            middle = (reference_spp + 1) // 2
            halves = [traced(REFERENCE, 0, middle), traced(REFERENCE, middle, reference_spp - middle)]
        else:
            halves = traced_sets(REFERENCE, reference_spp // 2, 2)
    sums = halves or list(noisy.values())
    total = sums[0]
    for part in sums[1:]:
        total = total.plus(part)
    samples = reference_spp or sum(layers)
    singles = traced_sets(DRAWS, 1, draws) if draws else []

    images = {count: _single(noise(part) / count) for count, part in noisy.items()}
    found: dict[str, Any] = {"direct": _single(total.direct / samples), "emission": _single(total.emitted / samples)}
    if view is not None:
        found |= {name: getattr(view.gbuffer, name) for name in _SURFACE}
        if "ray_length" in wanted:
            found["ray_length"] = ray_length(view)
        if wanted & _MOTION:
            found |= _motion(view, previous, wanted)
        if _GRADIENT in wanted:
            found[_GRADIENT] = np.zeros((height, width, 2), np.float32)
            if previous is not None and not dark and (plan is None or plan.indirect):
                numbers = {"seed": seed, "frame": frame, "sample": fewest - 1, "max_depth": depth}
                found[_GRADIENT] = luminance_gradient(use.replay, (before, previous), (built, view), **numbers)
    found |= _of_samples(noisy[fewest], fewest)
    if view is not None and apart & _VECTORS:
        start = previous if frame > 0 and not repeated else None
        numbers = {"seed": seed, "frame": frame, "sample": fewest - 1}
        found |= _vectors(apart, (before, start), (built, view), **numbers)
    buffers = {name: buffer for name, buffer in found.items() if name in wanted | apart}
    return Rendered(
        frame=Frame(radiance=images[fewest], **buffers),
        layers=images,
        reference=_single(noise(total) / samples) if halves else None,
        reference_half=_single(noise(halves[0]) / ((reference_spp + 1) // 2)) if halves else None,
        draws=np.stack([_single(np.concatenate([one.indirect, one.direct], -1)) for one in singles]) if draws else None,
        view=view,
        bad_samples=sum(part.bad for part in (*noisy.values(), *halves, *singles)),
    )


def _spread_halves(traced: Callable[[int, int], Accumulated], samples: int, jittered: Any) -> list[Accumulated]:
    """The sums over the two halves of a reference's samples, through the whole of the pixels of a jittered scene.

    ``traced(first, count)`` gives the sums of some samples; the scene is left at another point of its pixels.
    """
    middle = (samples + 1) // 2

    def spread(first: int, count: int) -> Accumulated:
        edges = first + np.arange(jitters.POSITIONS + 1) * count // jitters.POSITIONS
        parts = []
        for index, (start, end) in enumerate(pairwise(edges.tolist())):
            if end > start:
                jitters.look_through(jittered, jitters.offset(index))
                parts.append(traced(start, end - start))
        return reduce(Accumulated.plus, parts)

    return [spread(0, middle), spread(middle, samples - middle)]


def path_length(scene: AnimatedScene, max_depth: int | None, plan: Plan | None) -> int:
    """The given path length, else the plan's, else the scene's."""
    if max_depth is not None and max_depth < 1:
        raise ValueError(f"max_depth: expected at least 1 (emission only), got {max_depth}.")
    return max_depth or (plan.max_depth if plan else None) or scene.max_depth


class Tracer(NamedTuple):
    """How a variant traces paths."""

    accumulate: Callable[..., Accumulated]
    accumulate_sets: Callable[..., list[Accumulated]]
    replay: Replay
    jittered: bool
    """It distributes its samples over the pixel."""


def tracer(variant: str) -> Tracer:
    """The tracer of a variant."""
    if variant.startswith("scalar"):
        from jaxdn.render.tracing import exact

        return Tracer(exact.accumulate, exact.accumulate_sets, exact.replay, True)
    from jaxdn.render.tracing import wavefront

    return Tracer(wavefront.accumulate, wavefront.accumulate_sets, wavefront.replay, False)


def _of_samples(noisy: Accumulated, samples: int) -> dict[str, Any]:
    """The buffers of a Frame that belong to one noisy image."""
    found: dict[str, Any] = {}
    if noisy.lobes is not None:
        diffuse, specular = (_single(distance) for distance in noisy.lobes.hit_distances())
        light = _single(noisy.lobes.specular / samples)
        found |= {"specular": light, "hit_distance": diffuse, "specular_hit_distance": specular}
    if noisy.shadows is not None:
        found |= {name: _single(part / samples) for name, part in noisy.shadows._asdict().items()}
    return found


def _vectors(
    wanted: frozenset[str], previous: tuple[Any, View | None], current: tuple[Any, View], **numbers: Any
) -> dict[str, Any]:
    """The vectors of shadows and of reflections; 0 where there is no previous frame."""
    if previous[1] is None:
        return dict.fromkeys(_VECTORS, np.zeros((*current[1].gbuffer.ids.shape[:2], 2), np.float32))
    scene, then = previous[0], previous[1]
    motion = motion_between(current[1], then, disocclusion=False).motion
    found: dict[str, Any] = {}
    if "shadow_motion" in wanted:
        found["shadow_motion"] = shadow_motion((scene, then), current, motion, **numbers)
    if "glossy_motion" in wanted:
        found["glossy_motion"] = glossy_motion((scene, then), current, motion, **numbers)
    return found


def _view(scene: AnimatedScene, frame: int, built: Any, wanted: frozenset[str], see_through: bool) -> View:
    pose = {name: np.asarray(matrix, np.float64) for name, matrix in scene.pose(frame).items()}
    parts = {"reflectance": "reflectance" in wanted, "specular": "specular_reflectance" in wanted}
    return View(gbuffer(built, **parts, see_through=see_through), scene.camera(frame), pose)


def _motion(view: View, previous: View | None, wanted: frozenset[str]) -> dict[str, Any]:
    """The motion buffers of a Frame; in the first frame nothing has moved yet."""
    if previous is None:
        zero = np.zeros((*view.gbuffer.ids.shape[:2], 2), np.float32)
        seen = np.ones_like(view.gbuffer.ids, bool)
        still = dict.fromkeys(("motion", "dual_motion", "far_motion"), zero)
        return {**still, "visible": seen, "previous_depth": view.gbuffer.depth}
    found = motion_between(view, previous, disocclusion=bool(wanted & _DISOCCLUSION))
    motion = found.motion.astype(np.float32)
    buffers = {"motion": motion, "previous_depth": found.previous_depth}
    if "far_motion" in wanted:
        buffers["far_motion"] = far_motion(view, previous).astype(np.float32)
    if found.forward_motion is not None and found.visible is not None:
        forward = jnp.asarray(found.forward_motion.astype(np.float32))
        dual = dual_motion(jnp.asarray(motion), forward, visible=jnp.asarray(found.visible[..., 0]))
        buffers |= {"visible": found.visible, "dual_motion": np.asarray(dual)}
    return buffers


def _single(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float32)


def check_options(
    width: int,
    height: int,
    layers: Sequence[int],
    reference_spp: int,
    draws: int,
    light: NoisyLight,
    jitter: bool,
    see_through: bool,
    plan: Plan | None,
) -> None:
    """Raise ValueError for options of :func:`render_frame` that are out of range or contradict each other."""
    check_at_least(1, width=width, height=height)
    powers = all(isinstance(samples, int) and samples >= 1 and samples & (samples - 1) == 0 for samples in layers)
    if not layers or not powers or len(set(layers)) != len(layers):
        raise ValueError(f"layers: expected different powers of two, such as (1, 2, 4), got {tuple(layers)}.")
    if reference_spp < 0 or reference_spp == 1:
        raise ValueError(f"reference_spp: expected 0 (no reference) or at least 2, got {reference_spp}.")
    if draws < 0:
        raise ValueError(f"draws: expected 0 or more images of one sample each, got {draws}.")
    check_option(light, "light", ("indirect", "reflected"))
    if draws and light == "reflected":
        raise ValueError("draws: expected 0 with light 'reflected', as training draws indirect light; leave one out.")
    wrong = OF_SHADOWS if light == "indirect" else {"direct"}
    if plan is not None and wrong & set(plan.buffers):
        raise ValueError(f"plan: expected one that was made for light {light!r}; pass light={light!r} to effects.plan.")
    if jitter and plan is not None:
        held = plan.held != tuple(range(len(plan.held)))
        if held or THROUGH_CENTRES & set(plan.buffers):
            raise ValueError("plan: expected one that was made for jitter; pass jitter=True to effects.plan.")
    if see_through and plan is not None and OF_FIRST_HITS & set(plan.buffers):
        raise ValueError("plan: expected one that was made to see through; pass see_through=True to effects.plan.")
