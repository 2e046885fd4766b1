"""The U-Net that predicts kernels, and its backends.

Flax NNX is used only inside this module. Its results are plain nested dicts of arrays and two pure functions, so that
no other module depends on Flax.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxdn.core.checks import check_option
from jaxdn.networks import LARGE, LEVELS, MULTIPLE, Widths, graph, onednn, onnx
from jaxdn.networks.graph import FEATURES, GraphSpec, Weights, evaluate
from jaxdn.ops.convolution.api import convolve
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.onednn import library


class Network(NamedTuple):
    """Two pure functions."""

    init: Callable[[jax.Array], dict[str, Any]]
    """key -> params, nested dicts of float32 arrays."""
    apply: Callable[[dict[str, Any], Sequence[jax.Array | None]], tuple[jax.Array, ...]]
    """(params, feature groups [N, H, W, c] or None) -> heads at full, half and quarter resolution."""


class XlaLayers(NamedTuple):
    """The layers in XLA (:class:`jaxdn.networks.graph.LayerBackend`), on arrays [N, H, W, C]."""

    convolve: Callable[[jax.Array, jax.Array], jax.Array]
    """Of an image with a 3x3 kernel."""
    multiple: int
    """The number of output channels is padded to a multiple of this."""

    def convolution(self, inputs: Sequence[jax.Array], kernels: Sequence[jax.Array], bias: jax.Array) -> jax.Array:
        dtype, outputs = inputs[0].dtype, bias.shape[0]
        if kernels[0].shape[0] == 1:
            parts = [x @ kernel[0, 0].astype(dtype) for x, kernel in zip(inputs, kernels, strict=True)]
        else:
            spare = ((0, 0), (0, 0), (0, 0), (0, -outputs % self.multiple))
            padded = [jnp.pad(kernel, spare).astype(dtype) for kernel in kernels]
            parts = [self.convolve(x, kernel) for x, kernel in zip(inputs, padded, strict=True)]
        # A sum of convolutions equals the convolution of the concatenated parts, and concatenating costs more.
        total = functools.reduce(jnp.add, parts)
        return total[..., :outputs] + jnp.reshape(bias.astype(dtype), (1, 1, 1, -1))

    def rectifier(self, x: jax.Array, slope: float) -> jax.Array:
        return jnp.where(x >= 0, x, slope * x)

    def pool(self, x: jax.Array) -> jax.Array:
        # Four strided views: 3.6 times as fast on XLA:CPU as reshape and reduce.
        corners = [x[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]
        return jnp.maximum(jnp.maximum(corners[0], corners[1]), jnp.maximum(corners[2], corners[3]))

    def upsample(self, x: jax.Array) -> jax.Array:
        n, height, width, channels = x.shape
        blocks = jnp.broadcast_to(x[:, :, None, :, None, :], (n, height, 2, width, 2, channels))
        return jnp.reshape(blocks, (n, 2 * height, 2 * width, channels))


XLA = XlaLayers(convolve, 16)  # 51 outputs take XLA:CPU 1.4 times as long as 64
ONEDNN = XlaLayers(functools.partial(convolve, implementation="onednn"), 1)


class Convolution(nnx.Module):
    """One convolution's weights."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.kernel = nnx.Param(jnp.zeros(shape, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(shape[-1], jnp.float32))


Kernels = tuple[tuple[str, tuple[int, ...]], ...]
"""Names and shapes, as :meth:`jaxdn.networks.graph.GraphSpec.kernels` has them."""


class Convolutions(nnx.Module):
    """The weights of a described network: a convolution ``a/b`` is the attribute ``b`` of the attribute ``a``."""

    def __init__(self, kernels: Kernels) -> None:
        for name, shape in kernels:
            level, _, layer = name.rpartition("/")
            if level and not hasattr(self, level):
                setattr(self, level, nnx.Module())
            setattr(getattr(self, level) if level else self, layer, Convolution(shape))

    def weights(self, names: Iterable[str]) -> dict[str, Any]:
        """:data:`jaxdn.networks.graph.Weights`, by the names of the convolutions."""
        found: dict[str, Any] = {name: functools.reduce(getattr, name.split("/"), self) for name in names}
        return {name: {"kernel": one.kernel[...], "bias": one.bias[...]} for name, one in found.items()}


