"""Backward warping: the previous frame reprojected to the current frame.

The public :func:`warp` and its implementations: each samples at array positions ``x``, ``y`` [h, w] that lie inside the
image (0 <= x <= W - 1, likewise y).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.motion import find_targets

if TYPE_CHECKING:
    from jaxtyping import Array, Float


def warp(
    image: Float[Array, "H W C"],
    motion: Float[Array, "H W 2"],
    *,
    border: Literal["clamp", "zeros"] = "clamp",
    implementation: str | None = None,
) -> Float[Array, "H W C"]:
    """Fetch ``image`` [H, W, C] bilinearly at ``p + motion(p)``: the previous frame reprojected to this one.

    ``motion`` [H, W, 2] is (x, y) in pixels, y down, previous minus current. With border ``"clamp"`` the position is
    clamped to the outermost pixel centres, with ``"zeros"`` pixels outside count as zero (as in PyTorch's grid_sample
    with align_corners=False). Where the motion is not finite the result is 0. Only the image has a gradient, not the
    motion. ``implementation`` is None (the fastest for this platform), ``"reference"`` or ``"pairs"``.
    Raises ValueError for inconsistent shapes and unknown options.
    """
    check_image(image, "image")
    check_image(motion, "motion", channels=2)
    check_same_size(image, motion, ("image", "motion"))
    check_option(border, "border", ("clamp", "zeros"))
    image, motion = jnp.asarray(image), lax.stop_gradient(jnp.asarray(motion))
    # Positions of a large image do not fit into half precision.
    motion = motion.astype(jnp.promote_types(motion.dtype, jnp.float32))
    height, width = image.shape[:2]
    # Plane by plane: XLA:CPU takes half the time that it takes for vectors of two.
    known = jnp.isfinite(motion[..., 0]) & jnp.isfinite(motion[..., 1])
    x, y = (jnp.where(known, position, 0.0) for position in find_targets(motion))
    if border == "zeros":
        image = jnp.pad(image, ((1, 1), (1, 1), (0, 0)))
        x, y = jnp.clip(x + 1, 0, width + 1), jnp.clip(y + 1, 0, height + 1)
    else:
        x, y = jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1)
    x, y = x.astype(_position_dtype(image)), y.astype(_position_dtype(image))
    warped = _sample_bilinearly(image, x, y, implementation=implementation).astype(image.dtype)
    return jnp.where(known[..., None], warped, 0.0)


def _position_dtype(image: jax.Array) -> jnp.dtype:
    """Weights are computed in the image's precision, but at least in float32."""
    return jnp.promote_types(image.dtype, jnp.float32)


def locate_cells(x: jax.Array, y: jax.Array, height: int, width: int) -> tuple[jax.Array, ...]:
    """The upper left pixel of each position's cell and the position inside it; the last pixel belongs to a cell too."""
    left = jnp.clip(jnp.floor(x), 0, max(width - 2, 0))
    top = jnp.clip(jnp.floor(y), 0, max(height - 2, 0))
    return left.astype(jnp.int32), top.astype(jnp.int32), (x - left)[..., None], (y - top)[..., None]


