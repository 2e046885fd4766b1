"""A network as data: named layers, written once; XLA and ONNX are made from them by :func:`evaluate`."""

from collections.abc import Mapping, Sequence
from itertools import accumulate, count, takewhile
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from jaxdn.networks import LEVELS, Widths

NEGATIVE_SLOPE = 0.01
RECURRENT_SLOPE = 0.1
"""Of the recurrent autoencoder."""
FEATURES = "features"
"""What a network sees, which only convolutions read: a backend may add channels to it."""

Value = TypeVar("Value")
Weights = Mapping[str, Mapping[str, Any]]
"""Name of a convolution -> its "kernel" and "bias"."""


class Layer(NamedTuple):
    """A layer; its result is [N, H >> depth, W >> depth, channels]."""

    kind: Literal["input", "convolution", "rectifier", "pool", "upsample"]
    inputs: tuple[str, ...]
    """The layers that it reads; a convolution reads several as if they were joined, channel after channel."""
    channels: int
    depth: int
    size: int = 0
    """Height and width of a convolution's kernel."""
    slope: float = NEGATIVE_SLOPE
    """A rectifier's, of negative values."""


class GraphSpec(NamedTuple):
    """Layers by name, each after those that it reads, and the names of the outputs."""

    layers: dict[str, Layer]
    outputs: tuple[str, ...]

    def kernels(self) -> dict[str, tuple[int, ...]]:
        """Name -> [size, size, inputs, outputs] of every convolution's kernel."""
        return {
            name: (layer.size, layer.size, sum(self.layers[each].channels for each in layer.inputs), layer.channels)
            for name, layer in self.layers.items()
            if layer.kind == "convolution"
        }


def output_shapes(network: GraphSpec, shape: Sequence[int]) -> list[tuple[int, ...]]:
    """Of the outputs [N, H >> depth, W >> depth, channels], for features of ``shape`` [N, H, W, c]."""
    ends = [network.layers[name] for name in network.outputs]
    return [(shape[0], shape[1] >> end.depth, shape[2] >> end.depth, end.channels) for end in ends]


