"""Training losses: distances of whole clips [T, H, W, C], each one scalar: L1, or with ``squared`` the mean square.

L1 is robust, but what minimises it is the median of the targets: with noisy targets, or noisy inputs, images get too
dark. What minimises the mean square is their mean, whatever noise they have (Lehtinen et al. 2018, "Noise2Noise").

The images are not transformed here: compress them first (``color.compress``), or see ``unbiased``. ``denoised`` and
``reference`` have the same shape; other shapes raise ValueError. Every loss has a finite gradient everywhere (0 where
the two agree).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.core.frame import RADIANCE_MAX
from jaxdn.core.numerics import absolute
from jaxdn.core.separable import correlate, pad_edge

if TYPE_CHECKING:
    from typing import TypeAlias

    from jaxtyping import Array, Float

    Clip: TypeAlias = Float[Array, "T H W C"]
    Masks: TypeAlias = Float[Array, "T H W 1"]
    Operator = Literal["difference", "hfen"]
    Scalar: TypeAlias = Float[Array, ""]


def unbiased(
    denoised: Float[Array, ...], reference: Float[Array, ...], *, curve: Literal["compress", "reinhard"] = "compress"
) -> tuple[Float[Array, ...], Float[Array, ...]]:
    """The pair (denoised, reference) as compressed near the denoised image: both times ``curve'(denoised)``.

    The curve is :func:`jaxdn.color.compress`, or Reinhard's ``x / (1 + x)``, of which PSNR is measured.

    The slope has no gradient of its own, so that the target appears only linearly: squared, the difference is to first
    order that of the compressed images, but noise in the target, which compression would turn into a bias, averages
    out. For linear radiance.

    Two limits keep a single bright sample of a target from outweighing all else: below 0.02 the slope stays that at
    0.02 (at black it is 152), and the target is at most ``10 (denoised + 0.1)``. This takes some
    light from the brightest pixels of hard scenes; how much has not been measured.
    """
    fixed = jax.lax.stop_gradient(denoised)
    check_option(curve, "curve", ("compress", "reinhard"))
    point = jnp.clip(fixed, 0.02, RADIANCE_MAX)
    if curve == "reinhard":
        slope = jnp.square(1.0 / (1.0 + point))
    else:
        _, slope = jax.jvp(color.compress, (point,), (jnp.ones_like(point),))
    return denoised * slope, jnp.minimum(reference, 10.0 * (fixed + 0.1)) * slope


def spatial(denoised: Clip, reference: Clip, *, squared: bool = False) -> Scalar:
    """Mean of ``|denoised - reference|`` over all elements (Zeng et al. 2021, eq. 6, first term)."""
    return _mean_size(_difference(denoised, reference), squared=squared)


def temporal(denoised: Clip, reference: Clip, *, squared: bool = False) -> Scalar:
    """Mean of ``|(I_i - I_{i-1}) - (R_i - R_{i-1})|`` over the T - 1 differences of frames; 0 for a clip of one frame.

    Frames are compared at the same pixel, not along the motion (Zeng et al. 2021, eq. 6, second term; Chaitanya et al.
    2017, sec. 4.2).
    """
    error = _difference(denoised, reference)
    # The error of the differences is the difference of the errors.
    return _mean_size(error[1:] - error[:-1], squared=squared)


def pyramid(denoised: Clip, reference: Clip, *, levels: int = 4) -> Scalar:
    """The sum of the mean absolute errors in the bands of a Laplacian pyramid.

    A band is what remains of the error after the means of 2x2 blocks are taken from it; the next band is made of these
    means, and the last is the means themselves, of blocks of ``2**levels`` pixels. Fewer levels where a size is odd.
    L1 of pixels seeks the median of noisy targets, which is darker than their mean. Here only the means of large blocks
    decide about brightness, and noise that is averaged over 256 pixels has nearly the same median and mean.

    Bojanowski et al. 2018, "Optimizing the Latent Space of Generative Networks", use such a loss (with Gaussian bands).
    """
    error, total = _difference(denoised, reference), jnp.zeros((), denoised.dtype)
    for _ in range(levels):
        frames, height, width, channels = error.shape
        if height % 2 or width % 2:
            break
        blocks = error.reshape(frames, height // 2, 2, width // 2, 2, channels)
        error = jnp.mean(blocks, axis=(2, 4))
        total = total + _mean_size(blocks - error[:, :, None, :, None])
    return total + _mean_size(error)


def gradient(
    denoised: Clip,
    reference: Clip,
    *,
    operator: Operator = "difference",
) -> Scalar:
    """Mean absolute difference of the image gradients; constant offsets do not count.

    ``operator="difference"``: forward differences in x and in y, inside the image; the mean is over both together (0
    for an image of one pixel). ``operator="hfen"``: responses of a Laplacian of Gaussian with sigma 1.5 px on 15 x 15
    taps of zero sum, edge pixels repeated beyond the border.

    Chaitanya et al. 2017, sec. 4.2, who use HFEN (Ravishankar & Bresler 2011).
    """
    check_option(operator, "operator", ("difference", "hfen"))
    error = _difference(denoised, reference)
    if operator == "hfen":
        # Its 225 taps cancel: for a smooth error, bfloat16 would leave only rounding errors.
        exact = error.astype(jnp.promote_types(error.dtype, jnp.float32))
        return jnp.mean(absolute(_laplacian_of_gaussian(exact))).astype(error.dtype)
    horizontal = error[:, :, 1:] - error[:, :, :-1]
    vertical = error[:, 1:] - error[:, :-1]
    return _mean_size(horizontal, vertical)


def occlusion(
    denoised: Clip,
    reference: Clip,
    masks: Masks,
    *,
    weights: tuple[float, ...] = (1.0, 0.8, 0.6),
    squared: bool = False,
) -> Scalar:
    """Mean over all elements of ``|(denoised - reference) S|``: errors where something was disoccluded recently.

    ``S_i = sum_k weights[k] M_{i-k}`` with ``masks`` M [T, H, W, 1] in {0, 1} (``jaxdn.occlusion_mask`` of each frame),
    taken at the same pixel. A mask before the first frame is replaced by frame i's own M_i. S is not clipped, it
    reaches the sum of the weights. The mean is over the whole image, not over the masked area.

    Zeng et al. 2021, eq. 5.
    """
    error = _difference(denoised, reference)
    check_image(masks, "masks", channels=1, rank=4)
    check_same_size(denoised, masks, ("denoised", "masks"))
    masks = jnp.asarray(masks, error.dtype)
    frames = masks.shape[0]
    total = jnp.zeros_like(masks)
    for age, weight in enumerate(weights):
        missing = min(age, frames)
        total = total + weight * jnp.concatenate([masks[:missing], masks[: frames - missing]])
    return _mean_size(error * total, squared=squared)


def _difference(denoised: jax.Array, reference: jax.Array) -> jax.Array:
    check_image(denoised, "denoised", rank=4)
    check_image(reference, "reference", rank=4, channels=denoised.shape[-1])
    check_same_size(denoised, reference, ("denoised", "reference"))
    return denoised - reference


def _mean_size(*parts: jax.Array, squared: bool = False) -> jax.Array:
    """Mean of the absolute values, or squares, of all parts together; 0 when they are all empty."""
    count, size = sum(part.size for part in parts), jnp.square if squared else absolute
    return sum((jnp.sum(size(part)) for part in parts), start=jnp.zeros((), parts[0].dtype)) / max(count, 1)


_LOG_RADIUS = 7
_LOG_SIGMA = 1.5


def _laplacian_taps() -> tuple[np.ndarray, np.ndarray]:
    """[15, 3] taps in x and in y; the sum of the three products is the Laplacian of Gaussian minus its mean.

    LoG = g''(x) g(y) + g(x) g''(y); the third product is the constant mean of its 225 taps.
    """
    x = np.arange(-_LOG_RADIUS, _LOG_RADIUS + 1.0)
    g = np.exp(-0.5 * (x / _LOG_SIGMA) ** 2) / (np.sqrt(2 * np.pi) * _LOG_SIGMA)
    second = (x * x / _LOG_SIGMA**2 - 1) / _LOG_SIGMA**2 * g
    mean = 2 * second.sum() * g.sum() / x.size**2
    ones = np.ones_like(x)
    return np.stack([second, g, -mean * ones], axis=-1), np.stack([g, second, ones], axis=-1)


def _laplacian_of_gaussian(images: jax.Array) -> jax.Array:
    across, down = _laplacian_taps()
    frames, height, width, channels = images.shape
    # Channels are merged into the frames' axis, so that the last axis can hold the three products.
    planes = jnp.moveaxis(images, -1, 1).reshape(frames * channels, height, width, 1)
    rows = correlate(pad_edge(planes, _LOG_RADIUS, axis=-2), across, axis=-2)
    return jnp.sum(correlate(pad_edge(rows, _LOG_RADIUS, axis=-3), down, axis=-3), axis=-1)
