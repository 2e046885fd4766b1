"""Pixels that are alone: next to thin things nearly every tap of a filter may be rejected."""

import jax
import jax.numpy as jnp

from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.sparse import average_of_few, few_or_all
from jaxdn.filters.stencil_tiles import NO_WEIGHT


def alone(total: jax.Array, needed: jax.Array) -> jax.Array:
    """[H, W] in [0, 1]: how far a pixel lacks one whole neighbour; 0 where it is not ``needed`` [H, W].

    ``total`` [H, W] is the sum of the weights of its taps, itself included, which counts 1.
    """
    return jnp.where(needed, jnp.clip(2.0 - total, 0.0, 1.0), 0.0)


def with_those_beside(planes: jax.Array, hit: jax.Array | None, alone: jax.Array) -> jax.Array:
    """``planes`` [C, H, W], mixed with their means over the 3x3 pixels around in so far as a pixel is ``alone`` [H, W].

    A pixel alone would keep what its own sample found: a black or bright dot. Whatever those beside it show is nearer
    to the truth. Others that are alone do not count; where there are only such, nothing changes.
    """
    known = 1.0 - alone if hit is None else jnp.where(hit, 1.0 - alone, 0.0)
    lonely = alone > 0
    mean = few_or_all(
        lonely,
        lambda: average_of_few(planes, known, [], stencil(1), lonely),
        lambda: edge_average(planes, known, [], stencil(1), needed=lonely, counted=True)[0],
    )
    share = jnp.where(mean[-1] > NO_WEIGHT, alone, 0.0)
    return planes + share[None] * (mean[:-1] - planes)
