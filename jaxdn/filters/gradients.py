"""Temporal gradients: by what share the light on a surface has changed since the previous frame.

Everything is computed on strata of 3x3 pixels: sparse samples of the change are added up in their stratum, averaged
over strata by an edge-stopped a-trous filter, divided, and only then enlarged to pixels (Schied et al., "Gradient
Estimation for Real-Time Adaptive Temporal Filtering", 2018). The quotient of two averages is far less noisy than an
average of quotients. Fields of strata are planar, [Hs, Ws] with Hs = ceil(H / 3).
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.frame import Array
from jaxdn.core.numerics import absolute
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.blur import blur_variance
from jaxdn.filters.edge_stopping import Weight

STRATUM = 3
"""Pixels along one side of a stratum."""
Enlarging = Literal["bilinear", "nearest"]
"""How strata become pixels, see :func:`to_pixels`."""
_TAPS = stencil(1)
_DEVIATIONS = 3.0
"""Of the luminance of strata, that stop the filter."""
_LEAST = 1e-8
"""Light below this has no gradient: a black image changes by nothing."""


class StratumLight(NamedTuple):
    """The luminance that stops the filter where light has edges, as planes [Hs, Ws] of strata."""

    mean: jax.Array
    variance: jax.Array


class Change(NamedTuple):
    """What has changed, as planes [Hs, Ws] of strata."""

    delta: jax.Array
    """The change of luminance, of either sign."""
    size: jax.Array
    """The larger of the luminances before and after; 0 where nothing is known."""


_Planes = tuple[jax.Array, jax.Array, StratumLight | None]


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


def compare_replayed(gradient: jax.Array) -> Change:
    """The change of replayed samples: ``Frame.luminance_gradient`` [H, W, 2] by strata."""
    delta = gradient[..., 0]
    # Luminance is not negative, so the larger one is at least the change.
    size = jnp.maximum(gradient[..., 1], jnp.abs(delta))
    delta, size = stratum_sums(delta), stratum_sums(size)
    return Change(delta, size)


def compare_with_history(now: jax.Array, past: jax.Array, hit: jax.Array | None) -> Change:
    """The change of the frames' own luminance against that of the history, where no samples were replayed.

    The difference of both means over the stratum's pixels with a history.

    Args:
      now: luminance of the new frame [H, W], noisy.
      past: the history [6, H, W], 0 where there is none.
      hit: [H, W] bool, a surface is seen; None: everywhere.
    """
    there = (past[5] > 0).astype(now.dtype)
    if hit is not None:
        there = there * hit
    count = jnp.maximum(stratum_sums(there), 1.0)
    new, old = (stratum_sums(light * there) / count for light in (now, past[3]))
    return Change(new - old, jnp.maximum(new, old))


def measure_light(light: jax.Array, ids: Array) -> StratumLight:
    """Mean and variance of luminance [H, W] over the pixels of each stratum that show what its middle shows.

    ``ids`` [H, W, 1] tell what; without them all nine pixels count.
    """
    alike = jnp.ones_like(light)
    if ids is not None:
        middle = stratum_centers(ids)[..., 0]
        repeated = jnp.repeat(jnp.repeat(middle, STRATUM, axis=0), STRATUM, axis=1)
        alike = (ids[..., 0] == repeated[: light.shape[0], : light.shape[1]]).astype(light.dtype)
    count = stratum_sums(alike)
    mean, square = stratum_sums(light * alike) / count, stratum_sums(light * light * alike) / count
    return StratumLight(mean, jnp.maximum(square - mean * mean, 0.0))


def reconstruct(
    change: Change,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    *,
    levels: int,
    significance: float,
    spacing: int = STRATUM,
    light: StratumLight | None = None,
) -> jax.Array:
    """The share ``|delta| / size`` [Hs, Ws] in [0, 1] by which light has changed.

    ``delta`` and ``size`` are each filtered by an a-trous cascade of 3x3 taps, ``spacing``^i strata apart, and then
    divided. At powers of three every stratum within reach is counted once, so the variance of the mean is known; at the
    usual powers of two (Schied et al. 2018, and their released code) they overlap, and after five levels the real
    deviation is five times what the cascade gives.

    With ``light``, taps have the weight ``exp(-(dl / 3 s)^2)`` too, as in that code: dl is the difference of luminance
    and s its deviation at the centre, blurred over 3x3 strata; light and its variance are filtered along.

    Paths that differ by chance give a ``delta`` too, around 0: the share is multiplied by ``|delta| / (s deviation) -
    1`` within [0, 1], so that it is 0 up to s standard deviations of the filtered ``delta`` and whole from 2 s on.
    Where nothing is known nearby, nothing has changed.

    Args:
      change: of the strata.
      hit: [Hs, Ws] bool, a surface is seen; None: everywhere.
      weights: edge-stopping weights, of the size of the strata.
      levels: of the cascade.
      significance: s; 0 takes every difference for a change.
      spacing: of the taps of one level, in those of the level before.
      light: of the strata, to stop at its edges; None: it does not.
    """
    reach = spacing ** max(levels - 1, 0)

    def level(planes: _Planes, index: jax.Array) -> tuple[_Planes, None]:
        fields, variance, guide = planes
        stops = [*weights] if guide is None else [*weights, _light_weight(guide)]

        def average(values: jax.Array, variance: jax.Array) -> tuple[jax.Array, jax.Array]:
            step = spacing**index
            mean, spread = edge_average(values, hit, stops, _TAPS, step=step, step_max=reach, variance=variance)
            assert spread is not None
            return mean, spread

        if guide is not None:
            mean, spread = average(guide.mean[None], guide.variance)
            guide = StratumLight(mean[0], spread)
        return (*average(fields, variance), guide), None

    # The variance of a single delta, if its mean is 0.
    fields, variance = jnp.stack([change.delta, change.size]), change.delta**2
    if levels:
        (fields, variance, _), _ = lax.scan(level, (fields, variance, light), jnp.arange(levels, dtype=jnp.int32))
    delta, size = absolute(fields[0]), fields[1]
    lit = size > _LEAST
    share = jnp.where(lit, jnp.minimum(delta / jnp.where(lit, size, 1.0), 1.0), 0.0)
    if significance:
        deviation = significance * jnp.sqrt(jnp.maximum(variance, _LEAST**2))
        share = share * jnp.clip(delta / deviation - 1.0, 0.0, 1.0)
    return share


def _light_weight(light: StratumLight) -> Weight:
    """``exp(-(dl / 3 s)^2)`` with the deviation s at the centre."""
    variance = _DEVIATIONS**2 * jnp.maximum(blur_variance(light.variance), _LEAST**2)
    here = jnp.stack([light.mean, 1.0 / variance])
    return Weight(light.mean[None], here, lambda there, here, offset: (there[0] - here[0]) ** 2 * here[1])


def to_pixels(share: jax.Array, height: int, width: int, *, enlarging: Enlarging = "bilinear") -> jax.Array:
    """[Hs, Ws] -> [H, W]: the largest of the 3x3 strata around, enlarged bilinearly, or each to its 3x3 pixels."""
    wide = jnp.pad(share, 1, mode="edge")
    largest = lax.reduce_window(wide, -jnp.inf, lax.max, (3, 3), (1, 1), "VALID")
    if enlarging == "nearest":
        return jnp.repeat(jnp.repeat(largest, STRATUM, axis=0), STRATUM, axis=1)[:height, :width]
    return _enlarged(_enlarged(largest, 0), 1)[:height, :width]


def _enlarged(plane: jax.Array, axis: int) -> jax.Array:
    """Three times as many values along one axis; centres keep theirs, the others lie a third towards a neighbour."""
    wide = jnp.pad(plane, [(1, 1) if axis == one else (0, 0) for one in range(2)], mode="edge")
    before, after = (lax.slice_in_dim(wide, at, at + plane.shape[axis], axis=axis) for at in (0, 2))
    thirds = jnp.stack([(before + 2 * plane) / 3, plane, (after + 2 * plane) / 3], axis + 1)
    shape = list(plane.shape)
    shape[axis] *= STRATUM
    return thirds.reshape(shape)
