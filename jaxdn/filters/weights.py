"""Edge-stopping weights: the weight of a filter tap, from the guides at the tap and at the centre.

A filter takes any number of them. Each is an exponent (the exponents of all weights are summed, and ``exp(-sum)`` is
computed once) or a factor. All arrays are planar, ``[n, H, W]``, as in the filters.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.filters.guides import depth_slopes

Planes = list[jax.Array]


class Offset(NamedTuple):
    """From the centre to the tap, in pixels (scalars, including the spacing of the taps)."""

    x: jax.Array
    y: jax.Array
    length: jax.Array


class Weight(NamedTuple):
    """One edge-stopping weight."""

    there: jax.Array
    """[n, H, W] planes that are read at the tap."""
    here: jax.Array
    """[m, H, W] planes that are read at the centre."""
    exponent: Callable[[Planes, Planes, Offset], jax.Array] | None = None
    """(there, here, offset) -> e >= 0 [h, w], for a factor ``exp(-e)``."""
    factor: Callable[[Planes, Planes, Offset], jax.Array] | None = None
    """(there, here, offset) -> a factor [h, w] in [0, 1]."""


def depth_weight(depth: jax.Array, ids: jax.Array | None, *, sigma: float) -> Weight:
    """``exp(-|z(p) - z(q)| / (sigma |grad z(p) . (p - q)| + eps))``, eps = 1e-3 z(p) |p - q| / H.

    ``depth`` and ``ids`` [H, W, 1]; slopes are taken within an object (Schied et al. 2017, eq. 3).
    """
    layers = jnp.stack([depth[..., 0], *depth_slopes(depth, ids)])
    share = 1e-3 / depth.shape[0]

    def exponent(there: Planes, here: Planes, offset: Offset) -> jax.Array:
        z, slope_x, slope_y = here
        scale = sigma * jnp.abs(slope_x * offset.x + slope_y * offset.y) + share * offset.length * z + 1e-10
        return jnp.abs(there[0] - z) / scale

    return Weight(layers[:1], layers, exponent)


def normal_weight(normal: jax.Array, *, sigma: float) -> Weight:
    """``max(0, n(p) . n(q)) ** sigma`` for unit normals [H, W, 3] (Schied et al. 2017, eq. 4).

    Pixels without a normal (0) have weight 1 among themselves and 0 with all others.
    """
    absent = jnp.all(normal == 0, axis=-1, keepdims=True).astype(normal.dtype)
    layers = jnp.concatenate([normal, absent], axis=-1).transpose(2, 0, 1)

    def factor(there: Planes, here: Planes, offset: Offset) -> jax.Array:
        aligned = sum((a * b for a, b in zip(there, here, strict=True)), start=jnp.zeros((), layers.dtype))
        return _power(jnp.maximum(aligned, 0.0), sigma)

    return Weight(layers, layers, factor=factor)


def luminance_weight(luminance: jax.Array, deviation: jax.Array, *, sigma: float) -> Weight:
    """``exp(-|l(p) - l(q)| / (sigma deviation(p) + 1e-4))``, arrays [H, W] (Schied et al. 2017, eq. 5)."""
    here = jnp.stack([luminance, 1.0 / (sigma * deviation + 1e-4)])
    return Weight(luminance[None], here, lambda there, here, offset: jnp.abs(there[0] - here[0]) * here[1])


def _power(base: jax.Array, exponent: float) -> jax.Array:
    """base ** exponent for base >= 0; whole exponents by repeated squaring, without exp and log."""
    if float(exponent).is_integer() and exponent >= 0:
        return lax.integer_pow(base, int(exponent))
    positive = base > 0
    return jnp.where(positive, jnp.exp(exponent * jnp.log(jnp.where(positive, base, 1.0))), 0.0)
