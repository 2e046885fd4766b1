"""Reprojection by Catmull-Rom interpolation, without any test of the taps."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.motion import find_targets


@operation
def warp_cubic(image: jax.Array, motion: jax.Array, *, channels: int | None = None) -> jax.Array:
    """Fetch ``image`` [H, W, C] at ``p + motion(p)`` by Catmull-Rom interpolation, or the first ``channels`` of it.

    Sharper than bilinear interpolation, whose blur a history adds up. With f the fraction between two pixels, the
    weights of four pixels in a row are ``-f/2 + f^2 - f^3/2, 1 - 5f^2/2 + 3f^3/2, f/2 + 2f^2 - 3f^3/2,
    -f^2/2 + f^3/2``; values below 0 become 0. Off screen, or where the motion is not finite, the result is 0. No
    gradient flows into the motion.
    """
    image = image[..., :channels]
    height, width, channels = image.shape
    motion = lax.stop_gradient(motion)
    known = jnp.all(jnp.isfinite(motion), axis=-1)
    x, y = find_targets(jnp.where(known[..., None], motion, 0.0))
    inside = known & (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    x, y = jnp.where(inside, x, 0.0), jnp.where(inside, y, 0.0)
    left, top = jnp.floor(x), jnp.floor(y)
    # One pixel before and two after the position, which may lie half a pixel outside.
    flat = jnp.pad(image, ((2, 2), (2, 2), (0, 0)), mode="edge").reshape(-1)
    start = ((top.astype(jnp.int32) + 1) * (width + 4) + left.astype(jnp.int32) + 1) * channels
    four = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
    total = jnp.zeros_like(image)
    across = catmull_rom(x - left)
    for row, down in enumerate(catmull_rom(y - top)):
        found = lax.gather(
            flat, (start + row * (width + 4) * channels)[..., None], four, (4 * channels,), mode="promise_in_bounds"
        ).reshape(height, width, 4, channels)
        total = total + down[..., None] * sum(weight[..., None] * found[:, :, i] for i, weight in enumerate(across))
    return jnp.where(inside[..., None], jnp.maximum(total, 0.0), 0.0).astype(image.dtype)


@numba_call.implements(warp_cubic)
def _warp_by_numba(image: jax.Array, motion: jax.Array, *, channels: int | None = None) -> jax.Array:
    from jaxdn.filters.numba_catmull_rom import warp_cubic as loop

    height, width, lanes = *image.shape[:2], tuple(range(channels or image.shape[2]))
    return numba_call.call(loop, [(height, width, len(lanes))], [image, motion], lanes, rows=height)[0]


@warp_cubic.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    motion = rng.choice(
        [-2.5, -0.5, 0.0, 0.25, 3.0, np.inf, np.nan], (height, width, 2), p=[0.2] * 4 + [0.1, 0.05, 0.05]
    )
    for channels, fetched in ((1, None), (5, None), (5, 3)):
        yield Example((rng.gamma(0.5, 2.0, (height, width, channels)), motion), {"channels": fetched})


def catmull_rom(f: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The weights of four neighbours for the fraction f in [0, 1) between the second and the third."""
    square, cube = f * f, f * f * f
    return (
        -f / 2 + square - cube / 2,
        1 - 2.5 * square + 1.5 * cube,
        f / 2 + 2 * square - 1.5 * cube,
        -square / 2 + cube / 2,
    )
