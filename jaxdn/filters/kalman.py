"""A Kalman filter for each pixel, whose process noise is what the new frame's own light shows of a change.

What is filtered is an image with little noise, such as a denoiser's, whose errors differ from frame to frame. Its
history is outdated where light has changed, and no guide tells where. The noisy frame does, whose mean is the truth:
where the history is right, the noisy frame minus the history is noise, and has nothing to do with how the new image
differs from the history. Where light has changed, both differ from it alike.

For a pixel with new image y, noisy radiance x, history h, and the windows W of 7x7 and 15x15 pixels around it:

* innovation ``d = y - h``, residual ``e = x - h``, at most 3 deviations of x or as large as d; noise variance v of x;
* regression of the residual on the innovation, ``a = sum_W e d / v``, ``b = sum_W d^2 / v``: its slope ``a / b`` has
  the standard error ``1 / sqrt(b)``;
* support ``s = max_W (a / b - 3.5 / sqrt(b))`` in [0, 1]: the share of the innovation that is surely a change;
* process noise ``q = s^2 mean(d^2)`` over 3x3 pixels, plus ``b^2 (2 - k')^2 / k'`` for the last gain k';
* gain ``k = (p + q) / (p + q + r)``, image ``h + k d``, and error variance ``p' = k r`` of the next history.

b is what one fetch of the history errs by (:mod:`jaxdn.filters.resampling`), in every frame alike: a history of gain k
errs by ``b (1 - k) / k``, besides the variance ``r k / (2 - k)``. Of the gains that stay, the one with the smallest
sum of squares has ``b^2 / r = k^3 / ((1 - k) (2 - k)^2)``, to which this process noise leads.

r is the variance of the new image's own errors, as far as they differ from frame to frame: the mean of ``(1 - s^2)
d^2 / (1 + p / r + (b / k')^2 / r)`` along motion; after the first frame half the mean of ``(1 - s^2) d^2 - (b / k')^2``
over 15x15 pixels. The gain follows 1, 1/2, 1/3 ... on a still surface. All thresholds are relative: k does not depend
on the unit of radiance.

Where x is no measurement, as a pixel without samples is 0, it says nothing of light: v is the mean over pixels that are
measured, and sums a and b are over these alone.

Rudolf Kalman, "A New Approach to Linear Filtering and Prediction Problems", 1960; gains from innovations: Raman Mehra,
"Approaches to Adaptive Filtering", 1972.
"""

import jax
import jax.numpy as jnp

from jaxdn.ops.scales import add_planes, join_planes

PLANES = 6
"""Of a history: colour, gain, deviation of the image's own errors, deviation of the noise."""
_WINDOWS = (3, 7)
"""Radii of the windows in which support is looked for."""
_NOISE_WINDOW = 3
"""Radius of the window in which noise is measured."""
RECEPTIVE_FIELD = 2 * max(_WINDOWS) + _NOISE_WINDOW
"""Radius in pixels of all that decides about one."""
_STANDARD_ERRORS = 3.5
"""How surely a change must be one: with fewer, small changes trail less, and still surfaces flicker more."""
_MOST_RESIDUAL = 3.0
"""Residuals beyond so many deviations count as these: an outlier, which the denoiser lets through, is no proof. Those
that the innovation has too count whole: a lamp without noise that goes out is no outlier."""
_SHARE = 0.2
"""Weight of the new frame in both variances."""
_MOST_GROWTH = 3.0
"""A frame counts as at most so many times the variance of the image's errors: one of many is no rule."""
_LEAST_NOISE = 1e-4
"""Deviation of noise, relative to a photograph's 0.18 of middle grey, below which light has none."""


def kalman_blend(
    past: jax.Array,
    valid: jax.Array,
    image: jax.Array,
    noisy: jax.Array,
    exposure: jax.Array,
    fetch_error: jax.Array | None = None,
    measured: jax.Array | None = None,
    *,
    history_max: int,
) -> jax.Array:
    """The history [6, H, W] with a new image blended in; its first three planes are the stable image.

    No gradient flows through the gains.

    Args:
      past: the last history, where it is now.
      valid: [H, W] bool, there is one.
      image: [3, H, W] the new image.
      noisy: [3, H, W] the radiance that it was made of.
      exposure: scalar, the factor that makes radiance as bright as a photograph.
      fetch_error: [H, W] the square of what the fetch of the history errs by; None: nothing moves.
      measured: [H, W] bool, ``noisy`` is the mean of samples; None: everywhere.
      history_max: the gain is at least its inverse.
    """
    bias = jnp.zeros_like(image[0]) if fetch_error is None else exposure**2 * fetch_error
    seen = jnp.ones_like(image[0]) if measured is None else measured.astype(image.dtype)
    gain, flicker, noise = jax.lax.stop_gradient(
        _update(past, valid, exposure * image, exposure * noisy, exposure, bias, seen, history_max)
    )
    # Joined by a loop on CPUs: XLA would compute the gain once for each colour.
    tracked = join_planes([("planes", plane[None]) for plane in (gain, flicker / exposure, noise / exposure)])
    color = image + (1.0 - tracked[:1]) * jnp.where(valid[None], past[:3] - image, 0.0)
    return jnp.concatenate([color, tracked])


