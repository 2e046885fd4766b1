"""One frame rendered with another number of samples in each pixel, as a denoiser asks for them."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxdn.core.frame import OF_SAMPLES, Frame
from jaxdn.planning.plan import Plan
from jaxdn.render.buffers.geometry import View
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import advice
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.seeds import NOISY, SampleStream
from jaxdn.render.tracing.vectorised_path_tracer import accumulate_per_pixel

Ask = Callable[[Frame], np.ndarray]
"""A frame with its buffers, and one sample as radiance -> [H, W, 1] whole numbers of samples."""


class SampledFrame(NamedTuple):
    """A frame and what the next one needs of it."""

    frame: Frame
    """``radiance`` is the mean of ``sample_count`` samples; a pixel without samples is 0."""
    view: View | None
    bad_samples: int
    """Samples that were not finite and count as black."""


def render_sampled(
    scene: AnimatedScene,
    frame: int,
    ask: Ask,
    settings: RenderSettings,
    *,
    previous: View | None = None,
    sample_first: bool = True,
) -> SampledFrame:
    """Render a frame's buffers and one sample, ask how many samples each pixel gets, and render the rest of these.

    The first sample counts: a pixel that gets n has the samples 0 ... n - 1 of its frame, the same as in a frame that
    has n of them everywhere. Without ``sample_first`` no sample is rendered before ``ask`` is called; then no more
    paths are traced than it asks for. Buffers that describe one noisy image (:data:`jaxdn.core.frame.OF_SAMPLES`) are
    left out. Raises ValueError with a scalar variant of Mitsuba, which renders whole images only, and for settings with
    other layers than one of one sample, with a reference, with draws, with jitter, with filtered pixels, or without a
    plan.

    Args:
      scene: to render.
      frame: index of the frame.
      ask: decides.
      settings: how; their plan may let frames share the buffers of those before, which are then rendered again.
      previous: the ``view`` of the frame before.
      sample_first: ``ask`` sees a sample of every pixel; else its radiance is 0.
    """
    others = settings.reference_spp or settings.draws or not settings.through_centres
    if settings.plan is None or settings.layers != (1,) or others:
        raise ValueError(
            "samples for each pixel: expected a plan, layers (1,), no reference, no draws, no jitter and pixel_filter "
            "'centre'."
        )
    settings = replace(settings, plan=unshare_frames(settings.plan)).complete(scene)
    assert settings.plan is not None
    assert settings.max_depth is not None
    if str(settings.variant).startswith("scalar"):
        raise ValueError(
            f"samples for each pixel: expected an LLVM or CUDA variant of Mitsuba, got a scalar one. {advice()}"
        )
    # Paths of depth 1 are camera rays: they tell of emitted light, and buffers need them anyway.
    begun = settings if sample_first else replace(settings, max_depth=1)
    rendered = render_frame(scene, frame, begun, previous=previous)
    counts = np.maximum(np.round(np.asarray(ask(rendered.frame))[..., 0]), 0).astype(np.int64)
    first = 1 if sample_first else 0
    total, bad = np.where(counts[..., None] > 0, rendered.frame.radiance, 0.0), rendered.bad_samples
    if settings.plan.integrator != "none" and settings.plan.indirect:
        built, stream = scene.build(frame, settings.width, settings.height), SampleStream(settings.seed, frame, NOISY)
        rest = np.maximum(counts - first, 0)
        more = accumulate_per_pixel(built, stream, first, rest, max_depth=settings.max_depth)
        total = total + more.indirect + (more.direct if settings.light == "reflected" else 0.0)
        bad += more.bad
    radiance = (total / np.maximum(counts, 1)[..., None]).astype(np.float32)
    sampled = rendered.frame._replace(radiance=radiance, sample_count=counts[..., None].astype(np.float32))
    return SampledFrame(sampled, rendered.view, bad)


def unshare_frames(plan: Plan) -> Plan:
    """The plan without buffers of samples, in which no frame shares its buffers with one before."""
    frames = tuple(tuple(name for name in plan.frames[at] if name not in OF_SAMPLES) for at in plan.shared_with)
    return plan._replace(frames=frames, shared_with=tuple(range(len(frames))))