@operation(name="warp")
def _sample_bilinearly(image: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Four fetches and their weighted sum."""
    height, width = image.shape[:2]
    left, top, fx, fy = locate_cells(lax.stop_gradient(x), lax.stop_gradient(y), height, width)
    right, below = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
    upper = (1 - fx) * image[top, left] + fx * image[top, right]
    lower = (1 - fx) * image[below, left] + fx * image[below, right]
    return (1 - fy) * upper + fy * lower


def _extend_to(image: jax.Array, size: int) -> jax.Array:
    """An image smaller than a window of ``size`` pixels is continued by its last row and column."""
    missing = (max(size - length, 0) for length in image.shape[:2])
    return jnp.pad(image, (*((0, more) for more in missing), (0, 0)), mode="edge")


def gather_windows(image: jax.Array, top: jax.Array, left: jax.Array, size: int) -> jax.Array:
    """The pixels of square windows whose upper left pixels are ``top``, ``left`` [...]: [..., size * size, C], by rows.

    All windows lie in the image; the last row and column of one that is smaller than a window are repeated.
    """
    image = _extend_to(image, size)
    _, width, channels = image.shape
    flat = image.reshape(-1)
    start = (top * width + left) * channels
    # Neighbours of a row are contiguous in memory: one index fetches all of them.
    rows = lax.GatherDimensionNumbers(offset_dims=(top.ndim,), collapsed_slice_dims=(), start_index_map=(0,))

    def row(offset: int) -> jax.Array:
        return lax.gather(flat, (start + offset)[..., None], rows, (size * channels,), mode="promise_in_bounds")

    found = jnp.concatenate([row(index * width * channels) for index in range(size)], axis=-1)
    return found.reshape(*top.shape, size * size, channels)


def _fetch(image: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    left, top, fx, fy = locate_cells(x, y, *image.shape[:2])
    found = gather_windows(image, top, left, 2)
    upper = (1 - fx) * found[..., 0, :] + fx * found[..., 1, :]
    lower = (1 - fx) * found[..., 2, :] + fx * found[..., 3, :]
    return (1 - fy) * upper + fy * lower


def _scatter_windows(shape: tuple[int, ...], top: jax.Array, left: jax.Array, blocks: jax.Array) -> jax.Array:
    """The adjoint of :func:`gather_windows`: blocks [..., size * size, C] are added to the pixels of their windows."""
    size = math.isqrt(blocks.shape[-2])
    height, width, channels = max(shape[0], size), max(shape[1], size), shape[2]
    where = jnp.stack([top, left * channels], axis=-1).reshape(-1, 2)
    dimensions = lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    empty = jnp.zeros((height, width * channels), blocks.dtype)
    updates = blocks.reshape(-1, size, size * channels)
    total = lax.scatter_add(empty, where, updates, dimensions, mode="promise_in_bounds")
    total = total.reshape(height, width, channels)
    # What fell on repeated rows and columns belongs to the last ones.
    last_row, last_column = shape[0] - 1, shape[1] - 1
    total = jnp.concatenate([total[:last_row], total[last_row:].sum(0, keepdims=True)], axis=0)
    return jnp.concatenate([total[:, :last_column], total[:, last_column:].sum(1, keepdims=True)], axis=1)


def _scatter_samples(shape: tuple[int, ...], x: jax.Array, y: jax.Array, cotangent: jax.Array) -> jax.Array:
    """The adjoint of the fetch: every value is scattered to its four pixels."""
    left, top, fx, fy = locate_cells(x, y, *shape[:2])
    blocks = [wy * wx * cotangent for wy in (1 - fy, fy) for wx in (1 - fx, fx)]
    return _scatter_windows(shape, top, left, jnp.stack(blocks, axis=-2))


@jax.custom_vjp
def attach_mean_gradient(
    mean: jax.Array, image: jax.Array, top: jax.Array, left: jax.Array, weights: jax.Array
) -> jax.Array:
    """``mean`` with a gradient by ``image``: the sum of the pixels of each window times ``weights`` [..., size * size].

    The order is that of :func:`gather_windows`. For fetches that are done another way than their gradient.
    """
    return mean


_Residuals = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


def _mean_forward(
    mean: jax.Array, image: jax.Array, top: jax.Array, left: jax.Array, weights: jax.Array
) -> tuple[jax.Array, _Residuals]:
    # An empty slice carries the image's shape and dtype through a scan at no cost.
    return mean, (image[:, :, :, None][..., :0], top, left, weights)


def _mean_backward(residuals: _Residuals, cotangent: jax.Array) -> tuple[None, jax.Array, None, None, None]:
    shape, top, left, weights = residuals
    blocks = weights[..., None] * cotangent[..., None, :]
    return None, _scatter_windows(shape.shape[:3], top, left, blocks).astype(shape.dtype), None, None, None


attach_mean_gradient.defvjp(_mean_forward, _mean_backward)


@jax.custom_vjp
def _pairs(image: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    return _fetch(image, x, y)


def _forward(image: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    # The adjoint needs only the image's shape and dtype; an empty slice carries them through a scan at no cost.
    return _fetch(image, x, y), (image[:, :, :, None][..., :0], x, y)


def _backward(residuals: tuple[jax.Array, ...], cotangent: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    shape, x, y = residuals
    return _scatter_samples(shape.shape[:3], x, y, cotangent).astype(shape.dtype), jnp.zeros_like(x), jnp.zeros_like(y)


_pairs.defvjp(_forward, _backward)


@_sample_bilinearly.implementation("pairs", platforms=("cpu", "gpu", "tpu"))
def _sample_by_pairs(image: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Two gathers of neighbouring pairs, and a VJP that scatters 2 x 2 blocks."""
    return _pairs(image, x, y)


@_sample_bilinearly.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    x, y = (rng.uniform(0, side - 1, (height, width)) for side in (width, height))
    yield Example((rng.normal(size=(height, width, 3)), x, y))
