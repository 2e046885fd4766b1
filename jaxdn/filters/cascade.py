"""The a-trous cascade: levels of sparse averages, each twice as wide, guided by the variance that the last one left."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn import brdf
from jaxdn.filters.accumulation import luminance
from jaxdn.filters.blur import blur_variance
from jaxdn.filters.edge_stopping import Weight, luminance_weight
from jaxdn.filters.stencil_tiles import PaddedGuides, pad_guides, plan_tiles, weighted_sums

_Planes = tuple[list[jax.Array], list[jax.Array]]


def cascade(
    color: jax.Array,
    variance: jax.Array,
    hit: jax.Array | None,
    weights: Callable[[jax.Array], Sequence[Weight]],
    taps: np.ndarray,
    *,
    levels: int,
    sigma_luminance: float | jax.Array,
    texture: jax.Array | None = None,
    feedback: jax.Array | None = None,
    feedback_level: int = 0,
) -> tuple[jax.Array, jax.Array]:
    """The image [3, H, W] after all levels, and the one after ``feedback_level`` (Schied et al. 2017, sec. 4.3).

    Args:
      color: [3, H, W].
      variance: [H, W] of its luminance.
      hit: [H, W] bool, a surface is seen; None: everywhere.
      weights: level, counted from 0 -> its edge-stopping weights, without that of luminance. Their planes must be the
        same at every level.
      taps: rows of (dy, dx, h), spaced ``2**level`` pixels apart.
      levels: number of levels.
      sigma_luminance: tolerated difference in luminance, in standard deviations; one number, or [levels].
      texture: [3, H, W] what a division left, filtered with the colour and given back (:func:`jaxdn.brdf.restore`).
      feedback: the second result for ``feedback_level`` 0; None: ``color``.
      feedback_level: counted from 1.
    """
    second = color if feedback is None else feedback
    if not levels:
        return color, second
    if texture is not None:
        color, second = (jnp.concatenate([light, texture]) for light in (color, second))
    at = jnp.broadcast_to(jnp.asarray(sigma_luminance, color.dtype), (levels,))
    image, second = _levels(color, variance, hit, weights, taps, at, second, feedback_level)
    if texture is None:
        return image, second
    image, second = (brdf.restore(light[:3], texture, light[3:]) for light in (image, second))
    return image, second


def _levels(
    color: jax.Array,
    variance: jax.Array,
    hit: jax.Array | None,
    weights: Callable[[jax.Array], Sequence[Weight]],
    taps: np.ndarray,
    sigmas: jax.Array,
    feedback: jax.Array,
    feedback_level: int,
) -> tuple[jax.Array, jax.Array]:
    """``color`` [C, H, W] after a level for each of ``sigmas``, and after ``feedback_level``; 0: ``feedback``.

    The planes stay on the canvas between the levels: to put them there again for each one took half of the time.
    """
    (height, width), levels = variance.shape, len(sigmas)
    tiles = plan_tiles(height, width, taps, step_max=2 ** (levels - 1))
    guides = pad_guides(tiles, weights(jnp.zeros((), jnp.int32)))
    inside = tiles.pad(jnp.ones((height, width), color.dtype) if hit is None else hit.astype(color.dtype))

    def filter_level(carry: _Planes, at: tuple[jax.Array, jax.Array]) -> tuple[_Planes, None]:
        (level, sigma), (planes, feedback) = at, carry
        *colors, variance, light = planes
        deviation = jnp.sqrt(jnp.maximum(blur_variance(tiles.crop(variance)), 1e-10))
        alike = luminance_weight(tiles.crop(light), deviation, sigma=sigma)
        stops = [*weights(level), alike]
        own = PaddedGuides([*guides.there, [light]], [*guides.here, [tiles.pad_rows(plane) for plane in alike.here]])

        def strip(top: jax.Array) -> list[jax.Array]:
            mean, spread = weighted_sums(tiles, top, taps, 2**level, stops, own, colors, inside, variance).mean()
            assert spread is not None
            seen = tiles.shifted(top, inside, jnp.asarray(tiles.margin, jnp.int32)) > 0
            return [jnp.where(seen, plane, 0.0) for plane in (*mean, spread, luminance(mean))]

        new = tiles.map_strips(strip)
        kept = [jnp.where(level + 1 == feedback_level, *pair) for pair in zip(new[:-2], feedback, strict=True)]
        return (new, kept), None

    # Masked pixels enter as zeros in the sums and in the sum of weights.
    planes = [tiles.pad(plane) * inside for plane in (*color, variance, luminance(color))]
    carry = planes, [tiles.pad(plane) for plane in feedback]
    carry, _ = lax.scan(filter_level, carry, (jnp.arange(levels, dtype=jnp.int32), sigmas))
    last, kept = (jnp.stack([tiles.crop(plane) for plane in each[: len(color)]]) for each in carry)
    return last, kept