def _update(
    past: jax.Array,
    valid: jax.Array,
    image: jax.Array,
    noisy: jax.Array,
    exposure: jax.Array,
    bias: jax.Array,
    seen: jax.Array,
    history_max: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The gain, and the deviations of the image's own errors and of the noise, each [H, W], all times ``exposure``."""
    inside = valid.astype(image.dtype)
    before = jnp.where(valid, past[3], 0.0)
    last = jnp.maximum(before, 1.0 / history_max)
    drift, total_bias = (jnp.where(valid, bias * factor, 0.0) for factor in ((2.0 - last) ** 2 / last, 1.0 / last**2))
    innovation = (image - exposure * past[:3]) * inside[None]
    residual = (noisy - exposure * past[:3]) * inside[None]
    noise, tracked_noise = _measure_noise(image, noisy, seen, jnp.where(valid, (exposure * past[5]) ** 2, 0.0))
    # Without a measurement the residual is minus the history: it would prove any light that falls a little.
    support = measure_support(residual, seen[None] * innovation, jnp.maximum(noise, _LEAST_NOISE**2))
    square = _mean_square(innovation)
    unexplained = (1.0 - support**2) * square
    *sums, number = box_sum(jnp.stack([square, unexplained, inside]), 1)
    changed, own = (each / jnp.maximum(number, 1.0) for each in sums)
    flicker = jnp.where(valid, (exposure * past[4]) ** 2, 0.0)
    # After one frame the innovation has the errors of two images.
    around = box_sum(jnp.stack([jnp.maximum(unexplained - total_bias, 0.0), inside]), max(_WINDOWS))
    flicker = jnp.where(flicker > 0, flicker, 0.5 * around[0] / jnp.maximum(around[1], 1.0))
    error = before * flicker + support**2 * changed + drift
    total = error + flicker
    gain = jnp.where(total > 0, error / jnp.where(total > 0, total, 1.0), 1.0)
    gain = jnp.where(valid, jnp.maximum(gain, 1.0 / history_max), 1.0)
    some = jnp.where(flicker > 0, flicker, 1.0)
    sample = jnp.minimum(own / (1.0 + before + total_bias / some), _MOST_GROWTH * flicker)
    flicker = jnp.where(valid, flicker + _SHARE * (sample - flicker), 0.0)
    return gain, _root(flicker), _root(tracked_noise)


def _measure_noise(
    image: jax.Array, noisy: jax.Array, seen: jax.Array, before: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The noise variance that counts now, and the one to be kept [H, W]. ``seen`` [H, W] is 1 where noise is, else 0.

    Where few samples find the light, a window may show none of it: what was seen before counts too.
    """
    total, number = box_sum(jnp.stack([seen * _mean_square(noisy - image), seen]), _NOISE_WINDOW)
    now = jnp.where(number > 0, total / jnp.maximum(number, 1.0), before)
    return jnp.maximum(now, before), jnp.where(before > 0, before + _SHARE * (now - before), now)


def measure_support(residual: jax.Array, innovation: jax.Array, variance: jax.Array) -> jax.Array:
    """[H, W] in [0, 1]: the share of the ``innovation`` [3, H, W] that the ``residual`` [3, H, W] surely shows too.

    ``variance`` [H, W] > 0 is that of the residual's noise.
    """
    most = jnp.maximum(_MOST_RESIDUAL * jnp.sqrt(variance)[None], jnp.abs(innovation))
    products = (
        jnp.stack([add_planes(jnp.clip(residual, -most, most) * innovation), add_planes(innovation**2)])
        / variance[None]
    )
    support = jnp.zeros_like(variance)
    for radius in _WINDOWS:
        both, own = box_sum(products, radius)
        some = own > 0
        slope = (both - _STANDARD_ERRORS * _root(own)) / jnp.where(some, own, 1.0)
        support = jnp.maximum(support, jnp.where(some, slope, 0.0))
    return jnp.minimum(support, 1.0)


def box_sum(planes: jax.Array, radius: int) -> jax.Array:
    """The sum of each plane [C, H, W] over a square of ``2 radius + 1`` pixels; 0 counts beyond the border.

    Sums of 2, 4, 8 ... pixels are made of one another, so that a window of 15 takes six additions an axis.
    """
    for axis in (1, 2):
        size = planes.shape[axis]
        sums = jnp.pad(planes, [(radius, radius) if each == axis else (0, 0) for each in range(3)])
        width, total, begin = 1, None, 0
        for bit in bin(2 * radius + 1)[:1:-1]:
            if bit == "1":
                part = jax.lax.slice_in_dim(sums, begin, begin + size, axis=axis)
                total = part if total is None else total + part
                begin += width
            if sums.shape[axis] > width:
                length = sums.shape[axis] - width
                sums = jax.lax.slice_in_dim(sums, 0, length, axis=axis) + jax.lax.slice_in_dim(
                    sums, width, width + length, axis=axis
                )
            width *= 2
        assert total is not None  # an odd number has a bit
        planes = total
    return planes


def _mean_square(planes: jax.Array) -> jax.Array:
    """[H, W] the mean of the squares of planes [C, H, W]."""
    return add_planes(planes**2) / len(planes)


def _root(values: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.maximum(values, 0.0))