def receptive_field_radius(network: GraphSpec) -> int:
    """How many pixels away the outputs see, on each side, at the resolution of the input."""
    found: dict[str, int] = {}
    for name, layer in network.layers.items():
        # An upsampled pixel is one of a block, which sees around the whole block; a pooled one is its block.
        own = {"convolution": layer.size // 2, "upsample": 1}.get(layer.kind, 0) << layer.depth
        found[name] = own + max((found[each] for each in layer.inputs), default=0)
    return max(found[name] for name in network.outputs)


def same_weights(new: Sequence[np.ndarray], old: Sequence[np.ndarray]) -> bool:
    """Whether two lists of arrays are equal, bit for bit: backends keep what they made for the weights of a call."""
    return len(new) == len(old) and all(
        np.array_equal(one.view(np.int32), other.view(np.int32)) for one, other in zip(new, old, strict=True)
    )


class LayerBackend(Protocol[Value]):
    """A backend: what it does for each kind of layer. Its values are arrays, or the names of what will be arrays."""

    def convolution(self, inputs: Sequence[Value], kernels: Sequence[Any], bias: Any) -> Value:
        """The sum of the inputs' convolutions, each with its part of the kernel: stride 1, zeros outside."""

    def rectifier(self, x: Value, slope: float) -> Value:
        """LeakyReLU: negative values times ``slope``."""

    def pool(self, x: Value) -> Value:
        """The maximum of each 2x2 block."""

    def upsample(self, x: Value) -> Value:
        """Every pixel repeated 2x2 times."""


def evaluate(
    network: GraphSpec, weights: Weights, inputs: Mapping[str, Value], backend: LayerBackend[Value]
) -> tuple[Value, ...]:
    """The outputs for the values of all inputs, layer by layer."""
    values = dict(inputs)
    for name, layer in network.layers.items():
        read = [values[each] for each in layer.inputs]
        if layer.kind == "convolution":
            kernel, bias = weights[name]["kernel"], weights[name]["bias"]
            ends = list(accumulate(network.layers[each].channels for each in layer.inputs))
            kernels = [kernel[:, :, first:last] for first, last in zip([0, *ends], ends, strict=False)]
            values[name] = backend.convolution(read, kernels, bias)
        elif layer.kind == "rectifier":
            values[name] = backend.rectifier(read[0], layer.slope)
        elif layer.kind != "input":
            values[name] = getattr(backend, layer.kind)(*read)
    return tuple(values[name] for name in network.outputs)


class _GraphBuilder:
    """A description in the making."""

    def __init__(self, inputs: int) -> None:
        self.layers = {FEATURES: Layer("input", (), inputs, 0)}

    def add(self, name: str, kind: Any, *read: str, channels: int = 0, size: int = 0, **more: Any) -> str:
        """A layer that reads others; its name."""
        below = self.layers[read[0]]
        depth = below.depth + {"pool": 1, "upsample": -1}.get(kind, 0)
        self.layers[name] = Layer(kind, read, channels or below.channels, depth, size, **more)
        return name

    def level(self, name: str, widths: Sequence[int], *read: str, first: int = 0, slope: float = NEGATIVE_SLOPE) -> str:
        """3x3 convolutions, numbered from ``first`` on, each with its rectifier; the name of the last layer."""
        for index, channels in enumerate(widths, first):
            convolved = self.add(f"{name}/convolution_{index}", "convolution", *read, channels=channels, size=3)
            read = (self.add(f"{name}/rectifier_{index}", "rectifier", convolved, slope=slope),)
        return read[0]


def unet(inputs: int, heads: Sequence[int], *, widths: Widths, head_size: Literal[1, 3]) -> GraphSpec:
    """The U-Net: five resolution levels, heads on the last decoder levels, from full resolution down.

    Architecture (Zeng et al. 2021, sec. 4.3 and fig. 6, after Hasselgren et al. 2020): 3x3 convolutions, LeakyReLU, 2x2
    max-pooling down, nearest upsampling and skip concatenation up. Widths are in figures alone.
    """
    builder = _GraphBuilder(inputs)
    skips = [builder.level("encoder_0", widths[0], FEATURES)]
    for depth in range(1, LEVELS):
        skips.append(builder.level(f"encoder_{depth}", widths[depth], builder.add(f"pool_{depth}", "pool", skips[-1])))
    x = skips.pop()
    for depth in reversed(range(LEVELS - 1)):
        x = builder.level(
            f"decoder_{depth}", widths[depth], builder.add(f"upsample_{depth}", "upsample", x), skips[depth]
        )
        if depth < len(heads):
            builder.add(f"head_{depth}", "convolution", x, channels=heads[depth], size=head_size)
    return GraphSpec(builder.layers, tuple(f"head_{depth}" for depth in range(len(heads))))


def recurrent_unet(inputs: int, outputs: int, *, widths: Widths) -> GraphSpec:
    """The recurrent autoencoder: a U-Net whose encoder remembers (Chaitanya et al. 2017, sec. 3.2 and fig. 4).

    ``widths``: first the channels of each encoder stage, from full resolution down; then the channels of each decoder
    level's convolutions, from coarse to full resolution. A stage is a convolution x and a recurrent block: a
    convolution of x, one of its result and the stage's hidden state together, and one more, whose result is the stage's
    output and its hidden state in the next frame. The inputs ``hidden_K`` are the states of the stages; outputs are the
    head "output", then the stages' new states.
    """
    builder = _GraphBuilder(inputs)
    stages, decoder = widths[0], widths[1:]
    states: list[str] = []
    for depth, channels in enumerate(stages):
        below = builder.add(f"pool_{depth}", "pool", states[-1]) if depth else FEATURES
        builder.layers[hidden(depth)] = Layer("input", (), channels, depth)
        name, slope = f"encoder_{depth}", RECURRENT_SLOPE
        block = builder.level(name, (channels, channels), below, slope=slope)
        states.append(builder.level(name, (channels, channels), block, hidden(depth), first=2, slope=slope))
    x = states[-1]
    for level, depth in zip(decoder, reversed(range(len(decoder))), strict=True):
        larger = builder.add(f"upsample_{depth}", "upsample", x)
        x = builder.level(f"decoder_{depth}", level, larger, states[depth], slope=RECURRENT_SLOPE)
    head = builder.add("output", "convolution", x, channels=outputs, size=3)
    return GraphSpec(builder.layers, (head, *states))


def find_graph(kernels: Mapping[str, tuple[int, ...]]) -> GraphSpec | None:
    """The U-Net or the recurrent autoencoder whose :meth:`GraphSpec.kernels` these are; None if neither has them."""
    if any(len(shape) != 4 for shape in kernels.values()):
        return None

    def numbered(name: str) -> list[str]:
        return list(takewhile(kernels.__contains__, (f"{name}{index}" for index in count())))

    def widths(level: str) -> tuple[int, ...]:
        return tuple(kernels[name][3] for name in numbered(f"{level}/convolution_"))

    encoder = tuple(takewhile(bool, (widths(f"encoder_{depth}") for depth in count())))
    heads = [kernels[name] for name in numbered("head_")]
    found = None
    if encoder and "output" in kernels:
        decoder = [widths(f"decoder_{depth}") for depth in reversed(range(len(encoder) - 1))]
        stages = tuple(stage[0] for stage in encoder)
        found = recurrent_unet(kernels["encoder_0/convolution_0"][2], kernels["output"][3], widths=(stages, *decoder))
    elif len(encoder) == LEVELS and heads:
        size: Any = heads[0][0]
        outputs = [head[3] for head in heads]
        found = unet(kernels["encoder_0/convolution_0"][2], outputs, widths=encoder, head_size=size)
    return found if found is not None and found.kernels() == dict(kernels) else None


def hidden(stage: int) -> str:
    """The name of the input that is the hidden state of an encoder stage."""
    return f"hidden_{stage}"
