"""A steady luminance: that of a long mean, as far as it lies within what the new image shows around the pixel."""

import jax
import jax.numpy as jnp

from jaxdn.filters.accumulation import luminance
from jaxdn.filters.clamping import measure_neighbourhood

_DARKEST = 1e-6
"""Colours of less luminance keep theirs: nothing is known of the hue of black."""


def stabilise(
    color: jax.Array, past: jax.Array, share: jax.Array, hit: jax.Array | None, *, sigma: float
) -> tuple[jax.Array, jax.Array]:
    """``color`` [3, H, W] with a luminance that flickers less, and that luminance [H, W], to be kept.

    The kept luminance of the last frame is clamped to mean and ``sigma`` deviations of the luminance l in 3x3 pixels,
    and l moves towards it by ``share``; the colour is scaled to what results.

    Args:
      color: the new image.
      past: [H, W] the luminance that was kept, where the pixel's content was.
      share: [H, W] in [0, 1), of the past; 0 where there is none.
      hit: [H, W] bool, a surface is seen; None: everywhere.
      sigma: half size of the clamp.
    """
    level = luminance(color)
    mean, deviation, _ = (
        each[0] if each.ndim == 3 else each for each in measure_neighbourhood(level[None], hit, radius=1)
    )
    low, high = jnp.minimum(mean - sigma * deviation, level), jnp.maximum(mean + sigma * deviation, level)
    steady = level + share * (jnp.clip(past, low, high) - level)
    lit = level > _DARKEST
    return color * jnp.where(lit, steady / jnp.where(lit, level, 1.0), 1.0)[None], jnp.where(lit, steady, level)
