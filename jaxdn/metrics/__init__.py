"""Error metrics of an image or a clip against its reference, one number each.

``image`` and ``reference`` are [H, W, C], or clips [T, H, W, C], of the same shape. Tone-map them first
(``color.tonemap``), except for ``relative_mse``, and state the operator with the number. ``mask`` [H, W, 1] or
[T, H, W, 1] restricts a metric to the pixels where it is above 0 (or true); pixels outside have no influence (SSIM and
FLIP use the neighbourhood of the pixels inside). Completely masked images count as identical.

A non-finite pixel makes the result non-finite: ignoring it would report too good a value. For finite images no metric
is NaN, and all gradients are finite.

Averages: MSE, L1, relative MSE, SSIM and FLIP are means over all pixels of all frames together. PSNR is the mean of
the frames' PSNRs, so one perfect frame makes it infinite: ``average="mse"`` gives the PSNR of the mean MSE instead.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp

from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.core.numerics import safe_norm
from jaxdn.core.separable import correlate, gaussian_taps
from jaxdn.metrics.flip import PIXELS_PER_DEGREE, flip_map

if TYPE_CHECKING:
    from typing import TypeAlias

    from jaxtyping import Array, Float, Shaped

    Clips: TypeAlias = Float[Array, "... H W C"]
    Mask: TypeAlias = Shaped[Array, "... H W 1"]
    Scalar: TypeAlias = Float[Array, ""]

_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5


def mse(image: Clips, reference: Clips, *, mask: Mask | None = None) -> Scalar:
    """Mean squared error over pixels and channels; 0 for an empty mask."""
    image, reference, inside = _prepare(image, reference, mask)
    return _mean((image - reference) ** 2, inside)


def l1(image: Clips, reference: Clips, *, mask: Mask | None = None) -> Scalar:
    """Mean absolute error over pixels and channels; 0 for an empty mask. ``l1 ** 2 <= mse``."""
    image, reference, inside = _prepare(image, reference, mask)
    return _mean(jnp.abs(image - reference), inside)


def relative_mse(image: Clips, reference: Clips, *, mask: Mask | None = None) -> Scalar:
    """Mean of ``(image - reference)^2 / (reference^2 + 0.01)`` on linear radiance; 0 for an empty mask.

    Rousselle et al. 2011, eq. 10; the constant varies in the literature.
    """
    image, reference, inside = _prepare(image, reference, mask)
    return _mean(_relative(image - reference, _relative_scale(reference)) ** 2, inside)


def unbiased_mse(image: Clips, first: Clips, second: Clips, *, mask: Mask | None = None) -> Scalar:
    """Mean of ``(image - first) (image - second)``: the squared error without the noise of the reference; 0 if empty.

    ``first`` and ``second`` are independent noisy references with the same expectation r, such as the means of the two
    halves of a reference's samples. Then the expectation is ``(image - r)^2``, as the errors of the two are
    independent, whereas the MSE against their mean adds the variance of that mean, and stops falling there. Tone
    mapping does not keep expectations: :func:`jaxdn.color.tonemap_halves` gives the two for a tone-mapped image. An
    estimate: for an image as good as the reference it may be negative.
    """
    image, first, inside = _prepare(image, first, mask)
    _, second, _ = _prepare(image, second, mask)
    return _mean((image - first) * (image - second), inside)


def unbiased_psnr(
    image: Clips,
    first: Clips,
    second: Clips,
    *,
    mask: Mask | None = None,
    peak: float = 1.0,
) -> Scalar:
    """``10 log10(peak^2 / MSE)`` in dB of :func:`unbiased_mse`, of a clip that of all its pixels together.

    Infinite where the estimate is not above 0: the image is as good as can be told.
    """
    return _decibels(jnp.maximum(unbiased_mse(image, first, second, mask=mask), 0.0), peak)


def unbiased_temporal_psnr(
    image: Clips,
    first: Clips,
    second: Clips,
    *,
    mask: Mask | None = None,
    peak: float = 1.0,
) -> Scalar:
    """:func:`temporal_psnr` without the reference's own noise, of all frame-to-frame differences together.

    :func:`unbiased_psnr` of ``x_i - x_{i-1}`` against the same differences of the two halves, which are as independent
    of each other as the halves. Takes clips [T, H, W, C]; infinite for a clip of one frame, and where the estimate is
    not above 0. ``mask`` and ``peak`` as in :func:`temporal_psnr`.
    """
    check_image(image, "image", rank=4)
    image, first = _pair(image, first)
    _, second = _pair(image, second)
    inside = _inside(image, mask)
    later = None if inside is None else inside[1:]
    change, *halves = (_hide(clip[1:], later) - _hide(clip[:-1], later) for clip in (image, first, second))
    products = (change - halves[0]) * (change - halves[1])
    if products.size == 0:
        return jnp.asarray(jnp.inf, products.dtype)
    return _decibels(jnp.maximum(_mean(products, later), 0.0), peak)


def unbiased_relative_mse(
    image: Clips,
    first: Clips,
    second: Clips,
    *,
    relative_to: Clips | None = None,
    mask: Mask | None = None,
) -> Scalar:
    """:func:`relative_mse` without the noise of the reference, from two independent halves of it; 0 if empty.

    The mean of ``w (image - first) (image - second) + 2 w' (image - m) d^2`` on linear radiance, with the mean m of the
    halves, half their difference d, the weight ``w = 1 / (m^2 + 0.01)`` and its derivative w'. The product alone is
    free of noise, but weighted by 1 / (m^2 + 0.01) it is not: a pixel whose reference is too bright by chance counts
    less. The second term removes this to the second order in the noise. A weight without that noise would not do:
    taken from the image it favours images that are too bright, taken from pixels around it mixes surfaces at edges.

    With noise of 9 % in a half and an error as large as the noise of their mean (where the plain one is 3 dB off) it is
    within 0.15 dB of the truth; at 18 % within 0.4 dB, without the second term up to 1.9 dB off. Too large rather than
    too small; an estimate may be negative. Where the noise has heavy tails, as indirect light has at a hundred samples,
    it is far too large. There give ``relative_to``, an image near the truth (denoised, from many samples) whose errors
    are independent of those of both halves and that is the same for all images that are compared: the weight is
    ``1 / (relative_to^2 + 0.01)``, and the product alone has the right expectation.
    """
    image, first, inside = _prepare(image, first, mask)
    _, second, _ = _prepare(image, second, mask)
    if relative_to is not None:
        scale = _relative_scale(_hide(_pair(image, relative_to)[1], inside))
        return _mean(_relative(image - first, scale) * _relative(image - second, scale), inside)
    mean, half = 0.5 * first + 0.5 * second, 0.5 * first - 0.5 * second
    scale = _relative_scale(mean)
    error, noise = _relative(image - mean, scale), _relative(half, scale)
    # w' = -2 m w^2; each factor is bounded before the product.
    return _mean(error**2 - noise**2 - 4 * (mean / scale) * error * noise**2, inside)


def psnr(
    image: Clips,
    reference: Clips,
    *,
    mask: Mask | None = None,
    peak: float = 1.0,
    average: Literal["frames", "mse"] = "frames",
) -> Scalar:
    """Peak signal-to-noise ratio in dB, ``10 log10(peak^2 / MSE)``; of a clip, the mean of its frames' PSNRs.

    Infinite where the two are identical, for a frame and so for its clip, with derivative 0.

    Args:
      image: [H, W, C] or a clip [T, H, W, C].
      reference: of the same shape.
      mask: see the module. Frames with an empty mask are left out of the mean; if all are empty it is infinite.
      peak: largest value. 255 on images in [0, 1] is the convention of Zeng et al. 2021, table 2: 48.13 dB more.
      average: ``"frames"``, or ``"mse"`` for the PSNR of the mean MSE.
    """
    check_option(average, "average", ("frames", "mse"))
    image, reference, inside = _prepare(image, reference, mask)
    return _psnr((image - reference) ** 2, inside, peak=peak, average=average)


def temporal_psnr(
    image: Clips,
    reference: Clips,
    *,
    mask: Mask | None = None,
    peak: float = 1.0,
    average: Literal["frames", "mse"] = "frames",
) -> Scalar:
    """PSNR of the frame-to-frame differences of two clips: measures flicker, independent of a constant error.

    Compares ``x_i - x_{i-1}`` with ``y_i - y_{i-1}`` at the same pixel, with sign, peak 1 although they span [-1, 1];
    the mean of T - 1 PSNRs (Hasselgren et al. 2020, "Neural Temporal Adaptive Sampling and Denoising", sec. 3).
    Infinite for two clips with equal differences, and for clips of one frame.

    Args:
      image: a clip [T, H, W, C].
      reference: of the same shape.
      mask: [T, H, W, 1]; a difference counts where the mask of its later frame is set.
      peak: as in ``psnr``.
      average: as in ``psnr``.
    """
    check_option(average, "average", ("frames", "mse"))
    check_image(image, "image", rank=4)
    image, reference = _pair(image, reference)
    inside = _inside(image, mask)
    later = None if inside is None else inside[1:]
    changes = [_hide(clip[1:], later) - _hide(clip[:-1], later) for clip in (image, reference)]
    return _psnr((changes[0] - changes[1]) ** 2, later, peak=peak, average=average)


def ssim(image: Clips, reference: Clips, *, mask: Mask | None = None) -> Scalar:
    """Structural similarity, at most 1: the mean of its map over pixels and channels, each channel separately.

    11 x 11 Gaussian window of sigma 1.5, population covariance, K1 = 0.01, K2 = 0.03, data range 1 (Wang et al. 2004).
    The map is computed only where the window fits into the image, so a border of 5 pixels never counts; an image
    smaller than the window uses the largest odd window that fits. 1 for an empty mask.
    """
    image, reference = _pair(image, reference)
    inside = _inside(image, mask)
    height, width = image.shape[-3:-1]
    radius = (min(_SSIM_WINDOW, height, width) - 1) // 2
    taps = gaussian_taps(radius, _SSIM_SIGMA)

    def window_mean(x: jax.Array) -> jax.Array:
        return correlate(correlate(x, taps, axis=-2), taps, axis=-3)

    x, y = window_mean(image), window_mean(reference)
    # Variances after subtracting 0.5: the same values, with half the digits lost to cancellation.
    a, b = image - 0.5, reference - 0.5
    xx = window_mean(a * a) - (x - 0.5) ** 2
    yy = window_mean(b * b) - (y - 0.5) ** 2
    xy = window_mean(a * b) - (x - 0.5) * (y - 0.5)
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * x * y + c1) * (2 * xy + c2) / ((x * x + y * y + c1) * (xx + yy + c2))
    if inside is not None:
        inside = inside[..., radius : height - radius, radius : width - radius, :]
    return _mean(_hide(similarity, inside), inside, empty=1.0)


def flip(
    image: Clips,
    reference: Clips,
    *,
    mask: Mask | None = None,
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Scalar:
    """Mean LDR-FLIP error, 0 to 1 (Andersson et al. 2020); see ``metrics.flip.flip_map`` for the map and the units.

    Three channels, display-encoded in [0, 1]. 0 for an empty mask.
    """
    image, reference = _pair(image, reference, channels=3)
    inside = _inside(image, mask)
    return _mean(_hide(flip_map(image, reference, pixels_per_degree=pixels_per_degree), inside), inside)


def _pair(image: jax.Array, reference: jax.Array, *, channels: int | None = None) -> tuple[jax.Array, jax.Array]:
    """Both images checked, in float32 or better: small squares and pixel counts do not fit into half precision."""
    rank = 4 if jnp.ndim(image) == 4 else 3
    check_image(image, "image", rank=rank, channels=channels)
    check_image(reference, "reference", rank=rank, channels=image.shape[-1])
    check_same_size(image, reference, ("image", "reference"))
    dtype = jnp.promote_types(jnp.result_type(image, reference), jnp.float32)
    return jnp.asarray(image, dtype), jnp.asarray(reference, dtype)


def _inside(image: jax.Array, mask: jax.Array | None) -> jax.Array | None:
    """[..., H, W, 1] bool, or None for the whole image."""
    if mask is None:
        return None
    if jnp.shape(mask) != (*image.shape[:-1], 1):
        raise ValueError(
            f"mask: expected shape {(*image.shape[:-1], 1)}, got {jnp.shape(mask)}; it needs the frames and the size "
            "of the image and one channel."
        )
    return jnp.asarray(mask) > 0


def _hide(values: jax.Array, inside: jax.Array | None) -> jax.Array:
    return values if inside is None else jnp.where(inside, values, 0.0)


def _prepare(
    image: jax.Array, reference: jax.Array, mask: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Both images checked, 0 outside the mask (before anything is computed: gradients stay finite), and the mask."""
    image, reference = _pair(image, reference)
    inside = _inside(image, mask)
    return _hide(image, inside), _hide(reference, inside), inside


