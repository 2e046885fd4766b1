"""``steady``, a denoiser of our own: an edge-stopping recurrent filter whose every decision a small network makes.

For each frame: divide by what surfaces reflect; fetch the history with a test of every tap; blend the noisy frame into
a running mean whose effective number of samples is known per pixel; filter the mean by affinities, one or two levels at
full resolution and four at half, each reaching twice as far as the one before (:mod:`jaxdn.methods.steady.levels`);
give back what that took away where light follows the guides (:mod:`jaxdn.methods.steady.regression`); add what the mean
lacks of a change of light (:mod:`jaxdn.methods.steady.lighting_change`); take single bright pixels away; blend the
result with the last output.

What a hand-made filter leaves to constants, a U-Net at half resolution decides for every pixel: learned features that
stop the filter beside albedo, gloss, normal and depth; how far a pixel can be trusted (a firefly is not); how fast both
histories follow; how much of each level is taken, and given back. Its first decisions are plausible ones, so that
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
from jaxdn.methods.demodulation import Demodulation, demodulated, texture_left
from jaxdn.methods.registry import method
from jaxdn.methods.steady import regression
from jaxdn.methods.steady.accumulation import accumulated, remembered
from jaxdn.methods.steady.fireflies import dimmed
from jaxdn.methods.steady.levels import BLOCKS, LEVELS, Decisions, Surfaces, filtered, reach, slanted, surfaces_of
from jaxdn.methods.steady.network_input import CHANNELS, DARK, History, seen
from jaxdn.networks import Widths, crop, graph, pad
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.layout.planar import join_planes, to_planes
from jaxdn.ops.scales import downsample, fill_holes, upsample
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
    back: bool = True
    """What the filter took away where light follows the guides is found by regression, and a share is given back."""
    at_once: bool = True
    """What the mean lacks of a change of light is added in the frame that shows it."""


QUALITIES = {
    "high": Quality(((48,), (64,), (80,), (96,), (96,))),
    "balanced": Quality(((32,), (48,), (64,), (64,), (64,))),
    "fast": Quality(((16,), (24,), (32,), (32,), (32,)), full_levels=1, back=False, at_once=False),
}

BEGIN = {"trust": 4.0, "follow": 0.0, "blend": 0.0, "coarse": 4.0, "feedback": -4.0}
"""Decisions for every pixel, one logit each, and what they are before training."""
_PLACES = np.cumsum([4 * FEATURES, 4 * len(BEGIN), HALF_FEATURES]).tolist()
"""Channels of the head from which on it says something else."""
_TAKE, _BACK = 4.0, 3.0
"""The same for how much of each level at half resolution is taken, and of what the filter took away is given back."""
PRECISIONS = {"albedo": 1.0, "gloss": 2.0, "normal": 1.0, "depth": 6.0, "learned": 0.0}
"""Guide of the filter -> the logarithm of its precision before training."""


@dataclass(frozen=True)
class Options:
    """The network's size and what it does not decide."""

    quality: Literal["fast", "balanced", "high"] | Widths = "balanced"
    """By name, or the network's widths as tuples, with the filter of ``"balanced"``."""
    history_max: Annotated[float, Range(1)] = 32.0
    """Largest effective number of samples of the running mean, in frames."""
    demodulate: Demodulation | bool = "brdf"
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
)
def steady(options: Options) -> Denoiser:
    """The denoiser.

    Reads reflectance, albedo, normal, roughness, depth, previous_depth, motion and ids; without a buffer, what it would
    guide or test is left out. Pixels without a surface (depth at ``FAR`` or id -1) pass through. Raises ValueError for
    an unknown option, and ``step`` for a frame of the wrong shape, never for its contents.
    """
    # Flax is imported only when a network is built: filters without weights need only jax and numpy.
    from jaxdn.networks.unet import unet

    quality = QUALITIES[options.quality] if isinstance(options.quality, str) else Quality(options.quality)
    heads = (4 * (FEATURES + len(BEGIN)) + HALF_FEATURES + 1 + LEVELS + quality.back,)
    network = unet(
        (4 * 8 + CHANNELS,), heads, widths=quality.widths, head_size=1, implementation=options.implementation
    )
    reads = frozenset({"albedo", "normal", "roughness", "depth", "previous_depth", "motion", "ids"})

    def init(key: jax.Array, frame: Frame) -> Params:
        params = network.init(key)
        pixel = [0.0] * FEATURES + list(BEGIN.values())
        bias = [value for value in pixel for _ in range(4)] + [0.0] * HALF_FEATURES
        bias += [BEGIN["trust"]] + [_TAKE] * LEVELS + [_BACK] * quality.back
        precisions: Params = {name: jnp.full((1 + LEVELS,), value, jnp.float32) for name, value in PRECISIONS.items()}
        if quality.back:
            precisions["regression"] = jax.tree.map(jnp.float32, regression.SCALES)
        return {**params, "head_0": {**params["head_0"], "bias": jnp.asarray(bias, jnp.float32)}, "guide": precisions}

    def start(params: Params, frame: Frame) -> SteadyState:
        nothing = jnp.zeros((*frame.radiance.shape[:2], 8), frame.radiance.dtype)
        return SteadyState(nothing, jax.tree.map(jnp.zeros_like, guides_of(frame)))

    def step(
        params: Params, state: SteadyState, frame: Frame, first: jax.Array, whole: FrameStatistics
    ) -> tuple[SteadyState, jax.Array, jax.Array]:
        size = frame.radiance.shape[:2]
        recalled = reproject(state.history, state.guides, frame, first)
        surfaces = surfaces_of(frame)
        past = History(pad(recalled.history, BLOCKS), pad(recalled.valid, BLOCKS)[..., 0])
        hit, known = surfaces.hit, _known(frame, surfaces)
        # What was not measured is as it was: no light would be taken for a lamp that is switched off.
        lost = hit & ~known & past.valid
        noisy = jnp.where(lost[..., None], past.values[..., :3], _noisy(frame, known))
        weights = {name: part for name, part in params.items() if name != "guide"}
        head = network.apply(weights, [_seen(noisy, past, surfaces, whole)[None]])[0][0]
        decided, shares = decisions(head, (hit.shape[0] // 2, hit.shape[1] // 2))
        mean = accumulated(noisy, past, hit, shares["follow"], most=options.history_max)
        texture = texture_left(frame, options.demodulate, whole)
        texture = None if texture is None else fill_holes(pad(texture, BLOCKS), hit[..., None])
        given = mean.light, mean.missed if quality.at_once else None, texture, surfaces, slanted(surfaces, whole)
        found = filtered(params["guide"], *given, decided, quality.full_levels, DARK / whole.exposure)
        found = found._replace(image=dimmed(found.image, hit, mean))
        kept = remembered(mean, found, past, shares["feedback"], shares["blend"], most=RADIANCE_MAX)
        history = crop(kept, size)
        image = jnp.where(crop(hit, size)[..., None], history[..., 5:], frame.radiance)
        return SteadyState(history, guides_of(frame)), image, recalled.invalid

    def measure(frame: Frame) -> FrameStatistics:
        surfaces = surfaces_of(frame)
        return measure_frame(_noisy(frame, _known(frame, surfaces)), surfaces.depth, frame)

    network_sees = 2 * graph.receptive_field_radius(graph.unet(1, heads, widths=quality.widths, head_size=1))
    far = reach(quality.full_levels, back=quality.back, at_once=quality.at_once)
    core = Core(start, step, reads, init, measure=measure, reach=network_sees + far, counted=True)
    return demodulated(recurrent(core), by=options.demodulate)


def _known(frame: Frame, surfaces: Surfaces) -> jax.Array:
    """[H, W] bool, there is a surface whose light was measured."""
    if frame.sample_count is None:
        return surfaces.hit
    return surfaces.hit & pad(frame.sample_count > 0, BLOCKS)[..., 0]


def _noisy(frame: Frame, known: jax.Array) -> jax.Array:
    # Divided by a small reflectance it may be beyond what the network has ever seen.
    return fill_holes(pad(jnp.minimum(frame.radiance, RADIANCE_MAX), BLOCKS), known[..., None])


def _seen(noisy: jax.Array, past: History, surfaces: Surfaces, whole: FrameStatistics) -> jax.Array:
    """What the network sees: light at one brightness (:func:`jaxdn.color.exposure`), and depth of any unit."""
    depth = surfaces.depth
    closeness = jnp.zeros_like(noisy[..., :1]) if depth is None else depth_feature(depth, middle=whole.mean_depth)
    geometry = surfaces.albedo, surfaces.normal, closeness, surfaces.roughness
    return seen(geometry, noisy, past, surfaces.hit, whole.exposure, multiple=_MULTIPLE)


def decisions(head: jax.Array, size: tuple[int, int]) -> tuple[Decisions, dict[str, jax.Array]]:
    """What the head says about as many blocks: about the filter, and the shares [H, W] in [0, 1] of :data:`BEGIN`."""
    own, planes, half, (trust, *take) = _apart(head, size=size)
    shares = dict(zip(BEGIN, planes, strict=True))
    # A pixel whose share knows of its own noise, follows bright samples more: its mean becomes too bright.
    shares["follow"] = upsample(downsample(shares["follow"][..., None]))[..., 0]
    back = take.pop() if len(take) > LEVELS else None
    return Decisions(own, shares["trust"], shares["coarse"], half, trust, take, back), shares


_Apart = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Features [H/2, W/2, 4F], shares of all pixels [len(BEGIN), H, W], features and shares [.., H/2, W/2] of blocks."""


@operation(name="split_decisions")
def _apart(head: jax.Array, *, size: tuple[int, int]) -> _Apart:
    # Splits, not slices: the gradient of a slice is an array of the whole size, and all of them are added.
    own, logits, half, rest = jnp.split(crop(head, size), _PLACES, axis=-1)
    # Before they are unfolded, while they lie side by side in memory.
    return own, join_planes([("blocks", jax.nn.sigmoid(logits))]), half, to_planes(jax.nn.sigmoid(rest))


@numba_call.implements(_apart)
def _apart_by_numba(head: jax.Array, *, size: tuple[int, int]) -> _Apart:
    from jaxdn.methods.steady.numba_heads import decided

    (height, width), (first, _, last) = size, _PLACES
    shapes = [(*size, first), (len(BEGIN), 2 * height, 2 * width), (*size, HALF_FEATURES)]
    shapes.append((head.shape[-1] - last, height, width))
    own, planes, half, rest = numba_call.call(decided, shapes, [head], rows=height)
    return own, planes, half, rest


@_apart.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    channels = int(_PLACES[-1]) + 1 + LEVELS + 1
    yield Example(
        (3 * rng.normal(size=(height + -height % 16, width + -width % 16, channels)),), {"size": (height, width)}
    )
