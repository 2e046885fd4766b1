"""A trained network as the start of a larger one: the first images are the same, and everything new can learn.

New outputs of a convolution begin at random and nothing reads them yet: what follows has zeros for its new inputs
(function-preserving growth, after Chen et al. 2016, "Net2Net"). A convolution that the smaller network does not have
passes its inputs on. What a convolution reads, and where in its kernel, is told by the network's graph.
"""

import re
from collections import defaultdict

import numpy as np

from jaxdn.networks.graph import FEATURES, NEGATIVE_SLOPE, GraphSpec, Layer, find_graph

Flat = dict[str, np.ndarray]
_NAME = re.compile(r"(.*/)?(?:(?:encoder|decoder)_\d+/convolution_\d+|head_\d+|output)/(?:kernel|bias)")
"""Of weights: what a method puts before the names of one of its networks, then the name in that network."""


def grow(trained: Flat, larger: Flat) -> Flat:
    """The weights ``larger`` with those of smaller networks in their first channels.

    Args:
      trained: name -> array, such as ``encoder_0/convolution_0/kernel`` [3, 3, inputs, outputs], or
        ``sampler/encoder_0/convolution_0/kernel`` where a method has several networks, each under a prefix.
      larger: initial weights of the larger networks, of the same kinds.

    Weights of equal shapes are returned as they are. A layer that is added to a U-Net behind the others of its level
    has the identity for its first channels: its LeakyReLU makes negative values a hundredth, so that images change by
    about as much. A network without a prefix may see more channels, which stand behind the others.

    Raises ValueError where a layer of ``trained`` is not in ``larger`` or is smaller there, for heads with other
    outputs, and for what cannot be added: heads; more inputs of a network under a prefix, as they need not stand behind
    the others; stages and layers of a recurrent network, whose LeakyReLU makes negative values a tenth; anything in a
    network that :func:`jaxdn.networks.graph.find_graph` does not know.
    """
    for name in trained:
        if name not in larger:
            raise ValueError(f"{name} is {trained[name].shape} there and missing in the network to train")
    grown: Flat = {}
    for prefix, initial in _split_networks(larger).items():
        old = {name: trained[prefix + name] for name in initial if prefix + name in trained}
        try:
            found = old if _shapes(old) == _shapes(initial) else _grow_network(old, initial, may_see_more=not prefix)
        except ValueError as error:
            raise ValueError(f"{prefix}{error}") from error
        grown |= {prefix + name: array for name, array in found.items()}
    return grown


def _split_networks(weights: Flat) -> dict[str, Flat]:
    """Prefix, with its slash -> the weights of a network by their names in it."""
    networks: dict[str, Flat] = defaultdict(dict)
    for name, array in weights.items():
        match = _NAME.fullmatch(name)
        prefix = (match[1] or "") if match else ""
        networks[prefix][name.removeprefix(prefix)] = array
    return networks


def _shapes(weights: Flat) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in weights.items()}


def _grow_network(trained: Flat, larger: Flat, *, may_see_more: bool) -> Flat:
    """:func:`grow` of one network; the messages of its errors begin with a name in it."""
    before, after = _graph_of(trained), _graph_of(larger)
    if before is None or after is None:
        first = next(name for name, shape in _shapes(larger).items() if shape != _shapes(trained).get(name))
        raise _difference(first, trained, larger)
    kept: dict[str, int] = {}  # of each layer, how many first channels are those of the trained network
    grown: Flat = {}
    for name, layer in after.layers.items():
        if layer.kind == "convolution":
            old = trained if name in before.layers else _pass_on(name, kept[layer.inputs[0]], after)
            reads = _places(layer, kept, after)
            sees_more = FEATURES in layer.inputs and reads.size < larger[f"{name}/kernel"].shape[2]
            if sees_more and not may_see_more:
                raise _difference(f"{name}/kernel", old, larger)
            grown |= _enlarge(name, old, larger, reads, head=name in after.outputs)
            kept[name] = old[f"{name}/bias"].size
        elif layer.kind == "input":
            kept[name] = before.layers[name].channels if name in before.layers else 0
        else:
            kept[name] = kept[layer.inputs[0]]
    return grown


def _graph_of(weights: Flat) -> GraphSpec | None:
    """The network that has these weights; None if it is none that is known."""
    kernels = {name: array.shape for name, array in weights.items() if name.endswith("/kernel")}
    return find_graph({name.removesuffix("/kernel"): shape for name, shape in kernels.items()})


def _places(layer: Layer, kept: dict[str, int], network: GraphSpec) -> np.ndarray:
    """Where the trained inputs of a convolution are among its inputs: first in each layer that it reads."""
    starts = np.cumsum([0, *(network.layers[each].channels for each in layer.inputs)])
    return np.concatenate([start + np.arange(kept[each]) for start, each in zip(starts, layer.inputs, strict=False)])


def _pass_on(name: str, channels: int, network: GraphSpec) -> Flat:
    """The weights with which an added convolution passes its inputs on. Raises ValueError where none can be added."""
    remembers = any(layer.slope != NEGATIVE_SLOPE for layer in network.layers.values())
    if remembers or name in network.outputs:
        raise ValueError(f"{name} is missing there")
    kernel = np.zeros((3, 3, channels, channels), np.float32)
    kernel[1, 1] = np.eye(channels)
    return {f"{name}/kernel": kernel, f"{name}/bias": np.zeros(channels, np.float32)}


def _enlarge(name: str, trained: Flat, larger: Flat, reads: np.ndarray, *, head: bool) -> Flat:
    """The weights of a convolution with the trained ones for its first outputs, which read the places ``reads``."""
    for part in (f"{name}/bias", f"{name}/kernel"):
        there, here = trained[part].shape, larger[part].shape
        if (
            any(a > b for a, b in zip(there, here, strict=True))
            or there[:-2] != here[:-2]
            or (head and there[-1:] != here[-1:])
        ):
            raise _difference(part, trained, larger)
    bias, kernel = np.zeros_like(larger[f"{name}/bias"]), np.array(larger[f"{name}/kernel"])
    outputs = trained[f"{name}/bias"].size
    bias[:outputs] = trained[f"{name}/bias"]
    kernel[..., :outputs] = 0.0
    kernel[:, :, reads, :outputs] = trained[f"{name}/kernel"]
    return {f"{name}/kernel": kernel, f"{name}/bias": bias}


def _difference(name: str, trained: Flat, larger: Flat) -> ValueError:
    if name not in trained:
        return ValueError(f"{name} is missing there")
    return ValueError(f"{name} is {trained[name].shape} there and {larger[name].shape} in the network to train")
