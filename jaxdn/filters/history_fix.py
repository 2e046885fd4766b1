"""Pixels whose history has just begun, filled from far around: sparse averages that are wide while it is short."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn import brdf
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.few import average_of_few, few_or_all
from jaxdn.filters.weights import Weight

WIDEST = 14
"""The stride is ``WIDEST / (1 + N)`` pixels for a history of N frames."""
_TAPS = np.array([tap for tap in stencil(2) if abs(tap[0] * tap[1]) < 4])
"""5x5 without the corners."""


def fix_history(
    color: jax.Array,
    length: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    *,
    frames: int,
    texture: jax.Array | None = None,
) -> jax.Array:
    """``color`` [3, H, W] where the history is longer than ``frames``, else an edge-stopped mean of 21 sparse taps.

    The taps are ``round(14 / (1 + N))`` pixels apart: 7, 5, 4 (3.5) and 3 for N = 1 to 4.

    Args:
      color: the blended history.
      length: [H, W] its length N in frames; fractions count as the nearest whole number.
      hit: [H, W] bool, a surface is seen; None: everywhere.
      weights: edge-stopping weights.
      frames: longest history that is fixed; 0: none.
      texture: [3, H, W] what a division left, averaged likewise and given back (:func:`jaxdn.brdf.restore`).
    """
    if not frames:
        return color
    numbers = np.arange(1, frames + 1)
    strides = np.maximum(np.round(WIDEST / (1.0 + numbers)), 1).astype(np.int32)
    whole = jnp.clip(jnp.round(length), 1, None)
    planes = color if texture is None else jnp.concatenate([color, texture])

    short = whole <= frames
    short = short if hit is None else short & hit

    def few() -> jax.Array:
        step = jnp.asarray(strides)[jnp.clip(whole - 1, 0, frames - 1).astype(jnp.int32)]
        return average_of_few(planes, hit, weights, _TAPS, short, step=step)[:-1]

    def many() -> jax.Array:
        def fill(filled: jax.Array, each: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            number, stride = each
            own = short & (whole == number)
            mean, _ = edge_average(planes, hit, weights, _TAPS, step=stride, step_max=int(strides.max()), needed=own)
            return jnp.where(own[None], mean, filled), None

        return lax.scan(fill, planes, (jnp.asarray(numbers, length.dtype), jnp.asarray(strides)))[0]

    mean = few_or_all(short, few, many)
    filled = mean if texture is None else brdf.restore(mean[:3], texture, mean[3:])
    return jnp.where(short[None], filled, color)
