"""One-dimensional stencils over images, used by SSIM, FLIP and the HFEN loss.

A separable filter is two calls, one per axis, each a sum of shifted products, which XLA fuses into one pass.
"""

import jax
import jax.numpy as jnp
import numpy as np


def correlate(image: jax.Array, taps: np.ndarray, *, axis: int) -> jax.Array:
    """Correlate one spatial axis with ``taps``, only where they fit entirely: the axis shrinks by K - 1.

    ``image`` [..., H, W, C]; ``axis`` -3 (y) or -2 (x); ``taps`` [K, C'], one filter for each channel, where C or C'
    may be 1. To keep the size, pad first: ``pad_edge``.
    """
    length = image.shape[axis] - len(taps) + 1
    rows = taps.reshape((len(taps),) + (1,) * (image.ndim - 1) + (-1,)).astype(image.dtype)
    start = image.ndim + axis
    return sum(
        (jax.lax.slice_in_dim(image, k, k + length, axis=start) * row for k, row in enumerate(rows)),
        start=jnp.zeros((), image.dtype),
    )


def pad_edge(image: jax.Array, radius: int, *, axis: int) -> jax.Array:
    """``image`` with its first and last row (axis -3) or column (-2) repeated ``radius`` times."""
    widths = [(0, 0)] * image.ndim
    widths[axis] = (radius, radius)
    return jnp.pad(image, widths, mode="edge")


def gaussian_taps(radius: int, sigma: float) -> np.ndarray:
    """[2 radius + 1, 1] weights exp(-x^2 / (2 sigma^2)), normalised to sum 1."""
    x = np.arange(-radius, radius + 1)
    weights = np.exp(-0.5 * (x / sigma) ** 2)
    return (weights / weights.sum())[:, None]
