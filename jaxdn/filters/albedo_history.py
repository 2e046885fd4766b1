"""A history that takes its texture from the new frame's albedo, as far as the new image does.

A texture that is fetched from the last frame is blurred; the new frame's albedo shows it sharp. Next to the history h
of the light its albedo A is kept, fetched and blended with the same weights. Where the light falls evenly, h / A is the
light on the surface, however both are blurred, and the history with the new albedo a is ``h (a + e) / (A + e)``.

That is wrong where the albedo is noisy (fog, leaves, a lens out of focus), and where it is not what a surface
reflects. The new image y tells: the share c of the albedo's change that it shows is the regression of ``y - h`` on
``g = h ((a + e) / (A + e) - 1)`` in a window W of 7x7 pixels,

    c = sum_W (y - h) g / sum_W g^2, in [0, 1], with weights 1 / (y^2 + h^2).

The history becomes ``h + c g``, and its albedo ``A + c (a - A)``: so c may differ from frame to frame.
"""

import jax
import jax.numpy as jnp

from jaxdn.filters.kalman import box_sum
from jaxdn.ops.scales import add_planes

RECEPTIVE_FIELD = 3
"""Radius in pixels of the window."""
_FLOOR = 0.02
"""e: what is black has no texture to follow."""
_LEAST_LIGHT = 1e-8
"""The least ``y^2 + h^2``, of a photograph whose middle grey is 0.18."""


def follow_albedo(history: jax.Array, before: jax.Array, albedo: jax.Array, share: jax.Array) -> jax.Array:
    """The ``history`` [3, H, W] of albedo ``before`` with ``share`` [H, W] of the change to the new ``albedo``."""
    return history * (1.0 + share[None] * _change(before, albedo))


def measure_share(
    history: jax.Array, before: jax.Array, albedo: jax.Array, image: jax.Array, exposure: jax.Array
) -> jax.Array:
    """[H, W] the share c in [0, 1] of the albedo's change that the new ``image`` shows. All images are [3, H, W].

    ``exposure`` is the factor that makes radiance as bright as a photograph.
    """
    history, image = exposure * history, exposure * image
    change = history * _change(before, albedo)
    weight = 1.0 / ((add_planes(image) / 3.0) ** 2 + (add_planes(history) / 3.0) ** 2 + _LEAST_LIGHT)
    both = add_planes((image - history) * change)
    own = add_planes(change**2)
    both, own = box_sum(jnp.stack([weight * both, weight * own]), RECEPTIVE_FIELD)
    some = own > 0
    return jnp.clip(jnp.where(some, both / jnp.where(some, own, 1.0), 0.0), 0.0, 1.0)


def _change(before: jax.Array, albedo: jax.Array) -> jax.Array:
    return (albedo - before) / (jnp.maximum(before, 0.0) + _FLOOR)
