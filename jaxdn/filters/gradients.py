"""Temporal gradients: by what share the light on a surface has changed since the previous frame.

Everything is computed on strata of 3x3 pixels: sparse samples of the change are added up in their stratum, averaged
over strata by an edge-stopped a-trous filter, divided, and only then enlarged to pixels (Schied et al., "Gradient
Estimation for Real-Time Adaptive Temporal Filtering", 2018). The quotient of two averages is far less noisy than an
average of quotients. Fields of strata are planar, [Hs, Ws] with Hs = ceil(H / 3).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.filters.accumulation import luminance
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.blur import blur_variance
from jaxdn.filters.weights import Weight, luminance_weight
from jaxdn.frame import Array
from jaxdn.numerics import absolute

STRATUM = 3
"""Pixels along one side of a stratum."""
_TAPS = stencil(1)
_LEAST = 1e-8
"""Light below this has no gradient: a black image changes by nothing."""


class Change(NamedTuple):
    """What has changed, as planes [Hs, Ws] of strata."""

    delta: jax.Array
    """The change of luminance, of either sign."""
    size: jax.Array
    """The larger of the luminances before and after; 0 where nothing is known."""
    variance: jax.Array
    """The variance of ``delta``; 0 if it is exact."""


def stratum_sums(plane: jax.Array) -> jax.Array:
    """[H, W] -> [Hs, Ws], the sum over each stratum; those at the right and lower border may have fewer pixels."""
    height, width = plane.shape
    plane = jnp.pad(plane, ((0, -height % STRATUM), (0, -width % STRATUM)))
    return plane.reshape(-(-height // STRATUM), STRATUM, -(-width // STRATUM), STRATUM).sum((1, 3))


def stratum_centers(buffer: Array) -> Array:
    """[H, W, C] -> [Hs, Ws, C], the pixel in the middle of each stratum, or the last one there is; None stays None."""
    if buffer is None:
        return None
    height, width = buffer.shape[:2]
    wide = jnp.pad(buffer, ((0, -height % STRATUM), (0, -width % STRATUM), (0, 0)), mode="edge")
    return wide[1::STRATUM, 1::STRATUM]


def replayed(gradient: jax.Array) -> Change:
    """The change of replayed samples: ``Frame.luminance_gradient`` [H, W, 2] by strata."""
    delta = gradient[..., 0]
    # Luminance is not negative, so the larger one is at least the change.
    size = jnp.maximum(gradient[..., 1], jnp.abs(delta))
    delta, size = stratum_sums(delta), stratum_sums(size)
    return Change(delta, size, jnp.zeros_like(delta))


def observed(now: jax.Array, past: jax.Array, hit: jax.Array | None) -> Change:
    """The change of the frames' own luminance against that of the history, where no samples were replayed.

    The difference of both means over the stratum's pixels with a history; the variance of the new one, from the scatter
    of these pixels.

    Args:
      now: luminance of the new frame [H, W], noisy.
      past: the history [6, H, W], 0 where there is none.
      hit: [H, W] bool, a surface is seen; None: everywhere.
    """
    there = (past[5] > 0).astype(now.dtype)
    if hit is not None:
        there = there * hit
    count = stratum_sums(there)
    new, scatter = _mean_and_scatter(now, there)
    old = stratum_sums(past[3] * there) / jnp.maximum(count, 1.0)
    return Change(new - old, jnp.maximum(new, old), scatter)


def stratum_luminance(now: jax.Array, hit: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """The mean luminance of each stratum of colour ``now`` [3, H, W], and the variance of this mean: [Hs, Ws]."""
    light = luminance(now)
    return _mean_and_scatter(light, jnp.ones_like(light) if hit is None else hit.astype(light.dtype))


def _mean_and_scatter(light: jax.Array, there: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean over the pixels of each stratum that are ``there``, and the variance of the mean."""
    count = jnp.maximum(stratum_sums(there), 1.0)
    mean = stratum_sums(light * there) / count
    scatter = jnp.maximum(stratum_sums(light * light * there) / count - mean * mean, 0.0)
    return mean, scatter / jnp.maximum(count - 1.0, 1.0)


def reconstruct(
    change: Change,
    light: tuple[jax.Array, jax.Array] | None,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    *,
    levels: int,
    sigma: float,
    significance: float,
) -> jax.Array:
    """The share [Hs, Ws] in [0, 1] by which light has changed: ``max(0, |delta| - s deviation) / size``.

    ``delta`` and ``size`` are each filtered by an a-trous cascade of 3x3 taps, 2^i strata apart, and then divided. The
    luminance of the strata, which stops the filter at the edges of light, is filtered along with them. Where nothing is
    known nearby, nothing has changed: 0.

    Args:
      change: of the strata.
      light: mean luminance of the strata and its variance; None: light has no edges.
      hit: [Hs, Ws] bool, a surface is seen.
      weights: edge-stopping weights of the surfaces, of the size of the strata.
      levels: of the cascade.
      sigma: edge-stopping parameter for luminance, in standard deviations.
      significance: s, the standard deviations of ``delta`` that count as noise.
    """
    planes = jnp.stack([change.delta, change.size, *(() if light is None else light[:1])])
    variance = change.variance if light is None else light[1]

    def level(carry: tuple[jax.Array, jax.Array], index: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        planes, variance = carry
        stops = list(weights)
        if light is not None:
            deviation = jnp.sqrt(jnp.maximum(blur_variance(variance), 1e-10))
            stops.append(luminance_weight(planes[2], deviation, sigma=sigma))
        planes, spread = edge_average(
            planes, hit, stops, _TAPS, step=2**index, step_max=2 ** (levels - 1), variance=variance
        )
        assert spread is not None
        return (planes, spread), None

    if levels:
        (planes, variance), _ = lax.scan(level, (planes, variance), jnp.arange(levels, dtype=jnp.int32))
    delta, size = absolute(planes[0]), planes[1]
    if significance:
        delta = jnp.maximum(delta - significance * jnp.sqrt(jnp.maximum(variance, _LEAST**2)), 0.0)
    lit = size > _LEAST
    return jnp.where(lit, jnp.clip(delta / jnp.where(lit, size, 1.0), 0.0, 1.0), 0.0)


def to_pixels(share: jax.Array, height: int, width: int) -> jax.Array:
    """[Hs, Ws] -> [H, W]: the largest of the 3x3 strata around, enlarged bilinearly."""
    wide = jnp.pad(share, 1, mode="edge")
    largest = lax.reduce_window(wide, -jnp.inf, lax.max, (3, 3), (1, 1), "VALID")
    return _enlarged(_enlarged(largest, 0), 1)[:height, :width]


def _enlarged(plane: jax.Array, axis: int) -> jax.Array:
    """Three times as many values along one axis; centres keep theirs, the others lie a third towards a neighbour."""
    wide = jnp.pad(plane, [(1, 1) if axis == one else (0, 0) for one in range(2)], mode="edge")
    before, after = (lax.slice_in_dim(wide, at, at + plane.shape[axis], axis=axis) for at in (0, 2))
    thirds = jnp.stack([(before + 2 * plane) / 3, plane, (after + 2 * plane) / 3], axis + 1)
    shape = list(plane.shape)
    shape[axis] *= STRATUM
    return thirds.reshape(shape)
