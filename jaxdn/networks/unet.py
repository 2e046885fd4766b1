"""The U-Net that predicts kernels: five resolution levels, heads on the last three decoder levels.

Flax NNX is used only inside this module. Its results are plain nested dicts of arrays and two pure functions, so that
optimisers, checkpoints and users never see its types.

Architecture (Zeng et al. 2021, sec. 4.3 and fig. 6, after Hasselgren et al. 2020): 3x3 convolutions, LeakyReLU, 2x2
max-pooling down, nearest upsampling and skip concatenation up. The papers give no widths; :data:`LARGE` is our choice
for "about 850,000 weights".
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from jaxdn.checks import check_option
from jaxdn.denoiser import Params
from jaxdn.networks import LARGE, LEVELS, MULTIPLE, Widths, onnx
from jaxdn.ops import onednn
from jaxdn.ops.convolution import convolve
from jaxdn.ops.registry import register, resolve

NEGATIVE_SLOPE = 0.01


class Network(NamedTuple):
    """Two pure functions."""

    init: Callable[[jax.Array], dict[str, Any]]
    """key -> params, nested dicts of float32 arrays."""
    apply: Callable[[dict[str, Any], Sequence[jax.Array | None]], tuple[jax.Array, ...]]
    """(params, feature groups [N, H, W, c] or None) -> heads at full, half and quarter resolution."""


Part = tuple[jax.Array, Sequence[slice] | None]
"""An input of a convolution and the slices of the kernel's input channels that it consists of (None: all of them)."""


class Convolver(NamedTuple):
    """An implementation of the convolutions."""

    convolve: Callable[[jax.Array, jax.Array], jax.Array]
    multiple: int
    """The number of output channels is padded to a multiple of this."""


XLA = Convolver(convolve, 16)  # 51 outputs take XLA:CPU 1.4 times as long as 64
ONEDNN = Convolver(functools.partial(convolve, implementation="onednn"), 1)