def draw_initial_weights(key: jax.Array, network: GraphSpec, *, scheme: str) -> dict[str, Any]:
    """Kernels uniform within +-limit, biases zero.

    ``scheme``: with "he" the limit is ``sqrt(6 / fan_in)``, so that signals keep their size through the rectifiers (He
    et al. 2015), and a tenth of ``sqrt(3 / fan_in)`` in the heads, so that every kernel begins nearly flat; with
    "xavier" it is ``sqrt(6 / (fan_in + fan_out))`` (Glorot and Bengio 2010), with which each convolution halves the
    signal's variance: the deep levels begin with gradients two orders of magnitude smaller and hardly learn.
    """
    check_option(scheme, "initialization", ("he", "xavier"))
    limits: dict[str, tuple[tuple[int, ...], float]] = {}
    for name, shape in sorted(network.kernels().items()):
        area, inputs, outputs = shape[0] * shape[1], *shape[2:]
        he = 0.1 * math.sqrt(3 / (area * inputs)) if name in network.outputs else math.sqrt(6 / (area * inputs))
        limits[name] = shape, he if scheme == "he" else math.sqrt(6 / (area * (inputs + outputs)))
    params: dict[str, Any] = {}
    for name, kernel in zip(limits, _draw_kernels(key, tuple(limits.values())), strict=True):
        level, _, layer = name.rpartition("/")
        place = params.setdefault(level, {}) if level else params
        place[layer] = {"bias": jnp.zeros(kernel.shape[-1], jnp.float32), "kernel": kernel}
    return params


@functools.partial(jax.jit, static_argnames="limits")
def _draw_kernels(key: jax.Array, limits: tuple[tuple[tuple[int, ...], float], ...]) -> list[jax.Array]:
    """A kernel for each (shape, limit), uniform within +-limit.

    All are slices of one draw: with a generator for each, XLA takes twenty seconds to compile. One program: with one
    for each operation on each kernel, a second.
    """
    sizes = [math.prod(shape) for shape, _ in limits]
    draw = jax.random.uniform(key, (sum(sizes),), jnp.float32, -1, 1)
    parts = jnp.split(draw, np.cumsum(sizes)[:-1])
    return [limit * jnp.reshape(part, shape) for part, (shape, limit) in zip(parts, limits, strict=True)]


Heads = tuple[jax.Array, ...]


@operation(name="unet")
def run_unet(weights: Weights, groups: list[jax.Array], *, network: GraphSpec) -> Heads:
    """The heads of the network for the feature groups [N, H, W, c] that are present; XLA alone."""
    return evaluate(network, weights, {FEATURES: jnp.concatenate(groups, axis=-1)}, XLA)


@run_unet.implementation("onednn", dtypes=(jnp.float32,), unavailable=library.unavailable)
def _run_with_onednn_convolutions(weights: Weights, groups: list[jax.Array], *, network: GraphSpec) -> Heads:
    """XLA with oneDNN's convolutions and their gradients: for training on CPUs."""
    return evaluate(network, weights, {FEATURES: jnp.concatenate(groups, axis=-1)}, ONEDNN)


_INFERENCE: Any = {"dtypes": (jnp.float32,), "differentiable": False}


@run_unet.implementation("onednn-float32", **_INFERENCE, unavailable=library.unavailable)
def _run_in_float32(weights: Weights, groups: list[jax.Array], *, network: GraphSpec) -> Heads:
    """The whole network in oneDNN."""
    return onednn.run(network, weights, groups, precision=onednn.FLOAT32)


@run_unet.implementation(
    "onednn-bfloat16", **_INFERENCE, unavailable=onednn.unavailable_in_bfloat16, precision=jnp.bfloat16
)
def _run_in_bfloat16(weights: Weights, groups: list[jax.Array], *, network: GraphSpec) -> Heads:
    """The same in bfloat16."""
    return onednn.run(network, weights, groups, precision=onednn.BFLOAT16)


@run_unet.implementation("onnxruntime", **_INFERENCE, unavailable=onnx.unavailable)
def _run_by_onnxruntime(weights: Weights, groups: list[jax.Array], *, network: GraphSpec) -> Heads:
    """The whole network in ONNX Runtime."""
    return onnx.run(network, weights, groups)


