"""Isolated pixels: next to thin things nearly every tap of a filter may be rejected."""

import jax
import jax.numpy as jnp

from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.sparse import choose_sparse, sparse_edge_average
from jaxdn.filters.stencil_tiles import NO_WEIGHT


def measure_isolation(total: jax.Array, needed: jax.Array) -> jax.Array:
    """[H, W] in [0, 1]: how far a pixel lacks one whole neighbour; 0 where it is not ``needed`` [H, W].

    ``total`` [H, W] is the sum of the weights of its taps, itself included, which counts 1.
    """
    return jnp.where(needed, jnp.clip(2.0 - total, 0.0, 1.0), 0.0)


def fill_isolated(planes: jax.Array, hit: jax.Array | None, isolation: jax.Array) -> jax.Array:
    """``planes`` [C, H, W], mixed with their means over the 3x3 pixels around by the ``isolation`` [H, W] of a pixel.

    An isolated pixel would keep what its own sample found: a black or bright dot. What those around it show is nearer
    to the truth. Other isolated pixels do not count; where there are only such, nothing changes.
    """
    known = 1.0 - isolation if hit is None else jnp.where(hit, 1.0 - isolation, 0.0)
    isolated = isolation > 0
    mean = choose_sparse(
        isolated,
        lambda: sparse_edge_average(planes, known, [], stencil(1), isolated),
        lambda: edge_average(planes, known, [], stencil(1), needed=isolated, with_total=True)[0],
    )
    share = jnp.where(mean[-1] > NO_WEIGHT, isolation, 0.0)
    return planes + share[None] * (mean[:-1] - planes)
