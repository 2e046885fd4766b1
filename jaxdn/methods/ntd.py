"""Neural temporal denoising for indirect illumination (``ntd``).

A U-Net predicts, for every pixel, 5x5 softmax kernels for the noisy image at three scales, one 5x5 kernel for the
previous output warped by *dual* motion vectors, and how to blend them. Its details are options: ``preset="paper"`` has
what the paper states, and the least surprising choice where it states nothing; the documentation lists both.

Beyond the paper, the kernels are guided: what the buffers show of two surfaces is compared before the network's logits,
so that it need not learn where edges are (:func:`jaxdn.ops.kernel_prediction.softmax.softmax_filter`).

Yan Zeng, Lu Wang, Yanning Xu, Xiangxu Meng, "Neural Temporal Denoising for Indirect Illumination", 2021 ("Zeng et al.
2021" here). Dual motion vectors: Zheng Zeng et al., "Temporally Reliable Motion Vectors for Better Use of Temporal
Information", 2021.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.sanitize import sanitize_image
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.filters.surface_test import depth_feature, surface_mask
from jaxdn.methods.demodulation import Demodulation, demodulated
from jaxdn.methods.history_vectors import READS as VECTORS_READ
from jaxdn.methods.history_vectors import Vectors, choose_vectors
from jaxdn.methods.reconstruction import SCALES, Prediction, blend, heads_of, init_bias
from jaxdn.methods.registry import method
from jaxdn.networks import LARGE, MULTIPLE, SMALL, Widths, graph
from jaxdn.ops.motion import on_screen
from jaxdn.ops.scales import crop, downsample, fill_holes, pad
from jaxdn.ops.warp import warp
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.recipes.objectives import indirect_illumination, unbiased_illumination
from jaxdn.recipes.recipe import FINISH, Recipe

PRECISIONS = {"albedo": (3, 3.0), "normal": (3, 3.0), "depth": (1, 6.0), "reflectance": (3, 3.0), "roughness": (1, 3.0)}
"""Guide of the kernels -> its channels, and the logarithm of its precision at the start of training."""


@dataclass(frozen=True)
class Options:
    """What the papers set differently or leave open, or where another setting may be better."""

    size: Literal["large", "small"] | Widths = "large"
    """The U-Net's widths, by name or as tuples (see :func:`jaxdn.networks.unet.unet`)."""
    motion: Vectors = "dual"
    """Vectors that warp the history: dual ones, those of the surface, or those of shadows and reflections where one
    passes (:func:`jaxdn.methods.history_vectors.choose_vectors`)."""
    history: Literal["warped", "none"] = "warped"
    """The last image, along these vectors; or every frame is a first frame (the networks without recurrence that
    Hasselgren et al. 2020 compare with), and ``motion`` is not looked at."""
    alpha_at: Literal["coarse", "fine"] = "coarse"
    """The blending weight of two scales: inside U, at the coarse scale; or outside it, for each fine pixel."""
    down: Literal["mean", "max"] = "mean"
    """D on each 2x2 block; the maximum (as in the paper) darkens."""
    up: Literal["bilinear", "nearest"] = "bilinear"
    """The upsampling U."""
    depth_scale: Literal["geometric", "unit"] = "geometric"
    """The depth feature relative to the frame's geometric mean depth, or to 1, see
    :func:`jaxdn.filters.surface_test.depth_feature`."""
    border: Literal["clamp", "zeros"] = "clamp"
    """Border of the warp."""
    first_frame: Literal["none", "noisy"] = "none"
    """At age 0: no history and alpha^t = 1, or the first frame's noisy image as history."""
    missing_history: Literal["current", "blend"] = "current"
    """Off-screen or without a vector: the noisy pixel as history, alpha^t = 1, and a mask of these pixels as an
    additional input channel; or no special treatment."""
    guides: Literal["geometry", "materials"] = "geometry"
    """Buffers that the network sees: albedo, normal and depth, as in the paper; or ``reflectance`` and ``roughness``
    too."""
    prediction: Prediction = "temporal"
    """What the network predicts, see :mod:`jaxdn.methods.reconstruction`: kernels at three scales and one for the
    history; without the one for the history; kernels at full resolution alone; or the image itself."""
    kernels: Literal["guided", "plain"] = "guided"
    """The network's logits plus a cross-bilateral prior, see :func:`guided_features`; or these logits alone, as in the
    paper."""
    background: Literal["pass", "filter"] = "pass"
    """Pixels without a surface (depth at ``FAR``) keep their radiance, which has no noise, and surfaces get none of it:
    for the filters these pixels hold the light of surfaces next to them. Or they are filtered as all others. Of those
    without samples the radiance is filled from others, see :func:`fill_background`."""
    exposure: Literal["measured", "given"] = "measured"
    """The network sees radiance times :func:`jaxdn.color.exposure` of each frame, so that twice the light gives twice
    the image; or radiance as it is given."""
    initialization: Literal["he", "xavier"] = "he"
    """Of the U-Net's weights, see :func:`jaxdn.networks.unet.draw_initial_weights`."""
    demodulate: Demodulation = "brdf"
    """What radiance is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`."""
    implementation: Literal["reference", "onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"] | None = None
    """Backend of the U-Net: XLA, or on CPUs oneDNN in bfloat16 or float32 (the extra ``onednn``) or ONNX Runtime (the
    extra ``onnx``) for inference, or oneDNN's convolutions for training. None is XLA."""


