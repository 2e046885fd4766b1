"""The a-trous cascade: levels of sparse averages, each twice as wide, guided by the variance that the last one left."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn import brdf
from jaxdn.filters.accumulation import luminance
from jaxdn.filters.atrous import edge_average
from jaxdn.filters.blur import blur_variance
from jaxdn.filters.weights import Weight, luminance_weight

_Planes = tuple[jax.Array, jax.Array, jax.Array]


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
      weights: level, counted from 0 -> its edge-stopping weights, without that of luminance.
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

    def filter_level(carry: _Planes, at: tuple[jax.Array, jax.Array]) -> tuple[_Planes, None]:
        (level, sigma), (color, variance, feedback) = at, carry
        deviation = jnp.sqrt(jnp.maximum(blur_variance(variance), 1e-10))
        light = luminance_weight(luminance(color[:3]), deviation, sigma=sigma)
        color, spread = edge_average(
            color, hit, [*weights(level), light], taps, step=2**level, step_max=2 ** (levels - 1), variance=variance
        )
        assert spread is not None
        return (color, spread, jnp.where(level + 1 == feedback_level, color, feedback)), None

    at = (jnp.arange(levels, dtype=jnp.int32), jnp.broadcast_to(jnp.asarray(sigma_luminance, color.dtype), (levels,)))
    carry = (color, variance, second)
    (color, _, second), _ = lax.scan(filter_level, carry, at)
    if texture is None:
        return color, second
    image, kept = (brdf.restore(light[:3], texture, light[3:]) for light in (color, second))
    return image, kept
