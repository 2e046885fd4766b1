"""The recurrent autoencoder's network: a U-Net with a hidden state in each encoder stage.

Chakravarty R. Alla Chaitanya et al., "Interactive Reconstruction of Monte Carlo Image Sequences using a Recurrent
Denoising Autoencoder", 2017.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.networks import Widths, description
from jaxdn.networks.description import FEATURES, Description, Weights, evaluate, hidden
from jaxdn.networks.unet import ONEDNN, XLA, Layers, initial, present_groups, storage, weights_for
from jaxdn.ops.dispatch.registry import register, resolve
from jaxdn.ops.onednn import library

Apply = Callable[[Weights, dict[str, jax.Array]], tuple[jax.Array, ...]]
"""(weights, inputs by name [N, H, W, c]) -> outputs."""


class RecurrentNetwork(NamedTuple):
    """Three pure functions."""

    init: Callable[[jax.Array], dict[str, Any]]
    """key -> params, nested dicts of float32 arrays."""
    start: Callable[[int, int, int, Any], tuple[jax.Array, ...]]
    """(N, H, W, dtype) -> the hidden states of all stages before the first frame, zeros [N, H / 2^k, W / 2^k, c]."""
    apply: Callable[..., tuple[jax.Array, tuple[jax.Array, ...]]]
    """(params, feature groups [N, H, W, c] or None, hidden states) -> (output [N, H, W, outputs], hidden states)."""


def by_xla(layers: Layers, network: Description) -> Apply:
    """The network as XLA compiles it."""
    return lambda weights, inputs: evaluate(network, weights, inputs, layers)


@register("recurrent_unet", "reference")
def reference(network: Description) -> Apply:
    """XLA alone."""
    return by_xla(XLA, network)


@register("recurrent_unet", "onednn", requires=library.check_available)
def convolved_by_onednn(network: Description) -> Apply:
    """XLA with oneDNN's convolutions and their gradients: for training on CPUs."""
    return by_xla(ONEDNN, network)


def recurrent_unet(
    groups: Sequence[int], outputs: int, *, widths: Widths, implementation: str | None = None
) -> RecurrentNetwork:
    """The network as pure functions; see :func:`jaxdn.networks.description.recurrent_unet` for its layers and widths.

    ``groups`` are the channel counts of the feature groups; an absent one, None, equals zeros, as in
    :func:`jaxdn.networks.unet.unet`. H and W are multiples of ``2^(stages - 1)``. The output is raw.
    ``implementation``: None or "reference" (XLA), or "onednn" (convolutions and their gradients, see
    :mod:`jaxdn.ops.convolution.onednn`). Raises ValueError unless ``widths`` has one decoder level less than encoder
    stages, when the features do not fit, and when the implementation cannot run here.
    """
    run = resolve("recurrent_unet", implementation)
    stages = widths[0]
    if len(widths) != len(stages) or not all(level and all(channels > 0 for channels in level) for level in widths):
        raise ValueError(
            f"widths: expected the channels of n encoder stages, then those of n - 1 decoder levels, got {widths!r}."
        )

    def described(channels: int) -> Description:
        return description.recurrent_unet(channels, outputs, widths=widths)

    graph = storage(described(sum(groups)))

    def init(key: jax.Array) -> dict[str, Any]:
        return initial(key, described(sum(groups)), scheme="he")

    def start(count: int, height: int, width: int, dtype: Any) -> tuple[jax.Array, ...]:
        return tuple(
            jnp.zeros((count, height >> stage, width >> stage, channels), dtype)
            for stage, channels in enumerate(stages)
        )

    def apply(
        params: dict[str, Any], features: Sequence[jax.Array | None], states: Sequence[jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        present = present_groups(features, groups, 2 ** (len(stages) - 1))
        network = described(sum(group.shape[-1] for group in present))
        inputs = {FEATURES: jnp.concatenate(present, axis=-1)}
        inputs |= {hidden(stage): state for stage, state in enumerate(states)}
        output, *kept = run(network)(weights_for(network, graph, params, features, groups), inputs)
        return output, tuple(kept)

    return RecurrentNetwork(init, start, apply)
