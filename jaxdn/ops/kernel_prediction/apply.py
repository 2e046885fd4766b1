"""Per-pixel filter kernels: normalised from logits, and applied.

The public operations and the implementations of :func:`apply_kernels`. The automatic gradient of K*K shifted products
keeps or recomputes K*K shifted images, and pads the gradient of each kernel slice to full width before adding them.
``"recompute"`` keeps only its two arguments and computes both gradients like the forward pass: K*K shifted
multiply-adds for the image, K*K concatenated short sums for the kernels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.ops.dispatch.operation import Example, operation

if TYPE_CHECKING:
    from jaxtyping import Array, Float


def normalize_kernels(logits: Float[Array, "H W K*K"]) -> Float[Array, "H W K*K"]:
    """Softmax over the taps: [H, W, K*K] logits -> weights >= 0 that sum to 1 (Vogels et al. 2018, "Denoising with
    Kernel Prediction and Asymmetric Loss Functions").

    Computed and returned in float32 at least: radiance reaches 65504, and weights rounded to 8 bits do not sum to 1.
    """
    check_image(logits, "logits")
    logits = jnp.asarray(logits)
    return jax.nn.softmax(logits.astype(jnp.promote_types(logits.dtype, jnp.float32)), axis=-1)


def apply_kernels(
    image: Float[Array, "H W C"], kernels: Float[Array, "H W K*K"], *, implementation: str | None = None
) -> Float[Array, "H W C"]:
    """Filter every pixel with its own kernel: ``out(p) = sum_t kernels(p, t) * image(p + offset_t)``.

    image: [H, W, C], any colour space. kernels: [H, W, K*K] with K odd, taps row-major from -(K//2) to K//2, x fastest.
    Taps beyond the border take the nearest edge pixel. Kernels are not normalised, see ``normalize_kernels``.
    Returns [H, W, C] in the wider of the two dtypes. ``implementation``: "reference" or "recompute"; None selects the
    fastest. Raises ValueError for different sizes and a last axis that is not the square of an odd number.
    """
    check_image(image, "image")
    check_image(kernels, "kernels")
    check_same_size(image, kernels, ("image", "kernels"))
    check_taps(jnp.shape(kernels)[-1], "kernels")
    image, kernels = jnp.asarray(image), jnp.asarray(kernels)
    dtype = jnp.promote_types(image.dtype, kernels.dtype)
    return _sum_taps(image.astype(dtype), kernels.astype(dtype), implementation=implementation)


def check_taps(taps: int, name: str) -> None:
    """Raise ValueError unless ``taps`` is the square of an odd number."""
    if math.isqrt(taps) ** 2 != taps or taps % 2 == 0:
        raise ValueError(
            f"{name}: expected K*K taps with K odd (1, 9, 25, ...) in the last axis, got {taps}; "
            "split other outputs of the network off first."
        )


def _radius(kernels: jax.Array) -> int:
    return math.isqrt(kernels.shape[-1]) // 2


def _extend(image: jax.Array, radius: int) -> jax.Array:
    """Edge pixels repeated ``radius`` times outwards."""
    return jnp.pad(image, ((radius, radius), (radius, radius), (0, 0)), mode="edge")


def tap_offsets(radius: int) -> list[tuple[int, int]]:
    """(row, column) of every tap in the extended image, row-major."""
    size = 2 * radius + 1
    return [(row, column) for row in range(size) for column in range(size)]


@operation(name="apply_kernels")
def _sum_taps(image: jax.Array, kernels: jax.Array) -> jax.Array:
    """Shifted multiply-adds with automatic gradients."""
    height, width, _ = image.shape
    radius = _radius(kernels)
    extended = _extend(image, radius)
    out = jnp.zeros_like(image)
    for tap, (i, j) in enumerate(tap_offsets(radius)):
        out = out + kernels[:, :, tap : tap + 1] * extended[i : i + height, j : j + width]
    return out


@jax.custom_vjp
def _recompute(image: jax.Array, kernels: jax.Array) -> jax.Array:
    return _sum_taps(image, kernels, implementation="reference")


def _forward(image: jax.Array, kernels: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return _sum_taps(image, kernels, implementation="reference"), (image, kernels)


def _backward(residuals: tuple[jax.Array, jax.Array], cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    image, kernels = residuals
    height, width, channels = image.shape
    radius = _radius(kernels)
    extended, undo = jax.vjp(lambda image: _extend(image, radius), image)

    def inner_product(i: int, j: int) -> jax.Array:
        shifted = extended[i : i + height, j : j + width]
        terms = [cotangent[..., c : c + 1] * shifted[..., c : c + 1] for c in range(channels)]
        return sum(terms[1:], terms[0])

    kernels_gradient = jnp.concatenate([inner_product(i, j) for i, j in tap_offsets(radius)], axis=-1)

    # Gradient of the extended image, gathered: its pixel e receives tap t of pixel e - offset_t wherever that exists.
    around = ((2 * radius, 2 * radius), (2 * radius, 2 * radius), (0, 0))
    wide_kernels, wide_cotangent = jnp.pad(kernels, around), jnp.pad(cotangent, around)
    rows, columns = extended.shape[:2]
    total = jnp.zeros_like(extended)
    for tap, (i, j) in enumerate(tap_offsets(radius)):
        y, x = 2 * radius - i, 2 * radius - j
        weight = wide_kernels[y : y + rows, x : x + columns, tap : tap + 1]
        total = total + weight * wide_cotangent[y : y + rows, x : x + columns]
    return undo(total)[0], kernels_gradient


_recompute.defvjp(_forward, _backward)


@_sum_taps.implementation("recompute", platforms=("cpu",))
def _sum_taps_recomputed(image: jax.Array, kernels: jax.Array) -> jax.Array:
    """The same multiply-adds; the gradients are recomputed from the arguments."""
    return _recompute(image, kernels)


@_sum_taps.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for taps in (1, 25):
        yield Example((rng.normal(size=(height, width, 3)), rng.normal(size=(height, width, taps))))
