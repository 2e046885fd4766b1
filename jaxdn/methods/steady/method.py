"""``steady``, a denoiser of our own: an edge-stopping recurrent filter whose every decision a small network makes.

For each frame: divide by what surfaces reflect; fetch the history with a test of every tap; blend the noisy frame into
a running mean whose effective number of samples is known per pixel; filter the mean by affinities, one or two levels at
full resolution and four at half, each reaching twice as far as the one before (:mod:`jaxdn.methods.steady.levels`);
add again what that removed where light follows the guides (:mod:`jaxdn.methods.steady.regression`); add the change of
the light that the mean lacks (:mod:`jaxdn.methods.steady.lighting_change`); suppress fireflies;
blend the result with the last output.

What a hand-made filter leaves to constants, a U-Net at half resolution decides for every pixel: learned features that
stop the filter beside albedo, gloss, normal and depth; how far a pixel is trusted (a firefly is not); how fast both
histories follow; the weight of each level and of the regression. What it predicts before training is plausible, so that
training begins from a filter and not from noise.

The filter is variance-guided filtering without its variance (Schied et al. 2017), with affinities of learned features
(Isik et al. 2021) and a recurrent network's view of noisy frame, mean and last output (Zeng et al. 2021).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, depth_feature, guides_of
from jaxdn.methods.demodulation import Demodulation, demodulated, find_texture_left
from jaxdn.methods.registry import method
from jaxdn.methods.steady.accumulation import (
    CHANNELS,
    DARK,
    History,
    assemble_network_input,
    suppress_fireflies,
    update_history,
    update_mean,
)
from jaxdn.methods.steady.levels import (
    BLOCKS,
    LEVELS,
    PredictedParameters,
    Surfaces,
    compute_inverse_depth,
    filter_light,
    receptive_field,
    surfaces_of,
)
from jaxdn.methods.steady.regression import SCALES
from jaxdn.networks import Widths, graph
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.scales import crop, downsample, fill_holes, join_planes, pad, to_planes, upsample
from jaxdn.recipes.objectives import pyramid_illumination
from jaxdn.recipes.recipe import FINISH, Recipe

FEATURES, HALF_FEATURES = 5, 8
"""Learned features at full and at half resolution."""
_MULTIPLE = 16
"""Height and width that the network works on, at half resolution, are multiples of this."""


class Quality(NamedTuple):
    """What one pays for."""

    widths: Widths
    """Channels of the U-Net's convolutions, from half resolution down."""
    full_levels: int = 2
    """Levels of the filter at full resolution, taps 1, 2 ... pixels apart."""
    regression: bool = True
    """What the filter removed where light follows the guides is estimated by regression, and a share is added again."""
    lighting_change: bool = True
    """A change of the light that the mean lacks is added in the frame that shows it."""


QUALITIES = {
    "high": Quality(((48,), (64,), (80,), (96,), (96,))),
    "balanced": Quality(((32,), (48,), (64,), (64,), (64,))),
    "fast": Quality(((16,), (24,), (32,), (32,), (32,)), full_levels=1, regression=False, lighting_change=False),
}

INITIAL = {"trust": 4.0, "accumulation": 0.0, "output": 0.0, "coarse": 4.0, "feedback": -4.0}
"""Parameters of every pixel, one logit each, and what they are before training: how far its light is trusted; the
weight of the new frame in the mean, and of the new image in the last output; the weight of the levels at half
resolution; the weight of the filtered light in the mean."""
_SPLITS = np.cumsum([4 * FEATURES, 4 * len(INITIAL), HALF_FEATURES]).tolist()
"""Channels of the head from which on it says something else."""
FILLED_SAMPLES = 0.1
"""Effective number of samples of light that is that of neighbours."""
_LEVEL_WEIGHT, _REGRESSION_WEIGHT = 4.0, 3.0
"""Initial logits of the weights of each level at half resolution, and of the regression."""
PRECISIONS = {"albedo": 1.0, "gloss": 2.0, "normal": 1.0, "depth": 6.0, "learned": 0.0}
"""Guide of the filter -> the logarithm of its precision before training."""


@dataclass(frozen=True)
class Options:
    """The network's size and what it does not decide."""

    quality: Literal["fast", "balanced", "high"] | Widths = "balanced"
    """By name, or the network's widths as tuples, with the filter of ``"balanced"``."""
    history_max: Annotated[float, Range(1)] = 32.0
    """Largest effective number of samples of the running mean, in frames."""
    demodulate: Demodulation = "brdf"
    """What radiance is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`."""
    implementation: Literal["reference", "onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"] | None = None
    """Backend of the U-Net: XLA, or on CPUs oneDNN in bfloat16 or float32 or ONNX Runtime (inference) or oneDNN
    (training). None is XLA."""


