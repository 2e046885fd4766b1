"""Which vector leads a pixel to its history, where a method has one history for all light.

Shadows and reflections do not move with the surfaces that show them. A method of one signal follows what decides about
most of a pixel's light; ``trmv`` follows each part of it.
"""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn.core.frame import Array, Frame

Vectors = Literal["dual", "traditional", "effects"]
"""Which vectors lead to the history, see :func:`choose_vectors`."""
_MOSTLY = 0.5
"""The share of what a surface reflects from which on its pixel follows the reflection."""
READS: dict[Vectors, frozenset[str]] = {
    "traditional": frozenset({"motion"}),
    "dual": frozenset({"motion", "dual_motion"}),
    "effects": frozenset({
        *("motion", "dual_motion", "shadow_motion", "glossy_motion"),
        *("albedo", "reflectance", "specular_reflectance"),
    }),
}  # fmt: skip
"""Buffers that the vectors are made of."""


def choose_vectors(frame: Frame, vectors: Vectors) -> Array:
    """The vectors [H, W, 2] in pixels; None: the history lies at the pixel itself.

    ``"traditional"``: those of the surface; ``"dual"``: ``dual_motion``, or the former without it; ``"effects"``: where
    specular lobes reflect more than half of what the surface does, those of the reflection (``glossy_motion``), and
    elsewhere those of a shadow that passes (``shadow_motion``), each where they are finite and differ from the
    surface's; else the dual ones.
    """
    if vectors == "traditional":
        return frame.motion
    chosen = frame.motion if frame.dual_motion is None else frame.dual_motion
    if vectors == "dual":
        return chosen
    follow: list[tuple[jax.Array, jax.Array | bool]] = []
    if frame.shadow_motion is not None:
        follow.append((frame.shadow_motion, True))
    if frame.glossy_motion is not None and frame.specular_reflectance is not None:
        whole = frame.albedo if frame.reflectance is None else frame.reflectance
        most = _MOSTLY * (jnp.ones_like(frame.radiance) if whole is None else whole)
        follow.append((frame.glossy_motion, jnp.sum(frame.specular_reflectance - most, axis=-1) > 0))
    still = 0.0 if frame.motion is None else frame.motion
    for vector, where in follow:
        other = jnp.all(jnp.isfinite(vector), axis=-1) & jnp.any(vector != still, axis=-1) & where
        chosen = jnp.where(other[..., None], vector, 0.0 if chosen is None else chosen)
    return chosen
