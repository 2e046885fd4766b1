"""The motion that a moving camera gives to all that stands still, found in two frames.

A point at (x, y) with nearness q (its inverse depth) moves by few numbers (Longuet-Higgins and Prazdny, "The
interpretation of a moving retinal image", 1980): a camera that turns moves it whatever its depth, one that travels
moves it by its nearness. In the direction of view depth changes on the way, which q^2 takes up to second order:

    u(x, y, q) = sum_k theta_k phi_k,
    phi = (1, 0), (0, 1), (x, 0), (0, x), (y, 0), (0, y), (x^2, x y), (x y, y^2),
          q (1, 0), q (0, 1), q (x, y), q^2 (1, 0), q^2 (0, 1), q^2 (x, y).

No focal length has to be known, and a cut-out of a picture is as good as the whole: another origin of x and y gives the
same functions. Without depth the first eight are left.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.filters.image_steps import differentiate, halve
from jaxdn.ops.warp import warp

_SIDE = 320
"""Pixels; larger frames are reduced."""
_FITS = 10
"""To vectors, with weights that close in on those that agree ..."""
_WIDE, _NARROW = 3.0, 0.5
"""... from the first of these distances, in pixels, to the second."""
_STEPS = 10
"""To the features themselves."""
_OUTLIER = 0.05
"""A difference of features that the camera no longer explains."""
_RIDGE = 1e-5
"""Of the mean square of the functions: what nothing tells about stays small."""


class _Basis(NamedTuple):
    """The functions phi, both directions apart, [K, H, W] each."""

    x: jax.Array
    y: jax.Array

    def combine(self, theta: jax.Array) -> jax.Array:
        """The vectors [H, W, 2] for theta [K]."""
        return jnp.stack([jnp.tensordot(theta, functions, 1) for functions in self], axis=-1)

    def flat(self) -> tuple[jax.Array, jax.Array]:
        """[K, H W] each."""
        return self.x.reshape(len(self.x), -1), self.y.reshape(len(self.y), -1)


def fit_camera(
    before: jax.Array, now: jax.Array, nearness: jax.Array | None, motion: jax.Array, weight: jax.Array
) -> jax.Array:
    """The numbers theta [K] with which the camera moves most of what two frames show.

    First those closest to ``motion``, by iterated least squares with weights ``w / (1 + (r / s)^2)^2`` of the residuals
    r; s shrinks meanwhile. Then steps of Gauss and Newton on ``f_now(p) - f_before(p + u)`` with such weights, over all
    pixels at once (Irani and Anandan, "About Direct Methods", 2000).

    Args:
      before: [H, W, C], features of the frame before.
      now: of this one.
      nearness: [H, W], in units of about 1; None: unknown.
      motion: [H, W, 2], vectors that may be wrong in places, in pixels.
      weight: [H, W], what each vector counts, 0 to 1.
    """
    scale = 1
    while max(now.shape[:2]) > _SIDE:
        before, now, motion = halve(before), halve(now), 0.5 * halve(motion)
        weight = halve(weight[..., None])[..., 0]
        nearness = None if nearness is None else halve(nearness[..., None])[..., 0]
        scale *= 2
    basis = _make_basis(now.shape[:2], nearness)
    return scale * _fit_features(basis, before, now, _fit_vectors(basis, motion, weight))


def move_by_camera(theta: jax.Array, size: tuple[int, ...], nearness: jax.Array | None) -> jax.Array:
    """The vectors [H, W, 2] of a frame of that size, in pixels of the frame that was fitted."""
    return _make_basis(size, nearness).combine(theta)


def _make_basis(size: tuple[int, ...], nearness: jax.Array | None) -> _Basis:
    """The functions; x goes from -1 to 1, by pixel centres, so that a frame and its halves have the same places."""
    height, width = size
    x = jnp.broadcast_to(((2 * jnp.arange(width) + 1) / width - 1)[None], size)
    y = jnp.broadcast_to(((2 * jnp.arange(height) + 1 - height) / width)[:, None], size)
    one, none = jnp.ones_like(x), jnp.zeros_like(x)
    along = [one, none, x, none, y, none, x * x, x * y]
    down = [none, one, none, x, none, y, x * y, y * y]
    for power in () if nearness is None else (nearness, nearness * nearness):
        along += [power, none, power * x]
        down += [none, power, power * y]
    return _Basis(jnp.stack(along), jnp.stack(down))


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """The solution [K] of a symmetric system."""
    size = len(matrix)
    ridge = _RIDGE * jnp.trace(matrix) / size + 1e-20
    return jnp.linalg.solve(matrix + ridge * jnp.eye(size, dtype=matrix.dtype), right)


def _fit_vectors(basis: _Basis, motion: jax.Array, weight: jax.Array) -> jax.Array:
    x, y = basis.flat()
    counted = weight.reshape(-1)

    def fit(index: jax.Array, theta: jax.Array) -> jax.Array:
        near = jnp.maximum(_WIDE * 0.6**index, _NARROW)
        apart = jnp.sum((motion - basis.combine(theta)) ** 2, axis=-1).reshape(-1)
        trusted = counted / (1 + apart / near**2) ** 2
        matrix = (x * trusted[None]) @ x.T + (y * trusted[None]) @ y.T
        across, down = (trusted * motion[..., axis].reshape(-1) for axis in (0, 1))
        return _solve(matrix, x @ across + y @ down)

    return lax.fori_loop(0, _FITS, fit, jnp.zeros(len(x), motion.dtype))


def _fit_features(basis: _Basis, before: jax.Array, now: jax.Array, theta: jax.Array) -> jax.Array:
    height, width = now.shape[:2]
    x, y = basis.flat()
    slope_x, slope_y = differentiate(now)
    columns, rows = jnp.arange(width)[None], jnp.arange(height)[:, None]

    def step(_: jax.Array, theta: jax.Array) -> jax.Array:
        motion = basis.combine(theta)
        column, row = columns + motion[..., 0], rows + motion[..., 1]
        inside = (column >= 1) & (column <= width - 2) & (row >= 1) & (row <= height - 2)
        left = now - warp(before, motion)
        weight = inside[..., None] / (1 + (left / _OUTLIER) ** 2) ** 2

        def total(one: jax.Array, other: jax.Array) -> jax.Array:
            return jnp.sum(weight * one * other, axis=-1).reshape(-1)

        xx, xy, yy = (total(*each)[None] for each in ((slope_x, slope_x), (slope_x, slope_y), (slope_y, slope_y)))
        both = (x * xy) @ y.T
        matrix = (x * xx) @ x.T + both + both.T + (y * yy) @ y.T
        return theta + _solve(matrix, x @ total(slope_x, left) + y @ total(slope_y, left))

    return lax.fori_loop(0, _STEPS, step, theta)
