"""``combiner``: Open Image Denoise, and what the samples and earlier frames know better, mixed pixel by pixel.

For each frame: the library denoises it alone (the *prior*); the noisy frame, the prior and the guides are blended into
running means along motion (:mod:`jaxdn.methods.combiner.history`); affinities filter the means of noisy light and of
the prior's images (:mod:`jaxdn.methods.combiner.candidates`). The image is a mean of four candidates: the prior, the
prior with the correction that filtered samples tell of, the mean of priors, and the last result. With ``prefilter`` the
library denoises each frame twice, the second time with guides that it denoises first, and the prior is the mean of
both.

A U-Net at half resolution decides for every pixel how fast the means follow, the filter's features and how far a pixel
is trusted. A second, smaller one sees the candidates and what noisy light says about each, and decides their weights
(:mod:`jaxdn.methods.combiner.choice`). What both predict before training is plausible: mostly the mean of priors and
the last result.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.filters.sharp_history import TAPS
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods.combiner import choice
from jaxdn.methods.combiner.candidates import (
    CANDIDATES,
    FilterParameters,
    make_candidates,
    receptive_field,
)
from jaxdn.methods.combiner.history import (
    CombinerState,
    Means,
    Past,
    fetch_past,
    keep_history,
    measure_now,
    start_history,
    update_means,
)
from jaxdn.methods.oidn import oidn
from jaxdn.methods.registry import method
from jaxdn.networks import Widths, graph
from jaxdn.ops import oidn as binding
from jaxdn.ops.scales import crop, fill_holes, join_pixels, pad, to_planes, upsample
from jaxdn.recipes.augmentation import Augmentation
from jaxdn.recipes.objectives import squared_illumination
from jaxdn.recipes.recipe import Recipe

WIDTHS: dict[str, Widths] = {
    "high": ((32,), (48,), (64,), (64,), (64,)),
    "fast": ((16,), (24,), (32,), (32,), (32,)),
}
"""Channels of the U-Net's convolutions, from half resolution down."""
CHOICE_WIDTHS: dict[str, Widths] = {"high": ((32,),) * 5, "fast": ((16,),) * 5}
"""Channels of the second network."""
FEATURES = 5
"""Learned features."""
INITIAL = {"trust": 4.0, "follow": 0.0}
"""What else is decided everywhere, one logit each, and what they are before training: how far its light is trusted; the
share of the new frame in the means."""
PRECISIONS = {"albedo": 1.0, "normal": 1.0, "light": 4.0, "depth": 6.0, "learned": 0.0}
"""Guide of the filter -> the logarithm of its precision before training."""
_MULTIPLE, _BLOCKS = 16, 4
"""What height and width are multiples of: of the network's input, at half resolution; of the filter's planes."""
_DARK = 1e-3
"""Light at the network's brightness that is as good as dark."""
_LEAST_ALBEDO = 0.03
"""Added to the albedo before light is divided by it."""
INPUTS = {"geometry": 32, "light": 20, "prior": 11}
"""Groups of the network's input channels."""

if TYPE_CHECKING:
    from jaxdn.networks.unet import Network

_Planes = TypeVar("_Planes", jax.Array, Means)


@dataclass(frozen=True)
class Options:
    """The network's size and what it does not decide."""

    quality: Literal["fast", "high"] | Widths = "high"
    """By name, or the first network's widths as tuples; the second is then that of ``"high"``."""
    prefilter: bool = False
    """The prior is the mean of two images of Open Image Denoise: the second has guides that the library denoises first,
    as Blender has it do by default. Both take five times as long as one."""
    history_max: Annotated[float, Range(1)] = 32.0
    """Largest effective number of samples of the running means, in frames."""
    device: binding.Device = "auto"
    """Where Open Image Denoise computes: ``"auto"`` is an NVIDIA GPU if it can use one, else the CPU."""
    implementation: Literal["reference", "onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"] | None = None
    """Backend of the U-Net: XLA, or on CPUs oneDNN in bfloat16 or float32 or ONNX Runtime (inference) or oneDNN
    (training). None is XLA."""