def _relative_scale(reference: jax.Array) -> jax.Array:
    """``sqrt(reference^2 + 0.01)``."""
    return safe_norm(jnp.stack([reference, jnp.full_like(reference, 0.1)], axis=-1))[..., 0]


def _relative(difference: jax.Array, scale: jax.Array) -> jax.Array:
    """``difference / scale``, to be squared.

    Divided before squaring: the square of a firefly in the reference overflows, the ratio does not. Differences are
    limited to 1/64 of the largest number: larger ones, and their derivatives, would overflow as well.
    """
    limit = float(jnp.finfo(difference.dtype).max) / 64
    return jnp.clip(difference, -limit, limit) / scale


def _mean(values: jax.Array, inside: jax.Array | None, *, empty: float = 0.0) -> jax.Array:
    """Mean over all axes of values that are 0 outside the mask."""
    if inside is None:
        return jnp.mean(values)
    count = jnp.sum(inside)
    mean = jnp.sum(values) / (jnp.maximum(count, 1).astype(values.dtype) * values.shape[-1])
    return jnp.where(count == 0, empty, mean)


def _psnr(squares: jax.Array, inside: jax.Array | None, *, peak: float, average: str) -> jax.Array:
    """``squares`` [H, W, C] or [T, H, W, C], 0 outside the mask."""
    infinite = jnp.asarray(jnp.inf, squares.dtype)
    if squares.size == 0:
        return infinite
    if average == "mse" or squares.ndim == 3:
        return _decibels(_mean(squares, inside), peak)
    if inside is None:
        return jnp.mean(_decibels(jnp.mean(squares, axis=(1, 2, 3)), peak))
    counts = jnp.sum(inside, axis=(1, 2, 3))
    errors = jnp.sum(squares, axis=(1, 2, 3)) / (jnp.maximum(counts, 1).astype(squares.dtype) * squares.shape[-1])
    counted = counts > 0
    total = jnp.sum(jnp.where(counted, _decibels(errors, peak), 0.0))
    frames = jnp.sum(counted)
    return jnp.where(frames == 0, infinite, total / jnp.maximum(frames, 1).astype(squares.dtype))


def _decibels(error: jax.Array, peak: float) -> jax.Array:
    same = error == 0  # not `error > 0`: a NaN must not come out as infinitely good
    return jnp.where(same, jnp.inf, 20 * math.log10(peak) - 10 * jnp.log10(jnp.where(same, 1.0, error)))