def unet(
    groups: Sequence[int],
    heads: Sequence[int],
    *,
    widths: Widths = LARGE,
    head_size: Literal[1, 3] = 3,
    initialization: str = "he",
    implementation: str | None = None,
) -> Network:
    """A U-Net as ``init(key) -> params`` and ``apply(params, features) -> heads``.

    ``groups`` are the channel counts of the feature groups; ``apply`` takes one array ``[N, H, W, c]`` for each, or
    ``None`` where it is absent, which equals an array of zeros but skips its part of the first convolution: the shapes
    of ``params`` never depend on it. H and W are multiples of 16. ``heads`` are the channel counts at full, half and
    quarter resolution; their outputs are raw (logits), by convolutions of ``head_size``. ``widths`` gives the channels
    of each convolution of each of the five levels; the decoder mirrors the first four. ``initialization``: see
    :func:`draw_initial_weights`. Computes in the features' dtype. ``implementation``: None or "reference" (XLA),
    "onednn-bfloat16", "onednn-float32" or "onnxruntime" (inference, see :mod:`jaxdn.networks.onednn` and
    :mod:`jaxdn.networks.onnx`) or "onednn" (convolutions and their gradients, see
    :mod:`jaxdn.ops.convolution.onednn`). Raises ValueError when ``widths`` is not five non-empty levels of positive
    integers, the features do not fit, or the implementation cannot run here.
    """
    if implementation is not None:
        run_unet.named(implementation)
    widths = tuple(tuple(level) for level in widths)
    if len(widths) != LEVELS or not all(level and all(channels > 0 for channels in level) for level in widths):
        raise ValueError(
            f"widths: expected {LEVELS} levels, each a non-empty tuple of channel counts, got {widths!r}; "
            "see jaxdn.networks.unet.LARGE."
        )

    def described(channels: int) -> GraphSpec:
        return graph.unet(channels, heads, widths=widths, head_size=head_size)

    structure = flax_structure(tuple(described(sum(groups)).kernels().items()))

    def init(key: jax.Array) -> dict[str, Any]:
        return draw_initial_weights(key, described(sum(groups)), scheme=initialization)

    def apply(params: dict[str, Any], features: Sequence[jax.Array | None]) -> tuple[jax.Array, ...]:
        present = select_groups(features, groups, MULTIPLE)
        network = described(sum(group.shape[-1] for group in present))
        weights = select_weights(network, structure, params, features, groups)
        return run_unet(weights, present, network=network, implementation=implementation)

    return Network(init, apply)


@functools.cache
def flax_structure(kernels: Kernels) -> Any:
    """How Flax stores the weights of a network; made once, as a denoiser is built several times until it is chosen."""
    return nnx.split(nnx.eval_shape(lambda: Convolutions(kernels)), nnx.Param, graph=False)[0]


def select_groups(features: Sequence[jax.Array | None], groups: Sequence[int], multiple: int) -> list[jax.Array]:
    """The feature groups that are there. Raises ValueError unless they fit ``groups`` and the sizes ``multiple``."""
    present = [group for group in features if group is not None]
    fits = len(features) == len(groups) and all(
        group is None or group.shape == (*present[0].shape[:3], channels)
        for group, channels in zip(features, groups, strict=False)
    )
    if not (present and fits) or any(size % multiple for size in present[0].shape[1:3]):
        got = [None if group is None else group.shape for group in features]
        raise ValueError(
            f"features: expected [N, H, W, c] or None with c = {tuple(groups)}, H and W multiples of {multiple}, "
            f"got shapes {got}; pad by the edge and crop the result."
        )
    return present


def select_weights(
    network: GraphSpec,
    structure: Any,
    params: dict[str, Any],
    features: Sequence[jax.Array | None],
    groups: Sequence[int],
) -> dict[str, Any]:
    """The weights of a network that sees only the groups which are there, out of those for all groups.

    Raises ValueError for ``params`` of another network.
    """
    layers = {name.partition("/")[0] for name in network.kernels()}
    if set(params) != layers:
        raise ValueError(
            f"params: expected the layers {', '.join(sorted(layers))}, got {', '.join(sorted(params)) or 'none'}; "
            "pass what init or load_weights gives."
        )
    weights = nnx.merge(structure, params).weights(network.kernels())
    if any(group is None for group in features):
        first = next(iter(weights))
        parts = jnp.split(weights[first]["kernel"], list(itertools.accumulate(groups))[:-1], axis=2)
        used = [part for part, group in zip(parts, features, strict=True) if group is not None]
        weights[first] = {**weights[first], "kernel": jnp.concatenate(used, axis=2)}
    return weights


def draw_weights(rng: np.random.Generator, network: GraphSpec) -> Weights:
    """Weights of a network with which signals keep their size."""
    return {
        name: {"kernel": rng.normal(size=shape) / math.sqrt(math.prod(shape[:3])), "bias": rng.normal(size=shape[3])}
        for name, shape in network.kernels().items()
    }


@run_unet.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + -height % MULTIPLE, width + -width % MULTIPLE
    network = graph.unet(5, (3, 2), widths=((4,), (6,), (4,), (4,), (4,)), head_size=1)
    groups = [rng.normal(size=(1, height, width, channels)) for channels in (3, 2)]
    yield Example((draw_weights(rng, network), groups), {"network": network})
