"""Images with any number of samples per pixel, combined from stored independent layers.

Layers of 1, 2, 4, ... samples give every number of samples up to their sum: n samples are the layers of n's binary
digits, each weighted by its number of samples (Hasselgren et al. 2020, "Neural Temporal Adaptive Sampling and
Denoising", sec. 2.2).
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp


def from_layers(layers: Mapping[int, jax.Array], counts: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The image [H, W, 3] with ``counts`` [H, W, 1] samples per pixel, and the actual counts.

    ``layers`` maps powers of two to independent images [H, W, 3] of that many samples. Counts are rounded and clamped
    to the layers' sum; a pixel without samples is 0. No gradient flows into the counts. Raises ValueError
    unless the layers are 1, 2, 4, ... without a gap.
    """
    expected = [1 << bit for bit in range(len(layers))]
    if sorted(layers) != expected or not layers:
        raise ValueError(f"layers: expected independent layers of 1, 2, 4, ... samples, got {sorted(layers)}.")
    counts = jax.lax.stop_gradient(counts)
    whole = jnp.clip(jnp.round(jnp.where(jnp.isfinite(counts), counts, 0.0)), 0, sum(layers)).astype(jnp.int32)
    total = jnp.zeros_like(layers[1])
    for samples in expected:
        total = total + jnp.where((whole & samples) > 0, samples * layers[samples], 0.0)
    taken = whole.astype(total.dtype)
    return total / jnp.maximum(taken, 1.0), taken
