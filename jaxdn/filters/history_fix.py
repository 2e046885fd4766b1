"""Pixels whose history has just begun, filled from far around: sparse averages that are wide while it is short."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn import brdf
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.edge_stopping import Weight
from jaxdn.filters.isolated import fill_isolated, measure_isolation
from jaxdn.filters.sparse import choose_sparse, sparse_edge_average

_TAPS = np.array([tap for tap in stencil(2) if abs(tap[0] * tap[1]) < 4])
"""5x5 without the corners."""


def fix_history(
    color: jax.Array,
    length: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    *,
    frames: int,
    widest: int,
    texture: jax.Array | None = None,
    isolated: bool = True,
) -> jax.Array:
    """``color`` [3, H, W] where the history is longer than ``frames``, else an edge-stopped mean of 21 sparse taps.

    The taps are ``round(widest / (1 + N))`` pixels apart, and at least one.

    Args:
      color: the blended history.
      length: [H, W] its length N in frames; fractions count as the nearest whole number.
      hit: [H, W] bool, a surface is seen; None: everywhere.
      weights: edge-stopping weights.
      frames: longest history that is fixed; 0: none.
      widest: twice the distance of the taps, in pixels, for a history of one frame.
      texture: [3, H, W] what a division left, averaged likewise and given back (:func:`jaxdn.brdf.restore`).
      isolated: an isolated pixel gets the mean of those around it (:mod:`jaxdn.filters.isolated`); not for
        reflections.
    """
    if not frames:
        return color
    numbers = np.arange(1, frames + 1)
    strides = np.maximum(np.round(widest / (1.0 + numbers)), 1).astype(np.int32)
    whole = jnp.clip(jnp.round(length), 1, None)
    planes = color if texture is None else jnp.concatenate([color, texture])

    short = whole <= frames
    short = short if hit is None else short & hit

    def few() -> jax.Array:
        step = jnp.asarray(strides)[jnp.clip(whole - 1, 0, frames - 1).astype(jnp.int32)]
        return sparse_edge_average(planes, hit, weights, _TAPS, short, step=step)

    def many() -> jax.Array:
        def fill(filled: jax.Array, each: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            number, stride = each
            own = short & (whole == number)
            reach = dict[str, Any](step=stride, step_max=int(strides.max()))
            mean, _ = edge_average(planes, hit, weights, _TAPS, needed=own, with_total=True, **reach)
            return jnp.where(own[None], mean, filled), None

        begun = jnp.concatenate([planes, jnp.ones_like(planes[:1])])
        return lax.scan(fill, begun, (jnp.asarray(numbers, length.dtype), jnp.asarray(strides)))[0]

    mean = choose_sparse(short, few, many)
    mean, total = mean[:-1], mean[-1]
    filled = mean if texture is None else brdf.restore(mean[:3], texture, mean[3:])
    filled = jnp.where(short[None], filled, color)
    return fill_isolated(filled, hit, measure_isolation(total, short)) if isolated else filled
