"""Blending a new frame into its history: colour, moments of luminance, history length, texture, as planes [9, H, W].

The texture is what dividing by a reflectance left of it (:func:`jaxdn.brdf.texture_left`). Light of another frame had
that of its own reflectance, so it is averaged with the weights of the light; then :func:`with_texture` tells what the
history is with the texture of today.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxdn import brdf

_LUMINANCE = (0.2126, 0.7152, 0.0722)


def luminance(planes: jax.Array | Sequence[jax.Array]) -> jax.Array:
    """Rec.709 luminance [H, W] of planar colour, the first three of ``planes`` [H, W]."""
    red, green, blue = _LUMINANCE
    return red * planes[0] + green * planes[1] + blue * planes[2]


def accumulate(
    past: jax.Array,
    now: jax.Array,
    *,
    alpha: float,
    alpha_moments: float,
    history_max: int,
    ramp: bool = True,
    texture: jax.Array | None = None,
    change: jax.Array | None = None,
) -> jax.Array:
    """The history [9, H, W] with colour ``now`` [3, H, W] blended in.

    Planes are colour, the first and second moment of its luminance, the history length N in frames, and the mean
    texture (3). The new frame has the weight ``a = max(alpha, 1 / N)``: without a history, the result is the new frame.
    (Schied et al. 2017, sec. 4.1 and 4.2, have a constant alpha; 1 / N is that of later implementations.) Without
    ``ramp`` it is alpha wherever there is a history. Where light has changed by a share ``c``, the weight is ``(1 - c)
    a + c`` (Schied et al. 2018), and N becomes ``N / (1 - c + c N)``, the length that this share is worth.

    Args:
      past: the history [9, H, W], 0 where there is none; its first six planes suffice without ``texture``.
      now: colour of the new frame [3, H, W].
      alpha: minimum weight of the new frame in colour.
      alpha_moments: minimum weight of the new frame in the moments.
      history_max: maximum of N.
      ramp: the weight is at least 1 / N.
      texture: [3, H, W] what a division left in the new frame; None: the history has no such planes.
      change: [H, W] in [0, 1], the share by which the history is outdated; None: nothing has changed.
    """
    level = luminance(now)
    length = jnp.minimum(past[5] + 1.0, history_max)
    least = find_least_share(past[5], length, ramp=ramp)
    share = jnp.maximum(alpha, least)
    share_moments = jnp.maximum(alpha_moments, least)
    if change is not None:
        share = share + change * (1.0 - share)
        share_moments = share_moments + change * (1.0 - share_moments)
        length = length / (1.0 - change + change * length)
    color = past[:3] + share[None] * (now - past[:3])
    moments = past[3:5] + share_moments[None] * (jnp.stack([level, level * level]) - past[3:5])
    planes = [color, moments, length[None]]
    if texture is not None:
        planes.append(past[6:9] + share[None] * (texture - past[6:9]))
    return jnp.concatenate(planes)


def find_least_share(past: jax.Array, length: jax.Array, *, ramp: bool) -> jax.Array:
    """[H, W] what a new frame weighs at least: 1 / ``length``, or without ``ramp`` 1 where there is no ``past`` else 0.

    Both are lengths [H, W] in frames, before and after the frame.
    """
    return 1.0 / length if ramp else (past <= 0).astype(length.dtype)


def with_texture(history: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
    """A history [6, H, W] of light that had the texture ``before`` [3, H, W], as that of light with ``after``.

    Colour is restored by :func:`jaxdn.brdf.restore`, the moments as grey light would be; the length stays. Exchanging
    ``before`` and ``after`` is the inverse.
    """
    grey = texture_ratio(before, after)
    colour = brdf.restore(history[:3], after, before)
    return jnp.concatenate([colour, jnp.stack([history[3] * grey, history[4] * grey * grey, history[5]])])


def texture_ratio(before: jax.Array, after: jax.Array) -> jax.Array:
    """By what [H, W] grey light changes whose texture was ``before`` [3, H, W] and is ``after``."""
    old = luminance(before)
    return brdf.restore(jnp.ones_like(old), luminance(after), old)


def after_shift(moments: jax.Array, shift: jax.Array) -> jax.Array:
    """Moments [2, H, W] of luminance after the mean has changed by ``shift`` [H, W], and the variance has not."""
    mean = jnp.maximum(moments[0] + shift, 0.0)
    spread = jnp.maximum(moments[1] - moments[0] ** 2, 0.0)
    return jnp.stack([mean, mean * mean + spread])
