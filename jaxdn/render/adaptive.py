"""One frame rendered with another number of samples in each pixel, as a denoiser asks for them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import OF_SAMPLES, Frame
from jaxdn.planning.catalogue import NoisyLight
from jaxdn.planning.plan import Plan
from jaxdn.render.buffers.geometry import View
from jaxdn.render.frame import path_length, render_frame
from jaxdn.render.mitsuba.variant import advice, use_variant
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.tracing.seeds import NOISY

Ask = Callable[[Frame], np.ndarray]
"""A frame with its buffers, and one sample as radiance -> [H, W, 1] whole numbers of samples."""


class Sampled(NamedTuple):
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
    *,
    width: int,
    height: int,
    plan: Plan,
    seed: int = 0,
    light: NoisyLight = "reflected",
    see_through: bool = False,
    previous: View | None = None,
) -> Sampled:
    """Render a frame's buffers and one sample, ask how many samples each pixel gets, and render the rest of these.

    The first sample counts: a pixel that gets n has the samples 0 ... n - 1 of its frame, the same as in a frame that
    has n of them everywhere. Buffers that describe one noisy image (:data:`jaxdn.core.frame.OF_SAMPLES`) are left out.
    Raises ValueError with a scalar variant of Mitsuba, which renders whole images only.

    Args:
      scene: to render.
      frame: index of the frame.
      ask: decides.
      width: in pixels.
      height: in pixels.
      plan: what to render; with frames that hold those before, their buffers are rendered again.
      seed: of the random numbers.
      light: what the radiance holds, see :func:`jaxdn.render.render_frame`.
      see_through: as there.
      previous: the ``view`` of the frame before.
    """
    if use_variant().startswith("scalar"):
        raise ValueError(
            f"samples for each pixel: expected an LLVM or CUDA variant of Mitsuba, got a scalar one. {advice()}"
        )
    from jaxdn.render.tracing.wavefront import accumulate_each

    alone = alone_in_each_frame(plan)
    settings: dict[str, Any] = {"width": width, "height": height, "seed": seed, "light": light, "plan": alone}
    rendered = render_frame(scene, frame, previous=previous, see_through=see_through, **settings)
    counts = np.asarray(ask(rendered.frame))
    whole = np.maximum(np.round(counts[..., 0]), 0).astype(np.int64)
    total, bad = np.where(whole[..., None] > 0, rendered.frame.radiance, 0.0), rendered.bad_samples
    if plan.integrator != "none" and plan.indirect:
        numbers = {"seed": seed, "frame": frame, "stream": NOISY, "first": 1}
        built = scene.build(frame, width, height)
        more = accumulate_each(built, np.maximum(whole - 1, 0), max_depth=path_length(scene, None, alone), **numbers)
        total = total + more.indirect + (more.direct if light == "reflected" else 0.0)
        bad += more.bad
    radiance = (total / np.maximum(whole, 1)[..., None]).astype(np.float32)
    sampled = rendered.frame._replace(radiance=radiance, sample_count=whole[..., None].astype(np.float32))
    return Sampled(sampled, rendered.view, bad)


def alone_in_each_frame(plan: Plan) -> Plan:
    """The plan without buffers of samples, in which no frame takes its buffers from one before."""
    frames = tuple(tuple(name for name in plan.frames[at] if name not in OF_SAMPLES) for at in plan.held)
    return plan._replace(frames=frames, held=tuple(range(len(frames))))
