"""Transfer curves of linear radiance for networks, losses, metrics and display, and the luminance."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp

from jaxdn.core.checks import check_option
from jaxdn.core.frame import RADIANCE_MAX
from jaxdn.core.numerics import safe_norm

if TYPE_CHECKING:
    from jaxtyping import Array, Float


_GAMMA = 2.2
_TOE = 1e-4
"""Below this log(1 + x), ``compress`` is a straight line, as the power has an infinite slope at 0."""
_TOE_VALUE = _TOE ** (1 / _GAMMA)
_TOE_SLOPE = _TOE_VALUE / _TOE
"""About 152."""
CURVE = (1 / _GAMMA, _TOE, _TOE_SLOPE)
"""Of :func:`compress`: its power, the end of its toe and the slope there."""
_TOP = 64.0
"""``expand`` saturates at the largest finite number divided by this, so that its slope stays finite too."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear Rec.709 red, green and blue (ITU-R BT.709)."""

OPERATORS = ("srgb", "aces", "reinhard", "compress")
"""The operators of ``tonemap``."""
Operator = Literal["srgb", "compress", "aces", "reinhard"]


def compress(x: Float[Array, ...]) -> Float[Array, ...]:
    """Compress radiance for networks and losses: ``log(1 + x)^(1 / 2.2)``, elementwise.

    Below log(1 + x) = 1e-4 it is the line ``152 log(1 + x)`` through the origin that meets the curve there: continuous,
    increasing, slope 152 at 0 instead of infinity. Odd: ``compress(-x) = -compress(x)``, so that a negative prediction
    still has a gradient. Value and slope are finite for every float; infinity counts as the largest finite number
    (7.7 in float32). NaN stays NaN.

    Hasselgren et al. 2020, "Neural Temporal Adaptive Sampling and Denoising", sec. 2.2; the toe and the odd
    continuation are ours.
    """
    x = _floating(x)
    size = jnp.where(x >= 0, x, -x)  # not abs: its derivative of 0 at 0 would stop learning at black pixels
    u = jnp.log1p(jnp.minimum(size, float(jnp.finfo(x.dtype).max)))
    toe = u <= _TOE
    y = jnp.where(toe, _TOE_SLOPE * u, _power(jnp.where(toe, 1.0, u), 1 / _GAMMA))
    return jnp.where(x >= 0, y, -y)


def expand(y: Float[Array, ...]) -> Float[Array, ...]:
    """The inverse of ``compress``, elementwise: ``exp(y^2.2) - 1``, linear in the toe, odd.

    Value and slope are finite for every float: it saturates at 1/64 of the largest finite number (5e36 in float32).
    """
    y = _floating(y)
    top = math.log(float(jnp.finfo(y.dtype).max) / _TOP)
    size = jnp.minimum(jnp.where(y >= 0, y, -y), top ** (1 / _GAMMA))
    toe = size <= _TOE_VALUE
    u = jnp.where(toe, size / _TOE_SLOPE, _power(jnp.where(toe, 1.0, size), _GAMMA))
    x = jnp.expm1(u)
    return jnp.where(y >= 0, x, -x)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _power(x: jax.Array, exponent: float) -> jax.Array:
    """``x^exponent`` for x > 0 as ``exp(exponent log x)``, which XLA:CPU vectorises: a seventh of the time.

    Its relative error is ``|exponent log x|`` roundings, at most ten for the arguments in this module.
    """
    return jnp.exp(exponent * jnp.log(x))


