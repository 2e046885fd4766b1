"""``ntasd``: neural temporal adaptive sampling and denoising.

Before a frame is rendered, one network sees the last image, warped to where its surfaces are now, and the surfaces'
buffers, and says where samples go; the frame is rendered with as many samples as it says, and a second network denoises
it with kernels at three scales and one on the warped image, as in ``ntd``. Both are trained together, through the
renderer: what one more sample would have changed is known from the reference (:func:`jaxdn.ops.sampling.more_samples`).

Jon Hasselgren, Jacob Munkberg, Marco Salvi, Anjul Patney, Aaron Lefohn, "Neural Temporal Adaptive Sampling and
Denoising", 2020 ("Hasselgren et al. 2020" here).
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, Pattern, recurrent
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods import ntd
from jaxdn.methods.demodulation import demodulated
from jaxdn.methods.history_vectors import Vectors
from jaxdn.methods.registry import method
from jaxdn.methods.sampler import Sampling, allocate_samples, gray, motion_feature, sampler
from jaxdn.ops.sampling import draw_random_numbers, rotate_pattern
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.recipes.objectives import last_frames, unbiased_illumination
from jaxdn.recipes.recipe import Recipe


@dataclass(frozen=True)
class Options(ntd.Options, Sampling):
    """The options of ``ntd``, of which some have other defaults here, and those of the samples."""

    motion: Vectors = "traditional"
    """Vectors that warp the history."""
    alpha_at: Literal["coarse", "fine"] = "fine"
    """The blending weight of two scales: for each fine pixel, or at the coarse scale, as the channels of the paper's
    heads say; with its nearest U both are its eq. 3."""
    up: Literal["bilinear", "nearest"] = "nearest"
    """The upsampling U of coarser scales."""
    memory: Annotated[int, Range(0)] = 0
    """Numbers a pixel that the denoiser keeps for itself beside the last image, warped as it is: 64 in sec. 3.2, where
    they lose 0.2 dB."""
    pattern: Literal["random", "rotating"] = "random"
    """Where fractions of samples are rounded up (``rounding="stochastic"``): at random, or in a fixed pattern that
    rotates from frame to frame (:func:`jaxdn.ops.sampling.rotate_pattern`)."""


PAPER = Options(alpha_at="coarse", least=0, rounding="nearest", **ntd.AS_PUBLISHED)
"""The settings of Hasselgren et al. 2020, as far as they are known."""


@method(
    Options,
    title="Neural temporal adaptive sampling and denoising (Hasselgren et al. 2020)",
    presets={"paper": PAPER},
    recipes={
        "usual": Recipe(unbiased_illumination()),
        "paper": Recipe(last_frames(), frames=5, decay=False, clip_norm=0.0, variation=NO_AUGMENTATION, average=0.0),
    },
    variants={"ntasd-large": {"size": "large"}, "ntasd-small": {"size": "small"}},
    backends=("onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"),
)
def ntasd(options: Options) -> Denoiser:
    """Adaptive sampling and denoising; it requests samples, from stored layers of 1, 2, 4, ... or from the renderer.

    The first frame has the same number of samples everywhere. ``params`` has the two networks, "sampler" (absent with
    ``adaptive=False``) and "denoiser", whose parts are those of ``ntd``. Reads albedo, normal, depth, motion and
    sample_count (one sample without it); reflectance with ``demodulate="brdf"``, and with ``guides="materials"``
    roughness, too. Raises ValueError for an unknown option and for a budget that the layers cannot give, and ``step``
    for a frame of the wrong shape, never for its contents.
    """
    extra = ntd.ExtraFeatures((2, 1), _sample_features, frozenset({"motion", "sample_count"}))
    inner = ntd.core_of(options, extra, memory=options.memory)
    flagged = options.missing_history == "current"
    built: dict[str, Any] = {name: getattr(options, name) for name in ("size", "initialization", "implementation")}
    network = sampler(options, (1, 1, 3, 1, 2, *([1] if flagged else [])), allocate=allocate_samples, **built)

    def init(key: jax.Array, frame: Frame) -> Params:
        first, second = jax.random.split(key)
        params = {"denoiser": inner.init(first, frame)}
        return {**params, "sampler": network.init(second)} if options.adaptive else params

    def start(params: Params, frame: Frame) -> jax.Array:
        return inner.start(params["denoiser"], frame)

    def step(
        params: Params, state: jax.Array, prepared: ntd.PreparedFrame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[jax.Array, jax.Array, jax.Array | int]:
        return inner.step(params["denoiser"], state, prepared, first, statistics)

    def samples(params: Params, state: jax.Array, frame: Frame, first: jax.Array, most: int) -> jax.Array:
        dark = frame._replace(radiance=jnp.zeros_like(frame.radiance))  # nothing is rendered yet
        if not options.adaptive:
            return allocate_samples(options, dark.radiance[..., :1], most)
        past, absent, _ = ntd.warp_history(options, state[..., :3], dark, first)
        gain = color.exposure(past) if options.exposure == "measured" else 1.0
        scale = measure_frame(past, frame.depth, frame).mean_depth if options.depth_scale == "geometric" else 1.0
        features = [
            gray(color.compress(gain * past)),
            None if frame.albedo is None else gray(frame.albedo) - 1.0,
            frame.normal,
            None if frame.depth is None else depth_feature(frame.depth, scale),
            None if frame.motion is None else motion_feature(frame.motion),
        ]
        if flagged:
            features.append(absent.astype(past.dtype))
        return network.counts(params["sampler"], features, first, most)

    core = Core(start, step, inner.reads, init, samples, inner.prepare, sees_sample=False)
    core = core._replace(pattern=_PATTERNS[options.pattern])
    return demodulated(recurrent(core), by=options.demodulate)


_PATTERNS: dict[str, Pattern] = {"random": draw_random_numbers, "rotating": rotate_pattern}


def _sample_features(frame: Frame) -> list[jax.Array | None]:
    """Motion, and how noisy each pixel is: ``1 / (1 + n)`` for n samples, 1 where nobody says how many."""
    count = jnp.ones_like(frame.radiance[..., :1]) if frame.sample_count is None else frame.sample_count
    return [None if frame.motion is None else motion_feature(frame.motion), 1.0 / (1.0 + count)]