AS_PUBLISHED: dict[str, Any] = {
    "depth_scale": "unit",
    "border": "zeros",
    "first_frame": "noisy",
    "missing_history": "blend",
    "kernels": "plain",
    "background": "filter",
    "exposure": "given",
    "initialization": "xavier",
    "demodulate": "none",
}
"""The settings that this paper and that of ``ntasd`` share."""
_TRAINING: dict[str, Any] = {
    "learning_rate": 1e-4,
    "decay": False,
    "clip_norm": 0.0,
    "variation": NO_AUGMENTATION,
    "average": 0.0,
}
"""Entries of the recipe of this paper."""
PAPER = Options(down="max", **AS_PUBLISHED)
"""The settings of the paper: D is max-pooling (eq. 4), taps outside the image are 0, the first history is noisy."""


def initial_precisions(guides: Literal["geometry", "materials"]) -> Params:
    """Name of a guide -> [3, C] the logarithms of its precisions at each scale, before training."""
    names = ("albedo", "normal", "depth", *(("reflectance", "roughness") if guides == "materials" else ()))
    return {name: jnp.full((SCALES, PRECISIONS[name][0]), PRECISIONS[name][1], jnp.float32) for name in names}


def guided_features(precisions: Params, guides: dict[str, jax.Array | None]) -> list[jax.Array | None]:
    """The features that guide the kernels at full, half and quarter resolution; None without any guide.

    With g the guides (at coarser scales their means over blocks) and a the learned log precisions, the logit of the
    tap at q of pixel p gets ``- sum_c exp(a_c) (g_c(p) - g_c(q))^2``: the features are ``exp(a_c / 2) g_c``. Absent
    guides are left out, as constant ones would change nothing.

    Args:
      precisions: name -> [3, C], see :func:`initial_precisions`.
      guides: name -> [H, W, C] or None; H and W are multiples of 4.
    """
    present = {name: guide for name in precisions if (guide := guides[name]) is not None}
    if not present:
        return [None] * SCALES
    together = jnp.concatenate(list(present.values()), axis=-1)
    logarithms = jnp.concatenate([precisions[name] for name in present], axis=-1).astype(together.dtype)
    features: list[jax.Array | None] = []
    for scale in range(SCALES):
        if scale:
            together = downsample(together)
        features.append(together * jnp.exp(0.5 * logarithms[scale])[None, None])
    return features


