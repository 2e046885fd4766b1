"""Dual motion vectors: a pixel that was hidden one frame ago takes over the motion of its occluder.

Introduced by Zheng Zeng et al., "Temporally Reliable Motion Vectors for Better Use of Temporal Information", 2021;
"Zeng et al. 2021" and its equations here are Yan Zeng et al. (:mod:`jaxdn.methods.ntd`).

All vectors are (x, y) in pixels, y down, previous minus current: the history of pixel p lies at ``p + motion(p)``.
Positions are array indices: pixel (column, row) has its centre at (column, row) and the image spans
``-0.5 <= x <= W - 0.5``, likewise y.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxdn.core.checks import check_image, check_same_size

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Shaped


def _inside(position: jax.Array, height: int, width: int) -> jax.Array:
    """Whether positions [H, W, 2] are on screen, [H, W] bool; false where they are not finite."""
    x, y = position[..., 0], position[..., 1]
    return (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)


def _position_dtype(motion: jax.Array) -> jnp.dtype:
    """float32 or more: positions of a large image do not fit into half precision."""
    return jnp.promote_types(motion.dtype, jnp.float32)


def _pixels(height: int, width: int, dtype: jnp.dtype) -> jax.Array:
    """The index position (x, y) of every pixel, [H, W, 2]."""
    x = jnp.broadcast_to(jnp.arange(width, dtype=dtype)[None, :], (height, width))
    y = jnp.broadcast_to(jnp.arange(height, dtype=dtype)[:, None], (height, width))
    return jnp.stack([x, y], axis=-1)


def dual_motion(
    motion: Float[Array, "H W 2"], forward_motion: Float[Array, "H W 2"], *, visible: Shaped[Array, "H W"] | None = None
) -> Float[Array, "H W 2"]:
    """Dual motion vectors [H, W, 2] (Zeng et al. 2021, eq. 2), in pixels.

    For a point that was hidden, the traditional history ``p + motion(p)`` lies on its occluder. With the nearest pixel
    ``q = floor(p + motion(p) + 0.5)`` and the occluder's displacement ``forward_motion(q)`` since the previous frame
    (current minus previous, [H, W, 2], defined on the PREVIOUS frame's pixels), the result is ``-forward_motion(q)``:
    the pixel takes over the backward motion of its occluder, and its history comes from next to the occluder instead of
    from the occluder.

    The result is ``motion`` itself where ``visible`` ([H, W] or [H, W, 1]) says that the point was seen in the previous
    frame, where q is off-screen, and where the dual target ``p + result`` is off-screen (the paper's limitation, sec.
    6.4).
    Raises ValueError for arrays that are not [H, W, 2] of one size.
    """
    check_image(motion, "motion", channels=2)
    check_image(forward_motion, "forward_motion", channels=2)
    check_same_size(motion, forward_motion, ("motion", "forward_motion"))
    motion, forward_motion = jnp.asarray(motion), jnp.asarray(forward_motion)
    height, width = motion.shape[:2]
    here = _pixels(height, width, _position_dtype(motion))
    position = here + motion
    known = _inside(position, height, width)
    # floor(x + 0.5) of a position on the right border is W: the last pixel is meant. NaN must not become an integer.
    nearest = jnp.floor(jnp.where(known[..., None], position, 0.0) + 0.5).astype(jnp.int32)
    column = jnp.clip(nearest[..., 0], 0, width - 1)
    row = jnp.clip(nearest[..., 1], 0, height - 1)
    dual = -forward_motion[row, column].astype(motion.dtype)
    use = known & _inside(here + dual, height, width)
    if visible is not None:
        visible = jnp.asarray(visible)
        if visible.ndim == motion.ndim:
            visible = visible[..., 0]
        check_same_size(motion, visible[..., None], ("motion", "visible"))
        use = use & ~visible.astype(bool)
    return jnp.where(use[..., None], dual, motion)


def occlusion_mask(
    motion: Float[Array, "H W 2"], dual_motion: Float[Array, "H W 2"], *, threshold: float = 0.5
) -> Float[Array, "H W 1"]:
    """Where the dual vector differs from the traditional one by more than ``threshold`` px: [H, W, 1] in {0, 1}.

    The paper multiplies images by the difference itself (Zeng et al. 2021, sec. 4.4), which has a sign and pixel units.
    We use a mask: 0.5 px is far above the noise of vectors on one surface and below the smallest real disocclusion.
    Non-finite vectors count as not disoccluded: 0. Raises ValueError for arrays that are not [H, W, 2] of one size.
    """
    check_image(motion, "motion", channels=2)
    check_image(dual_motion, "dual_motion", channels=2)
    check_same_size(motion, dual_motion, ("motion", "dual_motion"))
    motion, dual_motion = jnp.asarray(motion), jnp.asarray(dual_motion)
    difference = dual_motion - motion
    squared = jnp.sum(difference * difference, axis=-1, keepdims=True)
    finite = jnp.all(jnp.isfinite(motion) & jnp.isfinite(dual_motion), axis=-1, keepdims=True)
    return (finite & (squared > threshold * threshold)).astype(difference.dtype)


def find_targets(motion: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The array position (x, y) that each pixel's vector points to."""
    height, width = motion.shape[:2]
    dtype = _position_dtype(motion)
    x = jnp.arange(width, dtype=dtype)[None, :] + motion[..., 0]
    y = jnp.arange(height, dtype=dtype)[:, None] + motion[..., 1]
    return x, y


def on_screen(motion: jax.Array) -> jax.Array:
    """Whether each pixel's history is on screen: bool [H, W, 1] for ``motion`` [H, W, 2].

    On-screen means -0.5 <= x <= W - 0.5 in array indices, likewise y; a non-finite vector is off-screen.
    """
    check_image(motion, "motion", channels=2)
    height, width = motion.shape[:2]
    x, y = find_targets(motion)
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    return inside[..., None]
