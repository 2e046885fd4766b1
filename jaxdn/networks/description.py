"""A network as data: named layers, written once; XLA and ONNX are made from them by :func:`evaluate`."""

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

from jaxdn.networks import LEVELS, Widths

NEGATIVE_SLOPE = 0.01
FEATURES = "features"
"""The network's input, which only convolutions read: an engine may add channels to it."""

Value = TypeVar("Value")
Weights = Mapping[str, Mapping[str, Any]]
"""Name of a convolution -> its "kernel" and "bias"."""


class Layer(NamedTuple):
    """A layer; its result is [N, H >> depth, W >> depth, channels]."""

    kind: Literal["input", "convolution", "rectifier", "pool", "enlarge"]
    inputs: tuple[str, ...]
    """The layers that it reads; a convolution reads several as if they were joined, channel after channel."""
    channels: int
    depth: int
    size: int = 0
    """Height and width of a convolution's kernel."""


class Description(NamedTuple):
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


class Operations(Protocol[Value]):
    """An engine: what it does for each kind of layer. Its values are arrays, or the names of what will be arrays."""

    def convolution(self, inputs: Sequence[Value], kernels: Sequence[Any], bias: Any) -> Value:
        """The sum of the inputs' convolutions, each with its part of the kernel: stride 1, zeros outside."""

    def rectifier(self, x: Value) -> Value:
        """LeakyReLU of :data:`NEGATIVE_SLOPE`."""

    def pool(self, x: Value) -> Value:
        """The maximum of each 2x2 block."""

    def enlarge(self, x: Value) -> Value:
        """Every pixel repeated 2x2 times."""


def evaluate(
    network: Description, weights: Weights, features: Value, operations: Operations[Value]
) -> tuple[Value, ...]:
    """The outputs for ``features``, layer by layer."""
    values = {FEATURES: features}
    for name, layer in network.layers.items():
        inputs = [values[each] for each in layer.inputs]
        if layer.kind == "convolution":
            kernel, bias = weights[name]["kernel"], weights[name]["bias"]
            ends = list(accumulate(network.layers[each].channels for each in layer.inputs))
            kernels = [kernel[:, :, first:last] for first, last in zip([0, *ends], ends, strict=False)]
            values[name] = operations.convolution(inputs, kernels, bias)
        elif layer.kind != "input":
            values[name] = getattr(operations, layer.kind)(*inputs)
    return tuple(values[name] for name in network.outputs)


def unet(inputs: int, heads: Sequence[int], *, widths: Widths, head_size: Literal[1, 3]) -> Description:
    """The U-Net: five resolution levels, heads on the last decoder levels, from full resolution down.

    Architecture (Zeng et al. 2021, sec. 4.3 and fig. 6, after Hasselgren et al. 2020): 3x3 convolutions, LeakyReLU, 2x2
    max-pooling down, nearest upsampling and skip concatenation up. The papers give no widths.
    """
    layers = {FEATURES: Layer("input", (), inputs, 0)}

    def add(name: str, kind: Any, *read: str, channels: int = 0, size: int = 0) -> str:
        below = layers[read[0]]
        depth = below.depth + {"pool": 1, "enlarge": -1}.get(kind, 0)
        layers[name] = Layer(kind, read, channels or below.channels, depth, size)
        return name

    def level(name: str, widths: Sequence[int], *read: str) -> str:
        for index, channels in enumerate(widths):
            convolved = add(f"{name}/convolution_{index}", "convolution", *read, channels=channels, size=3)
            read = (add(f"{name}/rectifier_{index}", "rectifier", convolved),)
        return read[0]

    skips = [level("encoder_0", widths[0], FEATURES)]
    for depth in range(1, LEVELS):
        skips.append(level(f"encoder_{depth}", widths[depth], add(f"pool_{depth}", "pool", skips[-1])))
    x = skips.pop()
    for depth in reversed(range(LEVELS - 1)):
        x = level(f"decoder_{depth}", widths[depth], add(f"enlarge_{depth}", "enlarge", x), skips[depth])
        if depth < len(heads):
            add(f"head_{depth}", "convolution", x, channels=heads[depth], size=head_size)
    return Description(layers, tuple(f"head_{depth}" for depth in range(len(heads))))
