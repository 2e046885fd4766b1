"""The recurrent autoencoder's network: a U-Net with a hidden state in each encoder stage.

Chakravarty R. Alla Chaitanya et al., "Interactive Reconstruction of Monte Carlo Image Sequences using a Recurrent
Denoising Autoencoder", 2017.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.networks import Widths, graph
from jaxdn.networks.graph import FEATURES, GraphSpec, Weights, evaluate, hidden
from jaxdn.networks.unet import (
    ONEDNN,
    XLA,
    draw_initial_weights,
    draw_weights,
    flax_structure,
    select_groups,
    select_weights,
)
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.onednn import library


class RecurrentNetwork(NamedTuple):
    """Three pure functions."""

    init: Callable[[jax.Array], dict[str, Any]]
    """key -> params, nested dicts of float32 arrays."""
    start: Callable[[int, int, int, Any], tuple[jax.Array, ...]]
    """(N, H, W, dtype) -> the hidden states of all stages before the first frame, zeros [N, H / 2^k, W / 2^k, c]."""
    apply: Callable[..., tuple[jax.Array, tuple[jax.Array, ...]]]
    """(params, feature groups [N, H, W, c] or None, hidden states) -> (output [N, H, W, outputs], hidden states)."""


@operation(name="recurrent_unet")
def run_recurrent_unet(weights: Weights, inputs: dict[str, jax.Array], *, network: GraphSpec) -> tuple[jax.Array, ...]:
    """The outputs of the network for its inputs by name [N, H, W, c]; XLA alone."""
    return evaluate(network, weights, inputs, XLA)


@run_recurrent_unet.implementation("onednn", dtypes=(jnp.float32,), unavailable=library.unavailable)
def _run_with_onednn_convolutions(
    weights: Weights, inputs: dict[str, jax.Array], *, network: GraphSpec
) -> tuple[jax.Array, ...]:
    """XLA with oneDNN's convolutions and their gradients: for training on CPUs."""
    return evaluate(network, weights, inputs, ONEDNN)


def recurrent_unet(
    groups: Sequence[int], outputs: int, *, widths: Widths, implementation: str | None = None
) -> RecurrentNetwork:
    """The network as pure functions; see :func:`jaxdn.networks.graph.recurrent_unet` for its layers and widths.

    ``groups`` are the channel counts of the feature groups; an absent one, None, equals zeros, as in
    :func:`jaxdn.networks.unet.unet`. H and W are multiples of ``2^(stages - 1)``. The output is raw.
    ``implementation``: None or "reference" (XLA), or "onednn" (convolutions and their gradients, see
    :mod:`jaxdn.ops.convolution.onednn`). Raises ValueError unless ``widths`` has one decoder level less than encoder
    stages, when the features do not fit, and when the implementation cannot run here.
    """
    if implementation is not None:
        run_recurrent_unet.named(implementation)
    stages = widths[0]
    if len(widths) != len(stages) or not all(level and all(channels > 0 for channels in level) for level in widths):
        raise ValueError(
            f"widths: expected the channels of n encoder stages, then those of n - 1 decoder levels, got {widths!r}."
        )

    def described(channels: int) -> GraphSpec:
        return graph.recurrent_unet(channels, outputs, widths=widths)

    structure = flax_structure(tuple(described(sum(groups)).kernels().items()))

    def init(key: jax.Array) -> dict[str, Any]:
        return draw_initial_weights(key, described(sum(groups)), scheme="he")

    def start(count: int, height: int, width: int, dtype: Any) -> tuple[jax.Array, ...]:
        return tuple(
            jnp.zeros((count, height >> stage, width >> stage, channels), dtype)
            for stage, channels in enumerate(stages)
        )

    def apply(
        params: dict[str, Any], features: Sequence[jax.Array | None], states: Sequence[jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        present = select_groups(features, groups, 2 ** (len(stages) - 1))
        network = described(sum(group.shape[-1] for group in present))
        inputs = {FEATURES: jnp.concatenate(present, axis=-1)}
        inputs |= {hidden(stage): state for stage, state in enumerate(states)}
        weights = select_weights(network, structure, params, features, groups)
        output, *kept = run_recurrent_unet(weights, inputs, network=network, implementation=implementation)
        return output, tuple(kept)

    return RecurrentNetwork(init, start, apply)


@run_recurrent_unet.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + height % 2, width + width % 2
    network = graph.recurrent_unet(3, 2, widths=((4, 5), (4,)))
    features, first = rng.normal(size=(1, height, width, 3)), rng.normal(size=(1, height, width, 4))
    inputs = {FEATURES: features, hidden(0): first, hidden(1): rng.normal(size=(1, height // 2, width // 2, 5))}
    yield Example((draw_weights(rng, network), inputs), {"network": network})
