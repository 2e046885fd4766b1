"""Edge-stopped averages over a sparse stencil: the a-trous wavelet filter and its relatives.

The weight of a tap q at pixel p is its stencil weight h times edge-stopping weights that the caller chooses (Dammertz
et al., "Edge-Avoiding A-Trous Wavelet Transform for fast Global Illumination Filtering", 2010; Schied et al. 2017).

Arrays here are planar, ``[C, H, W]``: the stencil then runs along contiguous rows and vectorises. For each
strip of rows, a scan over the taps computes the weight of one tap while it adds up the tap before: written as a plain
sum, XLA:CPU recomputes every weight for each channel, which takes twice the time. The strips fit into the cache.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.filters.weights import Offset, Weight
from jaxdn.ops.platform import platform

B3_SPLINE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
_STRIP_PIXELS = 16384
NO_WEIGHT = 1e-10
"""Smaller sums of weights count as no tap: their cube, in the gradient of the variance, would underflow to 0. So would
the square of their square, in that of a division by it: there are two divisions instead."""


def stencil(radius: int, *, kernel: np.ndarray | None = None) -> np.ndarray:
    """Rows of (dy, dx, h) of a square stencil, the centre first; ``kernel`` is 1-D and separable, ``None`` all ones."""
    line = np.ones(2 * radius + 1) if kernel is None else kernel
    taps = [
        (dy, dx, line[dy + radius] * line[dx + radius])
        for dy in range(-radius, radius + 1)
        for dx in range(-radius, radius + 1)
    ]
    return np.array(sorted(taps, key=lambda tap: tap[0] != 0 or tap[1] != 0))


def edge_average(
    values: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    taps: np.ndarray,
    *,
    step: int | jax.Array = 1,
    step_max: int = 1,
    variance: jax.Array | None = None,
    needed: jax.Array | None = None,
    counted: bool = False,
) -> tuple[jax.Array, jax.Array | None]:
    """Weighted mean of ``values`` [C, H, W] over ``taps``, and the variance of this mean.

    Taps outside the image or without a surface have weight 0, the centre has exactly h. A pixel without taps, or whose
    weights sum to less than 1e-10, gives 0.

    Args:
      values: planes to average.
      hit: [H, W] bool, a surface is seen; other pixels are never taps. Or numbers in [0, 1]: how much each
        pixel counts. None: all count.
      weights: edge-stopping weights, see :mod:`jaxdn.filters.weights`.
      taps: rows of (dy, dx, h), see :func:`stencil`.
      step: spacing of the taps; it may be traced, so that all levels share one compiled loop, up to ``step_max``.
      step_max: the largest ``step``.
      variance: [H, W], becomes ``sum w^2 variance / (sum w)^2``.
      needed: [H, W] bool, strips of the image without a needed pixel are skipped and come back as 0.
      counted: the mean gets another plane, the sum of weights.
    """
    _, height, width = values.shape
    planes = values.shape[0] + counted
    dtype = values.dtype
    # Strips are for the CPU's cache only; other devices take one strip.
    rows = height if platform() != "cpu" else min(height, max(8, _STRIP_PIXELS // width))
    strips = -(-height // rows)
    spare = strips * rows - height
    reach_y, reach_x = (int(np.abs(taps[:, axis]).max()) * step_max for axis in (0, 1))
    inside = jnp.ones((height, width), dtype) if hit is None else hit.astype(dtype)

    def around(plane: jax.Array) -> jax.Array:
        return jnp.pad(plane, ((reach_y, reach_y + spare), (reach_x, reach_x)))

    def centred(plane: jax.Array) -> jax.Array:
        return jnp.pad(plane, ((0, spare), (0, 0)))

    # Masked pixels enter as zeros in the sums and in the sum of weights.
    means = [around(plane * inside) for plane in values] + [around(inside)]
    spread = None if variance is None else around(variance * inside)
    there = [[around(plane) for plane in one.there] for one in weights]
    centre = [[centred(plane) for plane in one.here] for one in weights]
    offsets = step * jnp.asarray(taps[:, :2], jnp.int32) + jnp.array([reach_y, reach_x], jnp.int32)[None]
    # Per tap: dx, dy and its length, all for step 1, and h.
    length = np.hypot(taps[:, 0], taps[:, 1])
    numbers = jnp.asarray(np.stack([taps[:, 1], taps[:, 0], length, taps[:, 2]], axis=1), dtype)
    numbers = numbers * jnp.where(jnp.arange(4) < 3, jnp.asarray(step, dtype), 1.0)[None]

    def strip(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        def shifted(plane: jax.Array, offset: jax.Array) -> jax.Array:
            return lax.dynamic_slice(plane, (top + offset[0], offset[1]), (rows, width))

        def here(plane: jax.Array) -> jax.Array:
            return lax.dynamic_slice(plane, (top, jnp.zeros_like(top)), (rows, width))

        def weigh(offset: jax.Array, number: jax.Array) -> jax.Array:
            tap = Offset(number[0], number[1], number[2])
            factor = jnp.full((rows, width), number[3])
            samples = [
                ([shifted(plane, offset) for plane in a], [here(plane) for plane in b])
                for a, b in zip(there, centre, strict=True)
            ]
            exponents = [one.exponent(*at, tap) for one, at in zip(weights, samples, strict=True) if one.exponent]
            if exponents:
                factor = factor * jnp.exp(-functools.reduce(jnp.add, exponents))
            for one, at in zip(weights, samples, strict=True):
                if one.factor:
                    factor = factor * one.factor(*at, tap)
            return factor

        def add(sums: tuple[list[jax.Array], jax.Array | None], weight: jax.Array, offset: jax.Array):
            total, total_spread = sums
            if spread is not None and total_spread is not None:
                total_spread = total_spread + weight * weight * shifted(spread, offset)
            total = [old + weight * shifted(plane, offset) for old, plane in zip(total, means, strict=True)]
            return total, total_spread

        def body(carry, tap):
            sums, ready, offset = carry
            return (add(sums, ready, offset), weigh(*tap), tap[0]), None

        # The centre's weight h is ready before the first tap's weight is computed.
        nothing = jnp.zeros((rows, width), dtype)
        sums = ([nothing] * len(means), None if spread is None else nothing)
        begin = (sums, jnp.full((rows, width), taps[0, 2], dtype), offsets[0])
        (sums, ready, offset), _ = lax.scan(body, begin, (offsets[1:], numbers[1:]))
        total, total_spread = add(sums, ready, offset)
        some = total[-1] > NO_WEIGHT
        share = jnp.where(some, total[-1], 1.0)
        own = total[-1:] if counted else []
        mean = jnp.stack([*(jnp.where(some, plane, 0.0) / share for plane in total[:-1]), *own])
        return mean, None if total_spread is None else jnp.where(some, total_spread, 0.0) / share / share

    def skipped(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        nothing = jnp.zeros((planes, rows, width), dtype)
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
    mean = mean.transpose(1, 0, 2, 3).reshape(planes, strips * rows, width)[:, :height]
    return mean, None if filtered is None else filtered.reshape(strips * rows, width)[:height]
