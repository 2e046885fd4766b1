"""Edge-stopped averages over a sparse stencil: the a-trous wavelet filter and its relatives.

The weight of a tap q at pixel p is ``h * w_z * w_n * w_l`` (Schied et al. 2017, eqs. 3-5; Dammertz et al. 2010):

    w_z = exp(-|z(p) - z(q)| / (sigma_z |grad z(p) . (p - q)| + eps)),   eps = 1e-3 z(p) |p - q| / H
    w_n = max(0, n(p) . n(q)) ** sigma_n
    w_l = exp(-|l(p) - l(q)| / (sigma_l sqrt(blurred variance(p)) + 1e-4))

Arrays here are planar, ``[C, H, W]``: the stencil then runs along contiguous rows and vectorises. Taps are a scan over
strips of rows, in which the weight of one tap is made while the tap before it is added up: written as a plain sum,
XLA:CPU computes every weight again for each channel that uses it, which takes twice the time. The strips fit the cache.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.denoisers.reprojection import depth_slopes, hit_mask

B3_SPLINE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
_STRIP_PIXELS = 16384
_NO_WEIGHT = 1e-10
"""Taps that weigh less together count as none: the cube of their sum, in the variance's gradient, would be 0."""


class Edges(NamedTuple):
    """What stops the filter at edges; ``None`` is a test that is absent and leaves no operation behind."""

    hit: jax.Array | None
    """[H, W] bool, a surface is seen; other pixels are never taps."""
    depth: jax.Array | None
    """[3, H, W] view-space depth and its slopes along x and y."""
    normal: jax.Array | None
    """[4, H, W] unit normal, and 1 in the fourth layer where there is none."""


def edges_of(depth: jax.Array | None, normal: jax.Array | None, ids: jax.Array | None) -> Edges:
    """Gather the edge tests of a frame's repaired buffers, ``[H, W, C]`` each."""
    layers = None if depth is None else jnp.stack([depth[..., 0], *depth_slopes(depth, ids)])
    unit = None
    if normal is not None:
        absent = jnp.all(normal == 0, axis=-1, keepdims=True).astype(normal.dtype)
        unit = jnp.concatenate([normal, absent], axis=-1).transpose(2, 0, 1)
    return Edges(hit_mask(depth, ids), layers, unit)


def stencil(radius: int, *, kernel: np.ndarray | None = None) -> np.ndarray:
    """Rows of (dy, dx, h) of a square stencil, the centre first; ``kernel`` is 1-D and separable, ``None`` all ones."""
    line = np.ones(2 * radius + 1) if kernel is None else kernel
    taps = [
        (dy, dx, line[dy + radius] * line[dx + radius])
        for dy in range(-radius, radius + 1)
        for dx in range(-radius, radius + 1)
    ]
    return np.array(sorted(taps, key=lambda tap: tap[0] != 0 or tap[1] != 0))


def blur_variance(variance: jax.Array) -> jax.Array:
    """[H, W] blurred by (1, 2, 1) x (1, 2, 1) / 16 with the edge repeated."""
    height, width = variance.shape
    wide = jnp.pad(variance, 1, mode="edge")
    rows = (wide[:height] + 2 * wide[1 : height + 1] + wide[2:]) / 4
    return (rows[:, :width] + 2 * rows[:, 1 : width + 1] + rows[:, 2:]) / 4


