"""Fetching history: where a pixel was one frame ago, and whether that is on the screen."""

import jax
import jax.numpy as jnp

from jaxdn.backends import warp as backend
from jaxdn.checks import check_image, check_option, check_same_size


def _targets(motion: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The array position (x, y) that each pixel's vector points at."""
    height, width = motion.shape[:2]
    x = jnp.arange(width, dtype=motion.dtype)[None, :] + motion[..., 0]
    y = jnp.arange(height, dtype=motion.dtype)[:, None] + motion[..., 1]
    return x, y


def on_screen(motion: jax.Array) -> jax.Array:
    """Whether each pixel's history lies on the screen: bool [H, W, 1] for ``motion`` [H, W, 2].

    On-screen means -0.5 <= x <= W - 0.5 in array indices, likewise y; a vector that is not finite points nowhere.
    """
    check_image(motion, "motion", channels=2)
    height, width = motion.shape[:2]
    x, y = _targets(motion)
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    return inside[..., None]


def warp(image: jax.Array, motion: jax.Array, *, border: str = "clamp", implementation: str | None = None) -> jax.Array:
    """Fetch ``image`` [H, W, C] bilinearly at ``p + motion(p)``: the previous frame as this frame sees it.

    ``motion`` [H, W, 2] is (x, y) in pixels, y down, previous minus current. With border ``"clamp"`` the position is
    clamped to the outermost pixel centres, with ``"zeros"`` pixels outside count as zero (as in PyTorch's grid_sample
    with align_corners=False). Where the motion is not finite the result is 0. The gradient goes to the image; motion is
    data and gets none. ``implementation`` is None (the fastest for this platform), ``"reference"`` or ``"pairs"``.
    Raises ValueError for shapes that do not fit and unknown options.
    """
    check_image(image, "image")
    check_image(motion, "motion", channels=2)
    check_same_size(image, motion, ("image", "motion"))
    check_option(border, "border", ("clamp", "zeros"))
    image, motion = jnp.asarray(image), jax.lax.stop_gradient(jnp.asarray(motion))
    # Positions of a large image do not fit into half precision.
    motion = motion.astype(jnp.promote_types(motion.dtype, jnp.float32))
    height, width = image.shape[:2]
    # Plane by plane: XLA:CPU takes half of the time that it takes for vectors of two.
    known = jnp.isfinite(motion[..., 0]) & jnp.isfinite(motion[..., 1])
    x, y = (jnp.where(known, position, 0.0) for position in _targets(motion))
    if border == "zeros":
        image = jnp.pad(image, ((1, 1), (1, 1), (0, 0)))
        x, y = jnp.clip(x + 1, 0, width + 1), jnp.clip(y + 1, 0, height + 1)
    else:
        x, y = jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1)
    x, y = x.astype(_position_dtype(image)), y.astype(_position_dtype(image))
    warped = backend.warp(image, x, y, implementation=implementation).astype(image.dtype)
    return jnp.where(known[..., None], warped, 0.0)


def _position_dtype(image: jax.Array) -> jnp.dtype:
    """Weights are computed in the image's precision, but never in half of it."""
    return jnp.promote_types(image.dtype, jnp.float32)
