"""Guides that distinguish surfaces: depth and its slopes, normals and ids; which pixels show the same surface."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import FAR, Frame


class Guides(NamedTuple):
    """The guides of one frame, to be kept for the next one; ``None`` for an absent buffer."""

    depth: jax.Array | None
    """[H, W, 1]."""
    normal: jax.Array | None
    """[H, W, 3]."""
    ids: jax.Array | None
    """[H, W, 1] in a floating-point dtype: exact up to 2**24 objects in float32."""


def guides_of(frame: Frame) -> Guides:
    """The guides of a frame, ids in the dtype of its radiance, so that they can be packed with colour."""
    return Guides(frame.depth, frame.normal, None if frame.ids is None else frame.ids.astype(frame.radiance.dtype))


def keep_shared(guides: Guides, other: Guides) -> Guides:
    """Of ``guides`` those that both have: only these can be compared."""
    return Guides(*(one if two is not None else None for one, two in zip(guides, other, strict=True)))


def pack(history: jax.Array, guides: Guides) -> jax.Array:
    """[H, W, C] and the guides that are present, as one array [H, W, C + 0..5] that a warp fetches at once."""
    return jnp.concatenate([history, *(each for each in guides if each is not None)], axis=-1)


def unpack(packed: jax.Array, like: Guides) -> tuple[jax.Array, Guides]:
    """What :func:`pack` packed, where ``like`` are guides with the same buffers present."""
    widths = [0 if each is None else each.shape[-1] for each in like]
    at = packed.shape[-1] - sum(widths)
    history, found = packed[..., :at], []
    for each, width in zip(like, widths, strict=True):
        found.append(None if each is None else packed[..., at : at + width])
        at += width
    return history, Guides(*found)


def surface_mask(depth: jax.Array | None, ids: jax.Array | None) -> jax.Array | None:
    """[H, W] bool: the camera ray hit a surface; ``None`` (everywhere) without either buffer."""
    known = []
    if depth is not None:
        known.append(depth[..., 0] < FAR)
    if ids is not None:
        known.append(ids[..., 0] >= 0)
    return None if not known else known[0] if len(known) == 1 else known[0] & known[1]


def depth_feature(depth: jax.Array, mean: jax.Array | float) -> jax.Array:
    """Depth as ``z / (z + mean)`` in [0, 1), for ``depth`` [H, W, 1] >= 0; 0 (the neutral value) gives 0.

    It does not depend on the scene's unit of length with the frame's geometric mean over surfaces
    (:attr:`jaxdn.denoiser.statistics.FrameStatistics.mean_depth`).
    """
    return depth / (depth + mean)


def cosine(first: jax.Array, second: jax.Array) -> jax.Array:
    """[..., 3] normals -> [...] cosine, where the zero normal of *no surface* is orthogonal to all except itself."""
    both_absent = jnp.all(first == 0, axis=-1) & jnp.all(second == 0, axis=-1)
    return jnp.where(both_absent, 1.0, jnp.sum(first * second, axis=-1))


def depth_slopes(depth: jax.Array, ids: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Screen-space slope of depth ``[H, W, 1]`` along x and y, each ``[H, W]``, per pixel.

    The slope is the smaller in magnitude of the forward and the backward difference within the same object, and 0 where
    neither exists. A silhouette thus does not count as a steep surface.
    """
    z = depth[..., 0]
    identity = None if ids is None else ids[..., 0]

    def along(axis: int) -> jax.Array:
        size = z.shape[axis]
        difference = jnp.diff(z, axis=axis)
        same = jnp.ones(difference.shape, bool) if identity is None else jnp.diff(identity, axis=axis) == 0
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        if size == 1:
            return jnp.zeros_like(z)
        forward, has_forward = jnp.pad(difference, after), jnp.pad(same, after)
        backward, has_backward = jnp.pad(difference, before), jnp.pad(same, before)
        take_forward = has_forward & (~has_backward | (jnp.abs(forward) <= jnp.abs(backward)))
        return jnp.where(take_forward, forward, jnp.where(has_backward, backward, 0.0))

    return along(1), along(0)


class ExpectedSurface(NamedTuple):
    """What a tap of the previous frame must show, for every pixel; ``None`` for what one of the frames lacks."""

    depth: jax.Array | None
    """[H, W]."""
    tolerance: jax.Array | None
    """[H, W] of the depth; infinite where any depth is right."""
    normal: jax.Array | None
    """[H, W, 3]; not numbers where any normal is right."""
    ids: jax.Array | None
    """[H, W]; not a number where any id is right."""


def expect_surface(frame: Frame, before: Guides, *, depth_tolerance: float) -> ExpectedSurface:
    """What a tap must show, for a previous frame with the guides ``before``.

    The depth at the target and ``depth_tolerance z + 2 (|dz/dx| + |dz/dy|)``, the normal and the id of the pixel.
    """
    tested = keep_shared(guides_of(frame), before)
    ids = None if tested.ids is None else tested.ids[..., 0]
    if tested.depth is None:
        return ExpectedSurface(None, None, tested.normal, ids)
    depth = (tested.depth if frame.previous_depth is None else frame.previous_depth)[..., 0]
    slope_x, slope_y = depth_slopes(tested.depth, frame.ids)
    return ExpectedSurface(
        depth, depth_tolerance * depth + 2 * (jnp.abs(slope_x) + jnp.abs(slope_y)), tested.normal, ids
    )


def same_surface(tap: Guides, expected: ExpectedSurface, *, normal_threshold: float) -> jax.Array:
    """The test of one tap for every pixel, bool [...]: does it show the same surface?

    It does where ids agree, its depth is the expected one within the tolerance and the cosine of the normals exceeds
    ``normal_threshold``; what one of the two lacks is not tested (Schied et al. 2017, sec. 4.1). ``tap`` are the guides
    [..., C] of the taps, ``expected`` what is expected [...].
    """
    passed: list[jax.Array] = []
    if tap.depth is not None and expected.depth is not None and expected.tolerance is not None:
        passed.append(jnp.abs(tap.depth[..., 0] - expected.depth) <= expected.tolerance)
    if tap.normal is not None and expected.normal is not None:
        aligned = cosine(tap.normal, expected.normal) > normal_threshold
        passed.append(aligned | jnp.isnan(expected.normal[..., 0]))
    if tap.ids is not None and expected.ids is not None:
        passed.append((tap.ids[..., 0] == expected.ids) | jnp.isnan(expected.ids))
    return functools.reduce(jnp.logical_and, passed, jnp.asarray(True))
