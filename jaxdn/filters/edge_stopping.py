"""Edge-stopping weights: the weight of a filter tap, from the guides at the tap and at the centre.

A filter takes any number of them. Each is an exponent (the exponents of all weights are summed, and ``exp(-sum)`` is
computed once) or a factor. All arrays are planar, ``[n, H, W]``, as in the filters.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.filters.surface_test import depth_slopes

Planes = list[jax.Array]


class TapOffset(NamedTuple):
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
    exponent: Callable[[Planes, Planes, TapOffset], jax.Array] | None = None
    """(there, here, offset) -> e >= 0 [h, w], for a factor ``exp(-e)``."""
    factor: Callable[[Planes, Planes, TapOffset], jax.Array] | None = None
    """(there, here, offset) -> a factor [h, w] in [0, 1]."""


def depth_weight(
    depth: jax.Array, ids: jax.Array | None, *, sigma: float | jax.Array, height: jax.Array | float
) -> Weight:
    """``exp(-|z(p) - z(q)| / (sigma |grad z(p) . (p - q)| + eps))``, eps = 1e-3 z(p) |p - q| / H.

    ``depth`` and ``ids`` [H, W, 1]; slopes are taken within an object (Schied et al. 2017, eq. 3). ``height`` is H of
    the whole frame, of which they may be a tile.
    """
    layers = jnp.stack([depth[..., 0], *depth_slopes(depth, ids)])
    share = 1e-3 / height

    def exponent(there: Planes, here: Planes, offset: TapOffset) -> jax.Array:
        z, slope_x, slope_y = here
        scale = sigma * jnp.abs(slope_x * offset.x + slope_y * offset.y) + share * offset.length * z + 1e-10
        return jnp.abs(there[0] - z) / scale

    return Weight(layers[:1], layers, exponent)


def plane_weight(depth: jax.Array, ids: jax.Array | None, *, tolerance: float) -> Weight:
    """1 within ``tolerance`` z(p) of the plane of a pixel's surface, 0 beyond: ``|z(q) - z(p) - grad z(p) . (q - p)|``.

    ``depth`` and ``ids`` [H, W, 1]; slopes are taken within an object, distances along the depth. After the test of
    NRD's ReLAX, which takes them across the plane.
    """
    layers = jnp.stack([depth[..., 0], *depth_slopes(depth, ids)])

    def factor(there: Planes, here: Planes, offset: TapOffset) -> jax.Array:
        z, slope_x, slope_y = here
        away = jnp.abs(there[0] - z - slope_x * offset.x - slope_y * offset.y)
        return (away <= tolerance * z).astype(depth.dtype)

    return Weight(layers[:1], layers, factor=factor)


def normal_weight(normal: jax.Array, *, sigma: float | jax.Array) -> Weight:
    """``max(0, n(p) . n(q)) ** sigma`` for unit normals [H, W, 3] (Schied et al. 2017, eq. 4).

    Pixels without a normal (0) have weight 1 among themselves and 0 with all others.
    """
    absent = jnp.all(normal == 0, axis=-1, keepdims=True).astype(normal.dtype)
    layers = jnp.concatenate([normal, absent], axis=-1).transpose(2, 0, 1)

    def factor(there: Planes, here: Planes, offset: TapOffset) -> jax.Array:
        aligned = sum((a * b for a, b in zip(there, here, strict=True)), start=jnp.zeros((), layers.dtype))
        return _power(jnp.maximum(aligned, 0.0), sigma)

    return Weight(layers, layers, factor=factor)


def luminance_weight(luminance: jax.Array, deviation: jax.Array, *, sigma: float | jax.Array) -> Weight:
    """``exp(-|l(p) - l(q)| / (sigma deviation(p) + 1e-4))``, arrays [H, W] (Schied et al. 2017, eq. 5)."""
    here = jnp.stack([luminance, 1.0 / (sigma * deviation + 1e-4)])
    return Weight(luminance[None], here, lambda there, here, offset: jnp.abs(there[0] - here[0]) * here[1])


LOBE_PART = 0.75
"""The part of a lobe that its angle contains."""
_STEADY = 0.01
"""Least angle of a lobe, in radians: what normals of half precision can tell."""


def lobe_weight(normal: jax.Array, roughness: jax.Array, *, fraction: float) -> Weight:
    """``exp(-a^2 / (fraction L)^2)`` for an angle a between normals [H, W, 3] and the lobe's angle L at the centre.

    ``a^2`` is taken as ``2 (1 - cos a)``. L is the angle that contains three quarters of the GGX distribution of a
    surface of linear roughness r [H, W, 1]: ``tan L = r^2 sqrt(3)`` (from its cumulative distribution,
    ``tan^2 a = r^4 u / (1 - u)`` at u = 0.75), and at least 0.01. Pixels without a normal (0) have weight 1 among
    themselves and ``exp(-2 / (fraction L)^2)`` with all others.
    """
    absent = jnp.all(normal == 0, axis=-1, keepdims=True).astype(normal.dtype)
    layers = jnp.concatenate([normal, absent], axis=-1).transpose(2, 0, 1)
    spread = (LOBE_PART / (1 - LOBE_PART)) ** 0.5
    angle = fraction * jnp.maximum(jnp.arctan(spread * roughness[..., 0] ** 2), _STEADY)
    here = jnp.concatenate([layers, (1.0 / (angle * angle))[None]])

    def exponent(there: Planes, here: Planes, offset: TapOffset) -> jax.Array:
        aligned = sum((a * b for a, b in zip(there, here[:4], strict=True)), start=jnp.zeros((), layers.dtype))
        return jnp.maximum(2.0 * (1.0 - aligned), 0.0) * here[4]

    return Weight(layers, here, exponent)


def roughness_weight(roughness: jax.Array, *, fraction: float) -> Weight:
    """``exp(-|r(p) - r(q)| / max(fraction r(p), 0.01))`` for linear roughness [H, W, 1]."""
    rough = roughness[..., 0]
    here = jnp.stack([rough, 1.0 / jnp.maximum(fraction * rough, 0.01)])
    return Weight(rough[None], here, lambda there, here, offset: jnp.abs(there[0] - here[0]) * here[1])


def closeness_weight(closeness: jax.Array, *, tolerance: float, least: float) -> Weight:
    """``max(exp(-|c(p) - c(q)| / tolerance), least)`` for the closeness [H, W] of what is seen in a reflection.

    1 where either is 0, which means unknown (:mod:`jaxdn.filters.virtual_motion`).
    """
    planes, most = closeness[None], -math.log(least)

    def exponent(there: Planes, here: Planes, offset: TapOffset) -> jax.Array:
        known = (there[0] > 0) & (here[0] > 0)
        return jnp.where(known, jnp.minimum(jnp.abs(there[0] - here[0]) / tolerance, most), 0.0)

    return Weight(planes, planes, exponent)


def _power(base: jax.Array, exponent: float | jax.Array) -> jax.Array:
    """base ** exponent for base >= 0; whole exponents by repeated squaring, without exp and log."""
    if not isinstance(exponent, jax.Array) and float(exponent).is_integer() and exponent >= 0:
        return lax.integer_pow(base, int(exponent))
    positive = base > 0
    return jnp.where(positive, jnp.exp(exponent * jnp.log(jnp.where(positive, base, 1.0))), 0.0)
