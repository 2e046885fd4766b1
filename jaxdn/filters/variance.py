"""Variance of a pixel's luminance: from its history, or from its neighbours while the history is short."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.filters.accumulation import luminance
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.canvas import NO_WEIGHT
from jaxdn.filters.few import average_of_few, few_or_all
from jaxdn.filters.weights import Weight

_ROUNDING = 1e-3
"""Frames that a length may lack through rounding: the mean of lengths of 4 is seldom exactly 4."""


def estimate_variance(
    history: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    *,
    short_history: int,
    texture: jax.Array | None = None,
    beside: bool = True,
) -> tuple[jax.Array, jax.Array]:
    """Colour [3, H, W] and the variance [H, W] of its luminance, from a history of ``accumulate``.

    Where the length N is less than ``short_history``, both are those of the edge-stopped 7x7 neighbourhood, and the
    variance is multiplied by ``short_history / N`` (Schied et al. 2017, sec. 4.2). The ``texture`` [3, H, W] that a
    division left is averaged likewise and given back to this colour (:func:`jaxdn.brdf.restore`); the deviation changes
    as grey light would.

    At thin things nearly every tap may be rejected, and a pixel alone would keep what its own sample found: a black or
    bright dot. As far as it lacks one whole neighbour, ``beside`` gives it the mean of the eight pixels beside it,
    whatever they show; not for reflections, which are sharp where they are alone.
    """
    color, moments, length = history[:3], history[3:5], history[5]
    variance = jnp.maximum(moments[1] - moments[0] ** 2, 0.0)
    short = length < short_history - _ROUNDING
    needed = short if hit is None else short & hit
    planes = history[:5] if texture is None else jnp.concatenate([history[:5], texture])
    mean = few_or_all(
        needed,
        lambda: average_of_few(planes, hit, weights, stencil(3), needed),
        lambda: edge_average(planes, hit, weights, stencil(3), needed=needed, counted=True)[0],
    )
    mean, total = mean[:-1], mean[-1]
    around, spatial = mean[:3], jnp.maximum(mean[4] - mean[3] ** 2, 0.0) * (short_history / length)
    if texture is not None:
        around = brdf.restore(around, texture, mean[5:])
        spatial = spatial * brdf.restore(jnp.ones_like(spatial), luminance(texture), luminance(mean[5:])) ** 2
    color, variance = jnp.where(needed[None], around, color), jnp.where(needed, spatial, variance)
    if not beside:
        return color, variance
    alone = jnp.where(needed, jnp.clip(2.0 - total, 0.0, 1.0), 0.0)  # the pixel itself counts 1
    return _with_those_beside(color, variance, hit, alone)


def _with_those_beside(
    color: jax.Array, variance: jax.Array, hit: jax.Array | None, alone: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Both, mixed with their means over the 3x3 pixels around in so far as a pixel is ``alone``, [H, W] in [0, 1].

    Others that are alone do not count; where there are only such, nothing changes.
    """
    planes = jnp.concatenate([color, variance[None]])
    known = 1.0 - alone if hit is None else jnp.where(hit, 1.0 - alone, 0.0)
    lonely = alone > 0
    mean = few_or_all(
        lonely,
        lambda: average_of_few(planes, known, [], stencil(1), lonely),
        lambda: edge_average(planes, known, [], stencil(1), needed=lonely, counted=True)[0],
    )
    share = jnp.where(mean[-1] > NO_WEIGHT, alone, 0.0)
    mixed = planes + share[None] * (mean[:-1] - planes)
    return mixed[:3], mixed[3]