@_power.defjvp
def _power_slope(exponent: float, primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    """``exponent x^(exponent - 1)`` directly: x^exponent / x of the chain rule overflows where expand saturates."""
    (x,), (tangent,) = primals, tangents
    return _power(x, exponent), exponent * _power(x, exponent - 1) * tangent


def exposure(radiance: Float[Array, "H W 3"]) -> Float[Array, ""]:
    """The factor (a scalar) that makes linear radiance [H, W, 3] as bright as a photograph: 0.18 in the mean.

    ``0.18 / exp(mean(log L))`` over the mean luminances L of blocks of 16x16 pixels that are not black; 1 for a black
    image. Means of blocks first: of single noisy pixels the logarithm is mostly noise. Twice the light halves the
    factor, so that what is computed from ``exposure(x) * x`` does not depend on the unit of radiance. No gradient.
    """
    return exposure_of(brightness(radiance))


def brightness(radiance: Float[Array, "H W 3"]) -> Float[Array, 2]:
    """[2] what :func:`exposure` is made of: the sum of log L over blocks that are not black, and their number.

    Those of images that lie side by side, with sides of whole blocks, add up to that of both. No gradient.
    """
    light = jnp.minimum(jax.lax.stop_gradient(radiance), RADIANCE_MAX)
    height, width = light.shape[:2]
    block = [min(16, size) for size in (height, width)]
    # Rows and columns beyond the last whole block have no say.
    rows, columns = (size // side for size, side in zip((height, width), block, strict=True))
    light = light[: rows * block[0], : columns * block[1]]
    # Whole rows are added first, which vectorises; a product adds the columns.
    sums = luminance(light.reshape(rows, block[0], -1).sum(1).reshape(rows, -1, 3))[..., 0]
    own = jnp.repeat(jnp.eye(columns, dtype=light.dtype), block[1], axis=0) / (block[0] * block[1])
    means = jax.lax.dot(sums, own, precision="highest")
    lit = means > 0
    logs = jnp.where(lit, jnp.log(jnp.where(lit, means, 1.0)), 0.0)
    return jnp.stack([jnp.sum(logs), jnp.sum(lit, dtype=light.dtype)])


def exposure_of(brightness: Float[Array, 2]) -> Float[Array, ""]:
    """The :func:`exposure` of an image with this :func:`brightness`."""
    logs, count = brightness
    return jnp.where(count > 0, _MIDDLE_GREY * jnp.exp(-logs / jnp.maximum(count, 1)), 1.0)


_MIDDLE_GREY = 0.18


def luminance(image: Float[Array, "... 3"]) -> Float[Array, "... 1"]:
    """Rec.709 luminance ``0.2126 R + 0.7152 G + 0.0722 B`` of linear radiance [..., 3], as [..., 1]."""
    image = _floating(image)
    if image.ndim == 0 or image.shape[-1] != 3:
        raise ValueError(f"image: expected 3 channels in the last axis, got shape {image.shape}.")
    red, green, blue = LUMINANCE
    return red * image[..., 0:1] + green * image[..., 1:2] + blue * image[..., 2:3]


def luminance_of_planes(planes: Float[Array, "3 H W"]) -> Float[Array, "H W"]:
    """The same of planes [3, H, W], as [H, W]."""
    red, green, blue = (weight * plane for weight, plane in zip(LUMINANCE, planes, strict=True))
    return red + green + blue


def tonemap(image: Float[Array, "... 3"], *, operator: Operator = "srgb") -> Float[Array, "... 3"]:
    """Linear radiance [..., 3] to display-encoded values in [0, 1] of the same shape, for metrics and for display.

    Radiance is first clamped to [0, 65504]; a NaN stays NaN. ``operator``:

    * ``"srgb"``: clipped at 1, then the sRGB curve (IEC 61966-2-1).
    * ``"aces"``: ``x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14)``, clipped at 1, then the sRGB curve
      (Narkowicz 2015, "ACES filmic tone mapping curve", without its optional exposure of 0.6).
    * ``"reinhard"``: ``x / (1 + luminance(x))``, clipped at 1, then the sRGB curve (Reinhard et al. 2002, eq. 3).
    * ``"compress"``: ``compress(x) / compress(65504)``: the domain in which the networks are trained.
    """
    check_option(operator, "operator", OPERATORS)
    x = jnp.clip(_floating(image), 0.0, RADIANCE_MAX)
    if operator == "compress":
        return compress(x) / (math.log1p(RADIANCE_MAX) ** (1 / _GAMMA))
    if operator == "aces":
        x = x / (1.0 + x)  # numerator and denominator divided by (1 + x)^2: half-precision squares overflow
        rest = 1.0 - x
        x = x * (2.51 * x + 0.03 * rest) / (x * (2.43 * x + 0.59 * rest) + 0.14 * rest * rest)
    elif operator == "reinhard":
        x = x / (1.0 + luminance(x))
    return srgb_encode(jnp.minimum(x, 1.0))


def tonemap_halves(
    first: Float[Array, "... 3"], second: Float[Array, "... 3"], *, operator: Operator = "srgb"
) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Two halves of a reference, such that errors of tone-mapped images against them are free of the reference's noise.

    ``first`` and ``second`` [..., 3] are independent noisy radiance with the same expectation r. Tone-mapped one by
    one they are darker than t(r) on average, as the curve t is concave and ends at 1. So the two images returned are
    made for their product: for any image x,

    ``(x - A) (x - B) = 2 (x - t(mean))^2 - ((x - t(first))^2 + (x - t(second))^2) / 2``.

    The noise of a half has twice the variance of that of their mean: what the variance adds to the expectation cancels
    on the right (Quenouille's jackknife, 1956), and terms of the fourth order in the noise stay. Where the reference is
    as noisy as the image is wrong, and the plain PSNR 3 dB off, the PSNR of this product is within 0.1 dB of the truth
    for gamma noise of 9 to 26 % in a half (0.3 dB for log-normal noise of 26 %, which has heavier tails); that of
    t(first) and t(second) is 0.4 to 1.2 dB off if the image is too bright or too dark throughout. ``operator`` as in
    :func:`tonemap`; values may lie a little outside [0, 1].
    """
    both, one, other = (
        tonemap(half, operator=operator) for half in (0.5 * _floating(first) + 0.5 * _floating(second), first, second)
    )
    center = 2.0 * both - 0.5 * (one + other)
    apart = safe_norm(jnp.stack([0.5 * (one - other), 2**0.5 * (both - 0.5 * (one + other))], axis=-1))[..., 0]
    apart = jnp.where(one < other, -apart, apart)
    return center + apart, center - apart


def srgb_encode(x: Float[Array, ...]) -> Float[Array, ...]:
    """Linear light in [0, 1] to sRGB code values, elementwise (IEC 61966-2-1)."""
    toe = x <= 0.0031308
    return jnp.where(toe, 12.92 * x, 1.055 * jnp.where(toe, 1.0, x) ** (1 / 2.4) - 0.055)


def srgb_decode(y: Float[Array, ...]) -> Float[Array, ...]:
    """sRGB code values in [0, 1] to linear light, elementwise (IEC 61966-2-1)."""
    toe = y <= 0.04045
    return jnp.where(toe, y / 12.92, ((jnp.where(toe, 1.0, y) + 0.055) / 1.055) ** 2.4)


def _floating(x: jax.Array) -> jax.Array:
    return jnp.asarray(x, jnp.result_type(x, float))
