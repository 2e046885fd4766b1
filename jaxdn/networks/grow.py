"""A trained U-Net as the start of a larger one: the first images are the same, and everything new can learn.

New outputs of a convolution begin at random and nothing reads them yet: what follows has zeros for its new inputs
(function-preserving growth, after Chen et al. 2016, "Net2Net"). A convolution that the smaller network does not have
passes its inputs on.
"""

import numpy as np

from jaxdn.networks import LEVELS

Flat = dict[str, np.ndarray]


def grow(trained: Flat, larger: Flat) -> Flat:
    """The weights ``larger`` with those of a smaller network in their first channels.

    Args:
      trained: name -> array, such as ``encoder_0/convolution_0/kernel`` [3, 3, inputs, outputs].
      larger: initial weights of the larger network, of the same kind.

    A layer that is added behind the others of its level has the identity for its first channels: its LeakyReLU makes
    negative values a hundredth, so that images change by about as much. Raises ValueError where a layer of ``trained``
    is not in ``larger`` or is smaller there, and for heads with other outputs.
    """
    grown = {}
    for name in trained:
        if name not in larger:
            raise ValueError(f"{name} is {trained[name].shape} there and missing in the network to train")
    for name, initial in larger.items():
        layer, part = name.rsplit("/", 1)
        old = trained.get(name)
        if old is None:
            old = _identity(trained, layer) if part == "kernel" else np.zeros(0, np.float32)
        fits = old.ndim == initial.ndim and all(a <= b for a, b in zip(old.shape, initial.shape, strict=True))
        if not fits or (layer.startswith("head_") and old.shape[-1] != initial.shape[-1]):
            raise ValueError(f"{name} is {old.shape} there and {initial.shape} in the network to train")
        new = np.zeros_like(initial) if part == "bias" else np.array(initial)
        if part == "kernel":
            reads = _inputs(trained, larger, layer, old.shape[2])
            new[..., : old.shape[3]] = 0.0
            new[:, :, reads, : old.shape[3]] = old
        else:
            new[tuple(map(slice, old.shape))] = old
        grown[name] = new
    return grown


def _inputs(trained: Flat, larger: Flat, layer: str, count: int) -> np.ndarray:
    """Positions of a trained kernel's ``count`` inputs among those of the larger kernel."""
    level, _, which = layer.partition("/")
    place = np.arange(count)
    if level.startswith("decoder_") and which == "convolution_0":  # reads the level below, then the skip connection
        below = int(level.removeprefix("decoder_")) + 1
        source = f"encoder_{below}" if below == LEVELS - 1 else f"decoder_{below}"
        before, after = (_last(weights, source) for weights in (trained, larger))
        place = place + np.where(place >= before, after - before, 0)
    return place


def _last(weights: Flat, level: str) -> int:
    """Outputs of a level."""
    names = sorted(name for name in weights if name.startswith(f"{level}/") and name.endswith("/bias"))
    return weights[names[-1]].size


def _identity(trained: Flat, layer: str) -> np.ndarray:
    """A kernel that passes on every output of the trained level that ``layer`` is added to."""
    level = layer.partition("/")[0]
    if not any(name.startswith(f"{level}/") for name in trained):
        raise ValueError(f"{layer} is missing there")
    channels = _last(trained, level)
    kernel = np.zeros((3, 3, channels, channels), np.float32)
    kernel[1, 1] = np.eye(channels)
    return kernel
