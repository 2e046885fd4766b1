"""Where a reflection was: the virtual image behind a mirror moves unlike the mirror's surface.

A flat mirror shows a reflected point as if it lay behind the surface, on the same camera ray, by as much as the path
goes on after its first hit: at the distance t + h for a camera ray of length t and a hit distance h. The virtual image
is followed instead of the surface, the more so the smoother the surface is. Distances are kept as the closeness
``t / (t + h)``: 1 for a reflected thing that touches the surface, near 0 for one that is far away, and 0 for an unknown
hit distance.
"""

import jax
import jax.numpy as jnp

from jaxdn.core.frame import Frame


def closeness(hit_distance: jax.Array, ray_length: jax.Array) -> jax.Array:
    """``t / (t + h)`` in (0, 1] of hit distances h and camera rays' lengths t; 0 where h is 0, which means unknown."""
    known = hit_distance > 0
    return jnp.where(known, ray_length / jnp.where(known, ray_length + hit_distance, 1.0), 0.0)


def closeness_of(hit_distance: jax.Array | None, frame: Frame) -> jax.Array | None:
    """[H, W] closeness of one of the frame's hit distances; None without it or anything to compare it to."""
    length = frame.depth if frame.ray_length is None else frame.ray_length
    if hit_distance is None or length is None:
        return None
    return closeness(hit_distance, length)[..., 0]


def diffuseness(roughness: jax.Array) -> jax.Array:
    """``(1 - 2^(-200 r^2)) r^(1/4)``: 0 for a mirror, 1 at roughness 1; how far a reflection sticks to its surface.

    The curve of real-time denoisers for specular light; with a finite slope at 0.
    """
    rough = roughness > 0
    safe = jnp.where(rough, roughness, 1.0)
    return jnp.where(rough, -jnp.expm1(-200.0 * jnp.log(2.0) * safe * safe) * safe**0.25, 0.0)


def virtual_motion(
    motion: jax.Array, far_motion: jax.Array, stretch: jax.Array | None, closeness: jax.Array
) -> jax.Array:
    """Motion [H, W, 2] of the virtual image in a flat mirror, in pixels.

    A point on the camera ray at view-space depth z projects to the previous image at homogeneous coordinates that are
    affine in 1 / z. From those of the surface (1 / z, motion m, previous depth z') and of infinity (0, motion m_far)
    follow those of the virtual image, at ``1 / z`` times the closeness c::

        ((1 - c) m_far + c s m) / ((1 - c) + c s),    s = z' / z

    This is exact but for the change of depth of what is infinitely far away, which a turn of the camera by an angle a
    causes (1 - cos a, and tan a times the distance from the image's centre).

    Args:
      motion: of the surface [H, W, 2].
      far_motion: of infinity [H, W, 2].
      stretch: z' / z [H, W]; None: 1.
      closeness: [H, W] of the reflected thing; where it is 0, which means unknown, the result is ``motion``.
    """
    known = closeness > 0
    near = (closeness if stretch is None else closeness * stretch)[..., None]
    far = 1.0 - closeness[..., None]
    return jnp.where(known[..., None], (far * far_motion + near * motion) / (far + near + 1e-20), motion)