def _guides(options: Options, frame: Frame, statistics: FrameStatistics) -> dict[str, jax.Array | None]:
    """The guides as the network and the prior see them, padded; 0 is the neutral value, None where one is absent."""
    reflectance = frame.albedo if frame.reflectance is None else frame.reflectance
    scale = statistics.mean_depth if options.depth_scale == "geometric" else 1.0
    depth = None if frame.depth is None else depth_feature(frame.depth, scale)
    fractions = {"albedo": frame.albedo, "reflectance": reflectance, "roughness": frame.roughness}
    guides = {name: None if guide is None else guide - 1.0 for name, guide in fractions.items()}
    guides |= {"normal": frame.normal, "depth": depth}
    return {name: None if guide is None else pad(guide, MULTIPLE) for name, guide in guides.items()}


def warp_history(
    options: Options, state: jax.Array, frame: Frame, first: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The history [H, W, 3] along the motion vectors, and the noisy frame where there is none.

    Also where it is missing (bool [H, W, 1]), and how many of its values were invalid.
    """
    noisy = frame.radiance
    vectors = choose_vectors(frame, options.motion)
    if options.history == "none":
        first, vectors = jnp.ones_like(first), None
    absent = first if options.first_frame == "none" else jnp.zeros_like(first)
    absent = jnp.broadcast_to(absent, (*noisy.shape[:2], 1))
    history = state
    if vectors is not None:
        vectors = jax.lax.stop_gradient(vectors)
        history = warp(history, vectors, border=options.border)
    valid = sanitize_image(history)
    invalid = jnp.sum((valid != history) & ~first, dtype=jnp.int32)
    history = jnp.where(first, noisy, valid)
    if vectors is not None and options.missing_history == "current":
        off_screen = ~on_screen(vectors) & ~first
        history = jnp.where(off_screen, noisy, history)
        absent = absent | off_screen
    return history, absent, invalid


def warp_memory(options: Options, memory: jax.Array, frame: Frame, first: jax.Array) -> jax.Array:
    """What the network kept for itself [H, W, n] along the motion vectors; 0 where there is none, or outside."""
    if options.history == "none":
        return jnp.zeros_like(memory)
    memory = jnp.where(first, 0.0, jnp.clip(jnp.nan_to_num(memory), -1.0, 1.0))
    vectors = choose_vectors(frame, options.motion)
    return memory if vectors is None else warp(memory, jax.lax.stop_gradient(vectors), border="zeros")


def fill_background(frame: Frame, hit: jax.Array) -> jax.Array:
    """The radiance [H, W, 3] of pixels without a surface, where ``hit`` [H, W] is false.

    Those without samples have the mean of those with samples in the same block (:func:`jaxdn.ops.scales.fill_holes`),
    or else in the frame; 0 where none has any.
    """
    light, count = frame.radiance, frame.sample_count
    if count is None:
        return light
    known = ~hit[..., None] & (count > 0)
    padded = pad(jnp.concatenate([light, jnp.ones_like(count)], axis=-1), MULTIPLE)
    around = crop(fill_holes(padded, pad(known, MULTIPLE)), light.shape[:2])
    mean = jnp.sum(jnp.where(known, light, 0.0), axis=(0, 1)) / jnp.maximum(jnp.sum(known, dtype=light.dtype), 1.0)
    filled = jnp.where(around[..., 3:] > 0, around[..., :3], mean)
    # As where surfaces are filled: the gradient of its own value stays.
    return jnp.where(count > 0, light, filled + light - jax.lax.stop_gradient(light))


@method(
    Options,
    title="Neural temporal denoising for indirect illumination (Zeng et al. 2021)",
    presets={"paper": PAPER},
    recipes={
        "usual": Recipe(unbiased_illumination()),
        "finish": FINISH,
        "without-occlusion": Recipe(unbiased_illumination(hidden=0.0)),
        "paper-loss": Recipe(indirect_illumination(), variation=NO_AUGMENTATION, average=0.0),
        "paper-loss-without-occlusion": Recipe(
            indirect_illumination(occlusion=False), variation=NO_AUGMENTATION, average=0.0
        ),
        "paper": Recipe(indirect_illumination(), **_TRAINING),
        "paper-without-occlusion": Recipe(indirect_illumination(occlusion=False), **_TRAINING),
    },
    variants={"ntd-large": {"size": "large"}, "ntd-small": {"size": "small"}},
    backends=("onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"),
)
def ntd(options: Options) -> Denoiser:
    """The neural temporal denoiser.

    With x the noisy radiance, i^s its 5x5 kernel-filtered versions at scales s = 1, 1/2, 1/4 and t the kernel-filtered
    warped history, ``o^c = i^1/4``, ``o^f = i^f - U(alpha D(i^f)) + U(alpha o^c)`` for the two finer scales, and the
    output is ``alpha^t o^1 + (1 - alpha^t) t`` (Zeng et al. 2021, eq. 1 and 4): alpha^t weighs the *current* frame.

    Guided kernels have learned precisions in ``params["guide"]`` beside the network's weights. Training may continue
    from weights with plain kernels (``jaxdn train --start``); the first image then differs by the prior.

    The paper trains with Adam at a constant 1e-4 for 200 epochs of 142 clips; the recipe "paper" has this rate, but
    2,000 updates of 4 windows, which are 56 such epochs (``--steps 7100`` are 200). Raises ValueError for an unknown
    option, and ``step`` for a frame of the wrong shape, never for its contents.
    """
    return demodulated(recurrent(core_of(options)), by=options.demodulate)


class ExtraFeatures(NamedTuple):
    """Features that a method gives the network in addition."""

    groups: tuple[int, ...] = ()
    """Their channel counts."""
    of: Callable[[Frame], list[jax.Array | None]] = lambda frame: []
    """frame -> one [H, W, c] for each, or None."""
    reads: frozenset[str] = frozenset()
    """Buffers that they are made of."""


class PreparedFrame(NamedTuple):
    """A frame, and what the network and the kernels see of its light."""

    frame: Frame
    """Its radiance bounded: divided by a small albedo it may be beyond what the network has ever seen."""
    noisy: jax.Array
    """[h, w, 3] padded, without the light of pixels that do not count."""
    hit: jax.Array | None
    """[H, W] bool, a surface is seen; None: pixels without one are filtered as all others."""


NO_EXTRA_FEATURES = ExtraFeatures()


def core_of(options: Options, extra: ExtraFeatures = NO_EXTRA_FEATURES, *, memory: int = 0) -> Core:
    """The method without division and shared processing; its state is the last image [H, W, 3].

    With ``memory`` the network has so many numbers a pixel of its own in the state, behind the image: its outputs in
    [-1, 1], which are warped as the image is and enter with the next frame.

    Where ``sample_count`` is among the buffers read, pixels without samples are filled from their neighbours.
    """
    flagged, materials = options.missing_history == "current", options.guides == "materials"
    # What is optional comes last: weights trained without it can be continued with it.
    groups = (3, 3, 3, 1, 3, *([1] if flagged else []), *([3, 1] if materials else []), *extra.groups)
    groups = (*groups, memory) if memory else groups
    fine, direct = options.alpha_at == "fine", options.prediction == "direct"
    kernels = heads_of(options.prediction, fine=fine)
    heads = (kernels[0] + memory, *kernels[1:])
    # Flax is imported only when a network is built: filters without weights need only jax and numpy.
    from jaxdn.networks.unet import unet

    sizes = {"large": LARGE, "small": SMALL}
    widths = sizes[options.size] if isinstance(options.size, str) else options.size
    scheme, backend = options.initialization, options.implementation
    network = unet(groups, heads, widths=widths, initialization=scheme, implementation=backend)
    reads = frozenset({"albedo", "normal", "depth"})
    reads |= VECTORS_READ[options.motion] if options.history == "warped" else set()
    reads |= {"reflectance", "roughness"} if materials else set()
    reads |= extra.reads

    guided = options.kernels == "guided" and not direct

    def init(key: jax.Array, frame: Frame) -> Params:
        params = network.init(key)
        if options.initialization == "he":
            params = init_bias(params, options.prediction, fine=fine)
        return {**params, "guide": initial_precisions(options.guides)} if guided else params

    def start(params: Params, frame: Frame) -> jax.Array:
        return jnp.zeros((*frame.radiance.shape[:2], 3 + memory), frame.radiance.dtype)

    def predict(params: Params, features: list[jax.Array | None], dtype: jnp.dtype) -> list[jax.Array]:
        """The heads [H, W, c] for feature groups [H, W, c]."""
        batch = [None if group is None else group[None].astype(dtype) for group in features]
        weights = {name: part for name, part in params.items() if name != "guide"}
        return [head[0].astype(dtype) for head in network.apply(weights, batch)]

    def prepare(frame: Frame) -> tuple[FrameStatistics, PreparedFrame]:
        frame = frame._replace(radiance=jnp.minimum(frame.radiance, RADIANCE_MAX))
        hit = surface_mask(frame.depth, None) if options.background == "pass" else None
        noisy = pad(frame.radiance, MULTIPLE)
        if hit is not None:
            noisy = fill_holes(noisy, pad(hit[..., None], MULTIPLE))
        if frame.sample_count is not None:
            sampled = pad(frame.sample_count > 0, MULTIPLE)
            # Its own value is gone, but not its gradient: by it a pixel learns what a sample would bring.
            own = noisy - jax.lax.stop_gradient(noisy)
            noisy = fill_holes(noisy, sampled) + jnp.where(sampled, 0.0, own)
        return measure_frame(noisy, frame.depth, frame), PreparedFrame(frame, noisy, hit)

    def step(
        params: Params, state: jax.Array, prepared: PreparedFrame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        frame, noisy, hit = prepared
        size = frame.radiance.shape[:2]
        history, absent, invalid = warp_history(options, state[..., :3], frame, first)
        guides = _guides(options, frame, statistics)
        history, absent = pad(history, MULTIPLE), pad(absent, MULTIPLE)
        if hit is not None:
            history = fill_holes(history, pad(hit[..., None], MULTIPLE))
        gain = statistics.exposure if options.exposure == "measured" else 1.0
        light = color.compress(gain * noisy)
        features = [light, guides["albedo"], guides["normal"], guides["depth"], color.compress(gain * history)]
        if flagged:
            features.append(absent.astype(noisy.dtype))
        if materials:
            features += [guides["reflectance"], guides["roughness"]]
        features += [None if feature is None else pad(feature, MULTIPLE) for feature in extra.of(frame)]
        if memory:
            features.append(pad(warp_memory(options, state[..., 3:], frame, first), MULTIPLE))
        predicted = predict(params, features, noisy.dtype)
        full, kept = jnp.split(predicted[0], [kernels[0]], axis=-1)
        predicted = [full, *predicted[1:]]

        if direct:
            image = color.expand(predicted[0]) / gain
        else:
            prior = guided_features(params["guide"] if guided else {}, guides)
            image = blend(options, predicted, prior, noisy, history, absent)
        image = jnp.clip(crop(image, size), 0.0, RADIANCE_MAX)
        shown = image if hit is None else jnp.where(hit[..., None], image, fill_background(frame, hit))
        state = jnp.concatenate([image, crop(jnp.tanh(kept), size)], axis=-1) if memory else image
        return state, shown, invalid

    field = graph.receptive_field_radius(graph.unet(1, heads, widths=widths, head_size=3)) + _FILTERS_FIELD
    return Core(start, step, reads, init, prepare=prepare, receptive_field=field)


_FILTERS_FIELD = 32
"""That of kernels of 5x5 pixels at three scales, of the images between these, and of blocks that are filled."""