class Convolution(nnx.Module):
    """A 3x3 convolution with bias, zeros beyond the border; of size 1 a map of each pixel's channels."""

    def __init__(self, inputs: int, outputs: int, size: Literal[1, 3] = 3) -> None:
        self.kernel = nnx.Param(jnp.zeros((size, size, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros((outputs,), jnp.float32))

    def __call__(self, convolver: Convolver, *parts: Part) -> jax.Array:
        kernel, dtype = self.kernel[...], parts[0][0].dtype
        outputs = kernel.shape[-1]
        if kernel.shape[0] == 1:
            ((x, _),) = parts
            return x @ kernel[0, 0].astype(dtype) + jnp.reshape(self.bias[...].astype(dtype), (1, 1, 1, -1))
        kernel = jnp.pad(kernel, ((0, 0), (0, 0), (0, 0), (0, -outputs % convolver.multiple))).astype(dtype)

        def share(used: Sequence[slice] | None) -> jax.Array:
            return kernel if used is None else jnp.concatenate([kernel[:, :, channels] for channels in used], axis=2)

        # A sum of convolutions equals the convolution of the concatenated parts, and concatenating costs more.
        total = functools.reduce(jnp.add, [convolver.convolve(x, share(used)) for x, used in parts])
        return total[..., :outputs] + jnp.reshape(self.bias[...].astype(dtype), (1, 1, 1, -1))


class Level(nnx.Module):
    """The convolutions of one resolution level, each followed by a LeakyReLU."""

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        self.count = len(widths)
        for index, (before, after) in enumerate(zip((inputs, *widths), widths, strict=False)):
            setattr(self, f"convolution_{index}", Convolution(before, after))

    def __call__(self, convolver: Convolver, *parts: Part) -> jax.Array:
        for index in range(self.count):
            x = getattr(self, f"convolution_{index}")(convolver, *parts)
            x = jnp.where(x >= 0, x, NEGATIVE_SLOPE * x)
            parts = ((x, None),)
        return x


def pool(x: jax.Array) -> jax.Array:
    """The maximum of each 2x2 block: [N, H, W, C] -> [N, H/2, W/2, C]."""
    # Four strided views: 3.6 times as fast on XLA:CPU as reshape and reduce.
    corners = [x[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]
    return jnp.maximum(jnp.maximum(corners[0], corners[1]), jnp.maximum(corners[2], corners[3]))


def enlarge(x: jax.Array) -> jax.Array:
    """Repeat every pixel 2x2 times: [N, H, W, C] -> [N, 2H, 2W, C]."""
    n, height, width, channels = x.shape
    blocks = jnp.broadcast_to(x[:, :, None, :, None, :], (n, height, 2, width, 2, channels))
    return jnp.reshape(blocks, (n, 2 * height, 2 * width, channels))


class UNet(nnx.Module):
    """Encoder, decoder and three heads; called with features and their slices of the first kernel."""

    def __init__(self, inputs: int, heads: Sequence[int], widths: Widths, head_size: Literal[1, 3]) -> None:
        self.heads = len(heads)
        for level, channels in enumerate(widths):
            setattr(self, f"encoder_{level}", Level(inputs, channels))
            inputs = channels[-1]
        for level in reversed(range(LEVELS - 1)):
            setattr(self, f"decoder_{level}", Level(inputs + widths[level][-1], widths[level]))
            inputs = widths[level][-1]
        for level, outputs in enumerate(heads):
            setattr(self, f"head_{level}", Convolution(widths[level][-1], outputs, head_size))

    def __call__(
        self, convolver: Convolver, features: jax.Array, used: Sequence[slice] | None
    ) -> tuple[jax.Array, ...]:
        part: Part = (features, used)
        skips: list[jax.Array] = []
        for level in range(LEVELS):
            if level:
                part = (pool(skips[-1]), None)
            skips.append(getattr(self, f"encoder_{level}")(convolver, part))
        x = skips.pop()
        outputs: list[jax.Array] = []
        for level in reversed(range(LEVELS - 1)):
            below = x.shape[-1]
            parts = (enlarge(x), [slice(0, below)]), (skips[level], [slice(below, None)])
            x = getattr(self, f"decoder_{level}")(convolver, *parts)
            if level < self.heads:
                outputs.insert(0, getattr(self, f"head_{level}")(convolver, (x, None)))
        return tuple(outputs)


def initial(key: jax.Array, shapes: dict[str, Any], *, scheme: str) -> dict[str, Any]:
    """Kernels uniform within +-limit, biases zero.

    ``scheme``: with "he" the limit is ``sqrt(6 / fan_in)``, so that signals keep their size through the rectifiers (He
    et al. 2015), and a tenth of ``sqrt(3 / fan_in)`` in the heads, so that every kernel begins nearly flat; with
    "xavier" it is ``sqrt(6 / (fan_in + fan_out))`` (Glorot and Bengio 2010), with which each convolution halves the
    signal's variance: the deep levels begin with gradients two orders of magnitude smaller and hardly learn.

    All kernels are slices of one draw: with a generator for each, XLA takes twenty seconds to compile.
    """
    check_option(scheme, "initialization", ("he", "xavier"))
    named, tree = jax.tree_util.tree_flatten_with_path(shapes)
    leaves = [leaf for _, leaf in named]
    draw = jax.random.uniform(
        key, (sum(math.prod(leaf.shape) for leaf in leaves if leaf.ndim == 4),), jnp.float32, -1, 1
    )
    params, start = [], 0
    for path, leaf in named:
        if leaf.ndim < 4:
            params.append(jnp.zeros(leaf.shape, leaf.dtype))
            continue
        size = math.prod(leaf.shape)
        area, (inputs, outputs) = math.prod(leaf.shape[:2]), leaf.shape[2:]
        head = jax.tree_util.keystr(path[:1]).startswith("['head_")
        he = 0.1 * math.sqrt(3 / (area * inputs)) if head else math.sqrt(6 / (area * inputs))
        limit = he if scheme == "he" else math.sqrt(6 / (area * (inputs + outputs)))
        params.append(limit * jnp.reshape(draw[start : start + size], leaf.shape))
        start += size
    return jax.tree.unflatten(tree, params)


@register("unet", "reference")
def reference(network: Callable[[Convolver], onnx.Apply], heads: int, used: Sequence[slice] | None) -> onnx.Apply:
    """The network as XLA compiles it."""
    return network(XLA)


@register("unet", "onednn", requires=onednn.check_available)
def convolved_by_onednn(
    network: Callable[[Convolver], onnx.Apply], heads: int, used: Sequence[slice] | None
) -> onnx.Apply:
    """XLA with oneDNN's convolutions and their gradients: for training on CPUs."""
    return network(ONEDNN)


@register("unet", "onnxruntime", requires=onnx.check_available)
def run_by_onnxruntime(
    network: Callable[[Convolver], onnx.Apply], heads: int, used: Sequence[slice] | None
) -> onnx.Apply:
    """The whole network in ONNX Runtime, for inference; the gradient is XLA's."""
    return onnx.engine(network(XLA), heads=heads, slope=NEGATIVE_SLOPE, used=used)


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
    of ``params`` never depend on it. H and W are multiples of 16. ``heads`` are the channel counts at full,
    half and quarter resolution; their outputs are raw (logits), by convolutions of ``head_size``. ``widths`` gives the
    channels of each convolution of each of the five levels; the decoder mirrors the first four. ``initialization``: see
    :func:`initial`. Computes in the features' dtype. ``implementation``: None or "reference" (XLA), "onnxruntime"
    (inference, see :mod:`jaxdn.networks.onnx`) or "onednn" (convolutions and their gradients, see
    :mod:`jaxdn.ops.onednn`). Raises ValueError when ``widths`` is not five non-empty levels of positive integers, the
    features do not fit, or the implementation cannot run here.
    """
    run = resolve("unet", implementation)
    widths = tuple(tuple(level) for level in widths)
    if len(widths) != LEVELS or not all(level and all(channels > 0 for channels in level) for level in widths):
        raise ValueError(
            f"widths: expected {LEVELS} levels, each a non-empty tuple of channel counts, got {widths!r}; "
            "see jaxdn.networks.unet.LARGE."
        )

    abstract = nnx.eval_shape(lambda: UNet(sum(groups), heads, widths, head_size))
    graph, state = nnx.split(abstract, nnx.Param, graph=False)
    shapes = nnx.to_pure_dict(state)

    def init(key: jax.Array) -> dict[str, Any]:
        return initial(key, shapes, scheme=initialization)

    def apply(params: dict[str, Any], features: Sequence[jax.Array | None]) -> tuple[jax.Array, ...]:
        present = [group for group in features if group is not None]
        fits = len(features) == len(groups) and all(
            group is None or group.shape == (*present[0].shape[:3], channels)
            for group, channels in zip(features, groups, strict=False)
        )
        if not (present and fits) or any(size % MULTIPLE for size in present[0].shape[1:3]):
            got = [None if group is None else group.shape for group in features]
            raise ValueError(
                f"features: expected [N, H, W, c] or None with c = {tuple(groups)}, H and W multiples of {MULTIPLE}, "
                f"got shapes {got}; pad by the edge and crop the result."
            )
        used, start = [], 0
        for channels, group in zip(groups, features, strict=True):
            if group is not None:
                used.append(slice(start, start + channels))
            start += channels
        parts = used if len(used) < len(groups) else None

        def network(convolver: Convolver) -> onnx.Apply:
            return lambda params, present: nnx.merge(graph, params)(convolver, jnp.concatenate(present, axis=-1), parts)

        return run(network, len(heads), parts)(params, present)

    return Network(init, apply)


def count(params: Params) -> int:
    """The number of weights in ``params``."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
