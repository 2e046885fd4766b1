"""Variance of a pixel's luminance: from its history, or from its neighbours while the history is short."""

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.filters.accumulation import texture_ratio
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.edge_stopping import Weight
from jaxdn.filters.isolated import fill_isolated, measure_isolation
from jaxdn.filters.sparse import choose_sparse, sparse_edge_average

Spatial = Literal["image", "variance"]
"""What a short history takes from its neighbours, see :func:`estimate_variance`."""
_ROUNDING = 1e-3
"""Frames that a length may lack through rounding: the mean of lengths of 4 is seldom exactly 4."""


def estimate_variance(
    history: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    *,
    short_history: int,
    spatial: Spatial = "image",
    texture: jax.Array | None = None,
    isolated: bool = True,
) -> tuple[jax.Array, jax.Array]:
    """Colour [3, H, W] and the variance [H, W] of its luminance, from a history of ``accumulate``.

    Where the length N is less than ``short_history``, both are those of the edge-stopped 7x7 neighbourhood, and the
    variance is multiplied by ``short_history / N``. (Schied et al. 2017, sec. 4.2, take the variance alone from there,
    as it is: ``spatial="variance"``; the colour and the factor are those of later implementations.) The ``texture`` [3,
    H, W] that a division left is averaged likewise and given back to this colour (:func:`jaxdn.brdf.restore`); the
    deviation changes as grey light would.

    With ``spatial="image"``, ``isolated`` gives an isolated pixel the mean of those around it
    (:mod:`jaxdn.filters.isolated`); not for reflections, which are sharp where they are alone.
    """
    color, moments, length = history[:3], history[3:5], history[5]
    variance = jnp.maximum(moments[1] - moments[0] ** 2, 0.0)
    short = length < short_history - _ROUNDING
    needed = short if hit is None else short & hit
    planes = history[:5] if texture is None else jnp.concatenate([history[:5], texture])
    mean = choose_sparse(
        needed,
        lambda: sparse_edge_average(planes, hit, weights, stencil(3), needed),
        lambda: edge_average(planes, hit, weights, stencil(3), needed=needed, with_total=True)[0],
    )
    mean, total = mean[:-1], mean[-1]
    around, spread = mean[:3], jnp.maximum(mean[4] - mean[3] ** 2, 0.0)
    if spatial == "image":
        spread = spread * (short_history / length)
    if texture is not None:
        around = brdf.restore(around, texture, mean[5:])
        spread = spread * texture_ratio(mean[5:], texture) ** 2
    variance = jnp.where(needed, spread, variance)
    if spatial == "variance":
        return color, variance
    color = jnp.where(needed[None], around, color)
    if not isolated:
        return color, variance
    planes = jnp.concatenate([color, variance[None]])
    mixed = fill_isolated(planes, hit, measure_isolation(total, needed))
    return mixed[:3], mixed[3]