RECIPE = Recipe(
    squared_illumination(),
    steps=4000,
    learning_rate=6e-4,
    decay=False,
    batch=2,
    crop=128,
    frames=8,
    average=0.995,
    spp=(1, 4, 16),
    variation=Augmentation(shadow=0.1),
)
"""A constant rate and a running mean of the weights: a run can be stopped and continued at any time."""


@method(
    Options,
    title="A network that combines Open Image Denoise with samples and history",
    recipes={"usual": RECIPE},
    variants={
        "combiner-best": {"quality": "high", "prefilter": True},
        "combiner-high": {"quality": "high"},
        "combiner-fast": {"quality": "fast"},
    },
    backends=("onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"),
    requires=binding.MODULE,
    differentiable=False,
)
def combiner(options: Options) -> Denoiser:
    """The denoiser, of all light.

    Reads albedo, normal, roughness, depth, previous_depth, motion and ids; without a buffer, what it would guide or
    test is left out. Trained by gradients of its weights; the prior has none, so the image has no gradient by the
    frame. Raises ModuleNotFoundError where ``pyoidn`` is missing, when a step is traced; ValueError for an unknown
    option, and ``step`` for a frame of the wrong shape, never for its contents.
    """
    chooser = build_chooser(options)
    find = build_candidate_step(options)
    network, network_shape = _build_network(options)
    reads = frozenset({"albedo", "normal", "roughness", "depth", "previous_depth", "motion", "ids"})

    def init(key: jax.Array, frame: Frame) -> Params:
        params = network.init(key)
        chosen = choice.begin(chooser.init(jax.random.fold_in(key, 1)))
        block = [0.0] * FEATURES + list(INITIAL.values())
        precisions = {name: jnp.full((1,), value, jnp.float32) for name, value in PRECISIONS.items()}
        head = {**params["head_0"], "bias": jnp.asarray(block, jnp.float32)}
        return {**params, "head_0": head, "guide": precisions, "choice": chosen}

    def start(params: Params, frame: Frame) -> CombinerState:
        return start_history(frame)

    def step(
        params: Params, state: CombinerState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[CombinerState, jax.Array, jax.Array]:
        found, invalid = find(params, state, frame, first, statistics)
        image = mix_candidates(chooser, params["choice"], found, statistics.exposure)
        image = jnp.clip(crop_planes(image, frame.radiance.shape[:2]), 0.0, RADIANCE_MAX)
        means = crop_planes(found.means, frame.radiance.shape[:2])
        return keep_history(frame, means, image), image.transpose(1, 2, 0), invalid

    fields = [2 * graph.receptive_field_radius(shape) for shape in (network_shape, _chooser_shape(options))]
    fields += [max(prior.receptive_field or 0 for prior in _priors(options)), TAPS]
    fields += [receptive_field(), choice.RECEPTIVE_FIELD]
    core = Core(start, step, reads, init, prepare=prepare, requires_validity_mask=True)
    return recurrent(core._replace(receptive_field=sum(fields)))


class Found(NamedTuple):
    """What there is to choose from in one frame; its sides are padded to multiples of 4."""

    candidates: list[jax.Array]
    """[3, H, W] each, in the order of :data:`jaxdn.methods.combiner.candidates.CANDIDATES`, linear radiance."""
    noisy: jax.Array
    """[3, H, W] the new frame's light."""
    means: Means
    """With the new frame in them."""


CandidateStep = Callable[[Params, CombinerState, Frame, jax.Array, FrameStatistics], tuple[Found, jax.Array]]
"""(params, state, prepared frame, is it the first, statistics) -> what was found, invalid pixels of the state."""


def build_candidate_step(options: Options) -> CandidateStep:
    """The first part of a step: all but the choice among the candidates."""
    network, _ = _build_network(options)
    priors = [core_of(prior) for prior in _priors(options)]

    def find(
        params: Params, state: CombinerState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[Found, jax.Array]:
        size = frame.radiance.shape[:2]
        alone = [
            to_planes(jnp.clip(core.step({}, (), frame, first, statistics)[1], 0.0, RADIANCE_MAX)) for core in priors
        ]
        equal = jnp.full((len(alone), 1, 1), 1.0 / len(alone), frame.radiance.dtype)
        prior = _mix(equal, alone, statistics.exposure) if options.prefilter else alone[0]
        now = measure_now(frame, jax.lax.stop_gradient(prior))
        past = fetch_past(state, frame, now, first)
        weights = {name: part for name, part in params.items() if name not in ("guide", "choice")}
        inputs = _assemble_network_input(frame, now, past, statistics)
        head = network.apply(weights, [group[None] for group in inputs])[0][0]
        parameters, follow = split_head(head, tuple(side + -side % _BLOCKS for side in size))
        means = update_means(now, past, crop_planes(follow, size), most=options.history_max)
        depth = None if frame.depth is None else pad(frame.depth, _BLOCKS)
        wide = pad_planes(means)
        images = wide, pad_planes(now.prior), pad_planes(past.result)
        candidates = make_candidates(params["guide"], *images, depth, parameters, statistics)
        return Found(candidates, pad_planes(now.light), wide), past.invalid

    return find


def mix_candidates(chooser: "Network", params: Params, found: Found, gain: jax.Array) -> jax.Array:
    """[3, H, W] the candidates, mixed as the second network with ``params`` decides; ``gain`` is the exposure."""
    guides = found.means.albedo, found.means.normal, found.means.number
    evidence = choice.assemble_evidence(found.candidates, found.noisy, *guides, gain)
    _, height, width = found.noisy.shape
    head = chooser.apply(params, [group[None] for group in evidence])[0][0]
    return _mix(choice.split_shares(head, (height, width)), found.candidates, gain)


def build_chooser(options: Options) -> "Network":
    """The second network."""
    # Flax is imported only when a network is built: filters without weights need only jax and numpy.
    from jaxdn.networks.unet import unet

    widths, heads = CHOICE_WIDTHS[_quality(options)], (len(CANDIDATES),)
    return unet(choice.count_inputs(), heads, widths=widths, head_size=1, implementation=options.implementation)


def _chooser_shape(options: Options) -> graph.GraphSpec:
    return graph.unet(1, (len(CANDIDATES),), widths=CHOICE_WIDTHS[_quality(options)], head_size=1)


def _priors(options: Options) -> list[Denoiser]:
    """Open Image Denoise, with the frame's guides as they are, and with those that it denoises first."""
    plain = oidn(device=options.device)
    if not options.prefilter:
        return [plain]
    return [plain, oidn(device=options.device, auxiliary="prefiltered", guide_quality="fast")]


def _build_network(options: Options) -> tuple["Network", graph.GraphSpec]:
    """The first network, and its layers."""
    from jaxdn.networks.unet import unet

    widths = WIDTHS[options.quality] if isinstance(options.quality, str) else options.quality
    heads = (FEATURES + len(INITIAL),)
    groups = tuple(INPUTS.values())
    network = unet(groups, heads, widths=widths, head_size=1, implementation=options.implementation)
    return network, graph.unet(1, heads, widths=widths, head_size=1)


def _quality(options: Options) -> str:
    """The quality by which the second network is chosen."""
    return options.quality if isinstance(options.quality, str) else "high"


def prepare(frame: Frame) -> tuple[FrameStatistics, Frame]:
    """The statistics of a frame's known light, and the frame with that near by where light is not known."""
    size = frame.radiance.shape[:2]
    light = frame.radiance
    if frame.sample_count is not None:
        known = pad(frame.sample_count, _BLOCKS) > 0
        light = crop(fill_holes(pad(light, _BLOCKS), known), size)
    return measure_frame(light, frame.depth, frame), frame._replace(radiance=light)


def _assemble_network_input(
    frame: Frame, now: Means, past: Past, statistics: FrameStatistics
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The groups of :data:`INPUTS` [h, w, C], by blocks of 2x2 pixels, padded by the edge.

    Surfaces; light divided by the albedo: noisy, the mean and the prior, at one brightness
    (:func:`jaxdn.color.exposure`) and compressed; light as it is: the prior and its mean, and where there is a history.
    """
    gain, like = statistics.exposure, now.light[:1]
    nearness = like * 0 if frame.depth is None else to_planes(depth_feature(frame.depth, statistics.mean_depth))
    roughness = like * 0 if frame.roughness is None else to_planes(frame.roughness) - 1.0
    geometry = now.albedo - 1.0, now.normal, nearness, roughness
    albedo = past.means.albedo + _LEAST_ALBEDO
    divided = [color.compress(gain * light / albedo) for light in (now.light, past.means.light, now.prior)]
    level = color.luminance_of_planes(past.means.light)
    spread = jnp.sqrt(jnp.maximum(past.means.square - level**2, 0.0) + 1e-12) / (level + _DARK / gain)
    count = jnp.where(past.valid, past.means.number, 0.0)
    facts = [jnp.minimum(spread, 8.0) / 8.0, 1.0 / (1.0 + count), jnp.ones_like(level)]
    plain = [color.compress(gain * light) for light in (now.prior, past.means.prior)]
    means = [*divided, *(fact[None] for fact in facts)], [*plain, past.valid[None].astype(like.dtype)]
    levels = [[color.luminance_of_planes(one)[None] for one in lights] for lights in (divided[::2], plain[:1])]

    def join(averaged: Sequence[jax.Array], whole: Sequence[jax.Array]) -> jax.Array:
        parts = [*(("means", each) for each in averaged), *(("blocks", each) for each in whole)]
        return join_pixels(parts, multiple=_MULTIPLE)

    return join([], geometry), join(means[0], levels[0]), join(means[1], levels[1])


def split_head(head: jax.Array, size: Sequence[int]) -> tuple[FilterParameters, jax.Array]:
    """Of the first network's output: the filter's parameters, and the share [H, W] of the new frame.

    All are those of blocks of 2x2 pixels, enlarged. Features and a trust that each pixel of a block has of its own make
    the filter prefer every other pixel, and what it finds a weave. A pixel whose share knows of its own noise, follows
    bright samples more: its mean becomes too bright.
    """
    blocks = crop(head, (size[0] // 2, size[1] // 2))
    planes = to_planes(upsample(blocks[..., : FEATURES + 1]))
    follow = upsample(jax.nn.sigmoid(blocks[..., FEATURES + 1 :]))[..., 0]
    return FilterParameters(planes[:FEATURES], jax.nn.sigmoid(planes[FEATURES])), follow


def _mix(shares: jax.Array, candidates: list[jax.Array], gain: jax.Array) -> jax.Array:
    """[3, H, W] the mean of N images with weights [N, H, W], of log(1 + x) at one brightness.

    In linear light a hundredth of a lamp that is beside the pixel in one candidate outshines what all others show.
    """
    parts = (
        share[None] * jnp.log1p(gain * jnp.maximum(each, 0.0)) for share, each in zip(shares, candidates, strict=True)
    )
    return jnp.expm1(functools.reduce(jnp.add, parts)) / gain


def pad_planes(tree: _Planes) -> _Planes:
    """All planes [..., H, W], padded by the edge to multiples of 4; scalars are left."""

    def one(planes: jax.Array) -> jax.Array:
        if planes.ndim < 2:
            return planes
        below, right = (-side % _BLOCKS for side in planes.shape[-2:])
        wide = [(0, 0)] * (planes.ndim - 2) + [(0, below), (0, right)]
        return jnp.pad(planes, wide, mode="edge") if below or right else planes

    padded: _Planes = jax.tree.map(one, tree)
    return padded


def crop_planes(tree: _Planes, size: Sequence[int]) -> _Planes:
    """The first rows and columns of all planes [..., H, W]."""
    cropped: _Planes = jax.tree.map(lambda planes: planes[..., : size[0], : size[1]], tree)
    return cropped
