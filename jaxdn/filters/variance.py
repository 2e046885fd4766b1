"""Variance of a pixel's luminance: from its history, or from its neighbours while the history is short."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.weights import Weight


def estimate_variance(
    history: jax.Array, hit: jax.Array | None, weights: Sequence[Weight], *, short_history: int
) -> tuple[jax.Array, jax.Array]:
    """Colour [3, H, W] and the variance [H, W] of its luminance, from a history of ``accumulate``.

    Where the length N is less than ``short_history``, both are those of the edge-stopped 7x7 neighbourhood, and the
    variance is multiplied by ``short_history / N`` (Schied et al. 2017, sec. 4.2).
    """
    color, moments, length = history[:3], history[3:5], history[5]
    variance = jnp.maximum(moments[1] - moments[0] ** 2, 0.0)
    short = length < short_history
    needed = short if hit is None else short & hit
    mean, _ = edge_average(history[:5], hit, weights, stencil(3), needed=needed)
    spatial = jnp.maximum(mean[4] - mean[3] ** 2, 0.0) * (short_history / length)
    return jnp.where(needed[None], mean[:3], color), jnp.where(needed, spatial, variance)
