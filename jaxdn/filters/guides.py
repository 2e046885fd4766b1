"""Guides that distinguish surfaces: depth and its slopes, normals and ids, packed for the next frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.frame import FAR


class Guides(NamedTuple):
    """Channel positions in packed guides ``[H, W, G]``; ``None`` for an absent buffer."""

    depth: int | None
    normal: slice | None
    ids: int | None


def pack_guides(
    depth: jax.Array | None, normal: jax.Array | None, ids: jax.Array | None, like: jax.Array
) -> tuple[jax.Array, Guides]:
    """Pack depth, normal and ids, as far as present, into one array ``[H, W, 0..5]`` of the dtype of ``like``.

    Ids are stored as floating-point numbers, exact up to 2**24 objects in float32.
    """
    layers: list[jax.Array] = []
    width = 0
    places: list[int | None] = []
    for buffer in (depth, normal, ids):
        places.append(None if buffer is None else width)
        if buffer is not None:
            layers.append(buffer.astype(like.dtype))
            width += buffer.shape[-1]
    packed = jnp.concatenate(layers, axis=-1) if layers else jnp.zeros((*like.shape[:2], 0), like.dtype)
    at_normal = None if places[1] is None else slice(places[1], places[1] + 3)
    return packed, Guides(places[0], at_normal, places[2])


def hit_mask(depth: jax.Array | None, ids: jax.Array | None) -> jax.Array | None:
    """[H, W] bool: the camera ray hit a surface; ``None`` (everywhere) without either buffer."""
    known = []
    if depth is not None:
        known.append(depth[..., 0] < FAR)
    if ids is not None:
        known.append(ids[..., 0] >= 0)
    return None if not known else known[0] if len(known) == 1 else known[0] & known[1]


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
