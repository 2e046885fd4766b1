"""Small fixed blurs."""

import jax
import jax.numpy as jnp


def blur_variance(variance: jax.Array) -> jax.Array:
    """[H, W] blurred by (1, 2, 1) x (1, 2, 1) / 16 with the edge repeated."""
    height, width = variance.shape
    wide = jnp.pad(variance, 1, mode="edge")
    rows = (wide[:height] + 2 * wide[1 : height + 1] + wide[2:]) / 4
    return (rows[:, :width] + 2 * rows[:, 1 : width + 1] + rows[:, 2:]) / 4