class SteadyState(NamedTuple):
    """What is carried from one frame to the next."""

    history: jax.Array
    """[H, W, 8] running mean of the radiance (3) and of its luminance's square, effective number of samples, last
    output (3)."""
    guides: Guides
    """Depth, normal and ids of the previous frame, as far as present."""


@method(
    Options,
    title="A steady recurrent filter guided by a network at half resolution",
    recipes={"usual": Recipe(pyramid_illumination()), "finish": FINISH},
    variants={f"steady-{quality}": {"quality": quality} for quality in QUALITIES},
    backends=("onednn-bfloat16", "onednn-float32", "onnxruntime", "onednn"),
    sparse=True,
)
def steady(options: Options) -> Denoiser:
    """The denoiser.

    Reads albedo, normal, roughness, depth, previous_depth, motion, ids and sample_count, and reflectance with
    ``demodulate="brdf"``; without a buffer, what it would guide or test is left out. Pixels without a surface (depth at
    ``FAR`` or id -1) pass through; those without samples have the light of their history, or else of their neighbours.
    Raises ValueError for an unknown option, and ``step`` for a frame of the wrong shape, never for its contents.
    """
    # Flax is imported only when a network is built: filters without weights need only jax and numpy.
    from jaxdn.networks.unet import unet

    quality = QUALITIES[options.quality] if isinstance(options.quality, str) else Quality(options.quality)
    heads = (4 * (FEATURES + len(INITIAL)) + HALF_FEATURES + 1 + LEVELS + quality.regression,)
    network = unet(
        (4 * 8 + CHANNELS,), heads, widths=quality.widths, head_size=1, implementation=options.implementation
    )
    reads = frozenset({"albedo", "normal", "roughness", "depth", "previous_depth", "motion", "ids", "sample_count"})

    def init(key: jax.Array, frame: Frame) -> Params:
        params = network.init(key)
        pixel = [0.0] * FEATURES + list(INITIAL.values())
        bias = [value for value in pixel for _ in range(4)] + [0.0] * HALF_FEATURES
        bias += [INITIAL["trust"]] + [_LEVEL_WEIGHT] * LEVELS + [_REGRESSION_WEIGHT] * quality.regression
        precisions: Params = {name: jnp.full((1 + LEVELS,), value, jnp.float32) for name, value in PRECISIONS.items()}
        if quality.regression:
            precisions["regression"] = jax.tree.map(jnp.float32, SCALES)
        return {**params, "head_0": {**params["head_0"], "bias": jnp.asarray(bias, jnp.float32)}, "guide": precisions}

    def start(params: Params, frame: Frame) -> SteadyState:
        nothing = jnp.zeros((*frame.radiance.shape[:2], 8), frame.radiance.dtype)
        return SteadyState(nothing, jax.tree.map(jnp.zeros_like, guides_of(frame)))

    def step(
        params: Params, state: SteadyState, prepared: PreparedFrame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[SteadyState, jax.Array, jax.Array]:
        frame, surfaces, known, noisy = prepared
        size, hit = frame.radiance.shape[:2], surfaces.hit
        history = reproject(state.history, state.guides, frame, first)
        past = History(pad(history.history, BLOCKS), pad(history.valid, BLOCKS)[..., 0])
        # What was not measured is as it was: no light would be taken for a lamp that is switched off.
        unmeasured = hit & ~known
        noisy = jnp.where((unmeasured & past.valid)[..., None], past.values[..., :3], noisy)
        weights = {name: part for name, part in params.items() if name != "guide"}
        head = network.apply(weights, [_network_input(noisy, past, surfaces, statistics)[None]])[0][0]
        parameters, shares = split_heads(head, (hit.shape[0] // 2, hit.shape[1] // 2))
        follow = jnp.where(unmeasured, 0.0, shares["accumulation"])
        mean = update_mean(noisy, past, hit, follow, most=options.history_max)
        guessed = unmeasured & ~past.valid
        mean = mean._replace(sample_count=jnp.where(guessed, FILLED_SAMPLES, mean.sample_count))
        texture = find_texture_left(frame, options.demodulate, statistics)
        texture = None if texture is None else fill_holes(pad(texture, BLOCKS), hit[..., None])
        residual = mean.residual if quality.lighting_change else None
        geometry = surfaces, compute_inverse_depth(surfaces, statistics)
        floor = DARK / statistics.exposure
        filtered = filter_light(
            params["guide"], mean.light, residual, texture, *geometry, parameters, quality.full_levels, floor
        )
        filtered = filtered._replace(image=suppress_fireflies(filtered.image, hit, mean))
        values = update_history(mean, filtered, past, shares["feedback"], shares["output"], most=RADIANCE_MAX)
        values = crop(values, size)
        image = jnp.where(crop(hit, size)[..., None], values[..., 5:], frame.radiance)
        return SteadyState(values, guides_of(frame)), image, history.invalid

    network_field = 2 * graph.receptive_field_radius(graph.unet(1, heads, widths=quality.widths, head_size=1))
    filter_field = receptive_field(
        quality.full_levels, with_regression=quality.regression, with_lighting_change=quality.lighting_change
    )
    core = Core(start, step, reads, init, prepare=prepare, requires_validity_mask=True)
    core = core._replace(receptive_field=network_field + filter_field)
    return demodulated(recurrent(core), by=options.demodulate)


class PreparedFrame(NamedTuple):
    """A frame, and what its statistics and its step both need of it; arrays are padded."""

    frame: Frame
    surfaces: Surfaces
    known: jax.Array
    """[H, W] bool, there is a surface whose light was measured."""
    noisy: jax.Array
    """[H, W, 3] the light; where it is not known, that of known pixels near by."""


def prepare(frame: Frame) -> tuple[FrameStatistics, PreparedFrame]:
    """The statistics of a frame's known light, and the frame with its surfaces."""
    surfaces = surfaces_of(frame)
    known = surfaces.hit
    if frame.sample_count is not None:
        known = known & pad(frame.sample_count > 0, BLOCKS)[..., 0]
    # Divided by a small reflectance it may be beyond what the network has ever seen.
    noisy = fill_holes(pad(jnp.minimum(frame.radiance, RADIANCE_MAX), BLOCKS), known[..., None])
    return measure_frame(noisy, surfaces.depth, frame), PreparedFrame(frame, surfaces, known, noisy)


def _network_input(noisy: jax.Array, past: History, surfaces: Surfaces, statistics: FrameStatistics) -> jax.Array:
    """The network's input: light at one brightness (:func:`jaxdn.color.exposure`), and depth of any unit."""
    depth = surfaces.depth
    feature = jnp.zeros_like(noisy[..., :1]) if depth is None else depth_feature(depth, statistics.mean_depth)
    geometry = surfaces.albedo, surfaces.normal, feature, surfaces.roughness
    return assemble_network_input(geometry, noisy, past, surfaces.hit, statistics.exposure, multiple=_MULTIPLE)


def split_heads(head: jax.Array, size: tuple[int, int]) -> tuple[PredictedParameters, dict[str, jax.Array]]:
    """The network's output for as many blocks: parameters of the filter, and the shares [H, W] of :data:`INITIAL`."""
    features, planes, half_features, (half_trust, *weights) = _split_planes(head, size=size)
    shares = dict(zip(INITIAL, planes, strict=True))
    # A pixel whose share knows of its own noise, follows bright samples more: its mean becomes too bright.
    shares["accumulation"] = upsample(downsample(shares["accumulation"][..., None]))[..., 0]
    regression_weight = weights.pop() if len(weights) > LEVELS else None
    parameters = PredictedParameters(
        features, shares["trust"], shares["coarse"], half_features, half_trust, weights, regression_weight
    )
    return parameters, shares


_Split = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Features [H/2, W/2, 4F], shares of all pixels [len(INITIAL), H, W], features and shares [.., H/2, W/2] of blocks."""


@operation(name="split_heads")
def _split_planes(head: jax.Array, *, size: tuple[int, int]) -> _Split:
    """The network's output at half resolution [h, w, C], cropped, as the parts that the filter reads."""
    # Splits, not slices: the gradient of a slice is an array of the whole size, and all of them are added.
    own, logits, half, rest = jnp.split(crop(head, size), _SPLITS, axis=-1)
    # Before they are unfolded, while they lie side by side in memory.
    return own, join_planes([("blocks", jax.nn.sigmoid(logits))]), half, to_planes(jax.nn.sigmoid(rest))


@numba_call.implements(_split_planes)
def _split_planes_by_numba(head: jax.Array, *, size: tuple[int, int]) -> _Split:
    from jaxdn.methods.steady.numba_kernels import split_heads

    (height, width), (first, _, last) = size, _SPLITS
    shapes = [(*size, first), (len(INITIAL), 2 * height, 2 * width), (*size, HALF_FEATURES)]
    shapes.append((head.shape[-1] - last, height, width))
    own, planes, half, rest = numba_call.call(split_heads, shapes, [head], rows=height)
    return own, planes, half, rest


@_split_planes.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    channels = int(_SPLITS[-1]) + 1 + LEVELS + 1
    yield Example(
        (3 * rng.normal(size=(height + -height % 16, width + -width % 16, channels)),), {"size": (height, width)}
    )