def edge_average(
    values: jax.Array,
    edges: Edges,
    taps: np.ndarray,
    *,
    step: int | jax.Array = 1,
    step_max: int = 1,
    variance: jax.Array | None = None,
    luminance: tuple[jax.Array, jax.Array] | None = None,
    needed: jax.Array | None = None,
    sigma_depth: float = 1.0,
    sigma_normal: float = 128.0,
) -> tuple[jax.Array, jax.Array | None]:
    """Weighted mean of ``values`` [C, H, W] over ``taps`` and the variance that this mean has.

    ``step`` spreads the taps; it may be traced, so that all levels share one compiled loop, up to ``step_max``.
    ``variance`` [H, W] becomes ``sum w^2 variance / (sum w)^2``. ``luminance`` is (l, 1 / (sigma_l sqrt(var) + eps)),
    each [H, W]; ``None`` drops w_l. ``needed`` [H, W] bool: strips of the image without a needed pixel are skipped and
    come back as 0. Taps outside the image or without a surface weigh nothing; the centre weighs h exactly; a pixel
    without any tap, or with taps that weigh less than 1e-10 together, gives 0.
    """
    _, height, width = values.shape
    dtype = values.dtype
    # One strip elsewhere than on the CPU: a cache to stay in is the CPU's concern.
    rows = height if jax.default_backend() != "cpu" else min(height, max(8, _STRIP_PIXELS // width))
    strips = -(-height // rows)
    spare = strips * rows - height
    reach_y, reach_x = (int(np.abs(taps[:, axis]).max()) * step_max for axis in (0, 1))
    inside = jnp.ones((height, width), dtype) if edges.hit is None else edges.hit.astype(dtype)

    def around(plane: jax.Array) -> jax.Array:
        return jnp.pad(plane, ((reach_y, reach_y + spare), (reach_x, reach_x)))

    def centred(plane: jax.Array) -> jax.Array:
        return jnp.pad(plane, ((0, spare), (0, 0)))

    # Masked pixels enter as zeros in the sums and in the sum of weights alike.
    means = [around(plane * inside) for plane in values] + [around(inside)]
    spread = None if variance is None else around(variance * inside)
    depth = None if edges.depth is None else (around(edges.depth[0]), [centred(layer) for layer in edges.depth])
    normal = None if edges.normal is None else [(around(layer), centred(layer)) for layer in edges.normal]
    light = None if luminance is None else (around(luminance[0]), [centred(layer) for layer in luminance])
    offsets = step * jnp.asarray(taps[:, :2], jnp.int32) + jnp.array([reach_y, reach_x], jnp.int32)[None]
    # Per tap: dx, dy and eps of the depth weight relative to z, each for step 1, and h.
    length = np.hypot(taps[:, 0], taps[:, 1])
    numbers = jnp.asarray(np.stack([taps[:, 1], taps[:, 0], 1e-3 / height * length, taps[:, 2]], axis=1), dtype)
    numbers = numbers * jnp.where(jnp.arange(4) < 3, jnp.asarray(step, dtype), 1.0)[None]

    def strip(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        def shifted(plane: jax.Array, offset: jax.Array) -> jax.Array:
            return lax.dynamic_slice(plane, (top + offset[0], offset[1]), (rows, width))

        def here(plane: jax.Array) -> jax.Array:
            return lax.dynamic_slice(plane, (top, jnp.zeros_like(top)), (rows, width))

        def weight(offset: jax.Array, number: jax.Array) -> jax.Array:
            factor = jnp.full((rows, width), number[3])
            exponent = None
            if depth is not None:
                z, slope_x, slope_y = map(here, depth[1])
                scale = sigma_depth * jnp.abs(slope_x * number[0] + slope_y * number[1]) + number[2] * z + 1e-10
                exponent = jnp.abs(shifted(depth[0], offset) - z) / scale
            if light is not None:
                level, per_level = map(here, light[1])
                difference = jnp.abs(shifted(light[0], offset) - level) * per_level
                exponent = difference if exponent is None else exponent + difference
            if exponent is not None:
                factor = factor * jnp.exp(-exponent)
            if normal is not None:
                aligned = jnp.maximum(sum(shifted(plane, offset) * here(centre) for plane, centre in normal), 0.0)
                factor = factor * _power(aligned, sigma_normal)
            return factor

        def add(sums: tuple[list[jax.Array], jax.Array | None], weight: jax.Array, offset: jax.Array):
            total, total_spread = sums
            if spread is not None and total_spread is not None:
                total_spread = total_spread + weight * weight * shifted(spread, offset)
            total = [old + weight * shifted(plane, offset) for old, plane in zip(total, means, strict=True)]
            return total, total_spread

        def body(carry, tap):
            sums, ready, offset = carry
            return (add(sums, ready, offset), weight(*tap), tap[0]), None

        # The centre waits to be added with its weight h before the first tap's weight is made.
        nothing = jnp.zeros((rows, width), dtype)
        sums = ([nothing] * len(means), None if spread is None else nothing)
        centre = (sums, jnp.full((rows, width), taps[0, 2], dtype), offsets[0])
        (sums, ready, offset), _ = lax.scan(body, centre, (offsets[1:], numbers[1:]))
        total, total_spread = add(sums, ready, offset)
        some = total[-1] > _NO_WEIGHT
        share = jnp.where(some, total[-1], 1.0)
        mean = jnp.stack([jnp.where(some, plane, 0.0) / share for plane in total[:-1]])
        return mean, None if total_spread is None else jnp.where(some, total_spread, 0.0) / share**2

    def skipped(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        nothing = jnp.zeros((values.shape[0], rows, width), dtype)
        return nothing, None if spread is None else jnp.zeros((rows, width), dtype)

    wanted = None if needed is None else jnp.pad(needed, ((0, spare), (0, 0)))

    def one(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        if wanted is None:
            return strip(top)
        some = jnp.any(lax.dynamic_slice(wanted, (top, jnp.zeros_like(top)), (rows, width)))
        return lax.cond(some, strip, skipped, top)

    if strips == 1:
        return one(jnp.zeros((), jnp.int32))
    mean, filtered = lax.map(one, rows * jnp.arange(strips, dtype=jnp.int32))
    mean = mean.transpose(1, 0, 2, 3).reshape(values.shape[0], strips * rows, width)[:, :height]
    return mean, None if filtered is None else filtered.reshape(strips * rows, width)[:height]


def _power(base: jax.Array, exponent: float) -> jax.Array:
    """base ** exponent for base >= 0; whole exponents by repeated squaring, without exp and log."""
    if float(exponent).is_integer() and exponent >= 0:
        return lax.integer_pow(base, int(exponent))
    positive = base > 0
    return jnp.where(positive, jnp.exp(exponent * jnp.log(jnp.where(positive, base, 1.0))), 0.0)
