"""``dasr``: deep adaptive sampling, without a history.

Each frame is rendered with one sample everywhere; a network that sees it says where further samples go, and a second
one predicts the image from all of them. Both are trained together, through the renderer.

Alexandr Kuznetsov, Nima Khademi Kalantari, Ravi Ramamoorthi, "Deep Adaptive Sampling for Low Sample Count Rendering",
2018. As in the comparison of Hasselgren et al. 2020, the network is that of the other methods, and there is no buffer
of visibility.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods import direct
from jaxdn.methods.demodulation import Demodulation, demodulated
from jaxdn.methods.registry import method
from jaxdn.methods.sampler import Sampling, allocate_after_first, allocate_samples, sampler
from jaxdn.networks import LARGE, MULTIPLE, SMALL, Widths
from jaxdn.ops.scales import pad
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.recipes.objectives import compressed_illumination, last_frames, pyramid_illumination
from jaxdn.recipes.recipe import Recipe


@dataclass(frozen=True)
class Options(Sampling):
    """What the papers set differently or leave open, or where another setting may be better."""

    size: Literal["large", "small"] | Widths = "large"
    """The U-Nets' widths, by name or as tuples (see :func:`jaxdn.networks.unet.unet`)."""
    background: Literal["pass", "filter"] = "pass"
    """Pixels without a surface (depth at ``FAR``) keep their radiance; or they are predicted as all others."""
    exposure: Literal["measured", "given"] = "measured"
    """The networks see radiance times :func:`jaxdn.color.exposure` of each frame; or radiance as it is given."""
    initialization: Literal["he", "xavier"] = "he"
    """Initial weights of both U-Nets; xavier (as in the paper) gives deep levels tiny gradients."""
    demodulate: Demodulation = "brdf"
    """What radiance is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`."""
    implementation: Literal["reference", "onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"] | None = None
    """Backend of the U-Nets: XLA, or on CPUs oneDNN in bfloat16 or float32 or ONNX Runtime (inference), or oneDNN
    (training). None is XLA."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.least < 1:
            raise ValueError(f"least: expected at least 1, the sample that is rendered first, got {self.least:g}.")
        if self.least % 2 != 1:
            raise ValueError(
                f"least: expected an odd number, the sample that is rendered first and pairs, got {self.least:g}."
            )
        if self.rounding == "stochastic":
            raise ValueError(
                "rounding: expected 'exact' or 'nearest', as the numbers of samples are odd, got 'stochastic'."
            )


@method(
    Options,
    title="Deep adaptive sampling and reconstruction (Kuznetsov et al. 2018)",
    presets={
        "paper": Options(
            background="filter", exposure="given", initialization="xavier", rounding="nearest", demodulate="none"
        )
    },
    recipes={
        "usual": Recipe(pyramid_illumination()),
        "paper": Recipe(
            compressed_illumination(), frames=1, decay=False, clip_norm=0.0, variation=NO_AUGMENTATION, average=0.0
        ),
        "hasselgren": Recipe(
            last_frames(), frames=5, decay=False, clip_norm=0.0, variation=NO_AUGMENTATION, average=0.0
        ),
    },
    variants={"dasr-large": {"size": "large"}, "dasr-small": {"size": "small"}},
    backends=("onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"),
)
def dasr(options: Options) -> Denoiser:
    """Adaptive sampling of single frames; it requests samples, from stored layers of 1, 2, 4, ... or from the renderer.

    ``budget`` counts the sample that is rendered first: the layer of one sample. The network's numbers of samples are
    odd, that one and pairs of further ones, as layers hold the first sample in odd numbers alone; with
    ``adaptive=False`` every pixel has the budget. ``params`` has the two networks, "sampler" (absent with
    ``adaptive=False``) and "predictor". Reads albedo, normal, depth, sample_count (one sample without it), and
    reflectance with ``demodulate="brdf"``. Raises ValueError for options out of range and for a budget that the layers
    cannot give, and ``step`` for a frame of the wrong shape, never for its contents.
    """
    from jaxdn.networks.unet import unet

    widths = {"large": LARGE, "small": SMALL}[options.size] if isinstance(options.size, str) else options.size
    built: dict[str, Any] = {"initialization": options.initialization, "implementation": options.implementation}
    surfaces = (3, 3, 1)
    network = sampler(options, (3, *surfaces), size=options.size, allocate=allocate_after_first, **built)
    predictor = unet((3, *surfaces, 1), (3,), widths=widths, **built)

    def prepare(frame: Frame) -> tuple[FrameStatistics, direct.PreparedFrame]:
        return direct.prepare(frame, background=options.background, multiple=MULTIPLE)

    def init(key: jax.Array, frame: Frame) -> Params:
        first, second = jax.random.split(key)
        params = {"predictor": direct.init_grey(predictor.init(first), "head_0")}
        return {**params, "sampler": network.init(second)} if options.adaptive else params

    def start(params: Params, frame: Frame) -> tuple[()]:
        return ()

    def step(
        params: Params, state: tuple[()], prepared: direct.PreparedFrame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[tuple[()], jax.Array, int]:
        frame, gain = prepared.frame, direct.choose_gain(options.exposure, statistics)
        surfaces = _surfaces(frame, statistics)
        # An absent group is 0 to the network, but a frame without numbers has one sample everywhere.
        count = jnp.ones_like(frame.radiance[..., :1]) if frame.sample_count is None else frame.sample_count
        groups: list[jax.Array | None] = [color.compress(gain * prepared.light)]
        groups += [None if group is None else pad(group, MULTIPLE) for group in (*surfaces, 1.0 / (1.0 + count))]
        features = [None if group is None else group[None] for group in groups]
        output = predictor.apply(params["predictor"], features)[0][0]
        return (), direct.expand_output(output, prepared, gain), 0

    def samples(params: Params, state: tuple[()], frame: Frame, first: jax.Array, most: int) -> jax.Array:
        even = jnp.zeros_like(frame.radiance[..., :1])
        if not options.adaptive:
            return allocate_samples(options, even, most)
        statistics, prepared = prepare(frame)
        light = color.compress(direct.choose_gain(options.exposure, statistics) * prepared.light)
        features = [light[: even.shape[0], : even.shape[1]], *_surfaces(frame, statistics)]
        return network.counts(params["sampler"], features, jnp.asarray(False), most)

    reads = frozenset({"albedo", "normal", "depth", "sample_count"})
    core = Core(start, step, reads, init, samples, prepare)
    return demodulated(recurrent(core), by=options.demodulate)


def _surfaces(frame: Frame, statistics: FrameStatistics) -> tuple[jax.Array | None, ...]:
    """What the networks see of the surfaces; 0 is the neutral value."""
    return (
        None if frame.albedo is None else frame.albedo - 1.0,
        frame.normal,
        None if frame.depth is None else depth_feature(frame.depth, statistics.mean_depth),
    )
