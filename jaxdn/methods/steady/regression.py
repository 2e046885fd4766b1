"""Regression correction: what a filter removes where light follows the guides is estimated, and added again.

A mean over neighbours is wrong where light is not the same on both sides: it flattens a ball, whose light follows its
normal, and at the edge of a surface it takes from inside alone. Were light ``a + b . g`` with guides g (normal,
position in the image, gloss, inverse depth), a linear filter S that keeps constants would err by ``b . (g - S g)``.
Both g and S g are known, and b is what explains best, in a window, what the filter took away: x - S x, mostly noise, by
g - S g. On an even wall g is S g: it says nothing about b, and nothing is added to it.

A small window knows too little, a large one mixes too much. So there are two, one about twice as wide as the other, and
the b of the small one is expected to be that of the large one, b' (and that to be 0). With d = g - S g, with
r = (x - S x) / l relative to the brightness l of S x, both 0 without a surface, and with means E over the window

    b = (E[d d'] + u I)^-1 (E[d r'] + u b'),    u = k E[r r] / n,

where n is the number of pixels in the window and k a constant: the more noise, the less is believed. For k = 1 that is
the estimate of greatest probability if b differs from b' by one or so and r is white noise; light is far from that.

Bitterli et al. 2016, "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo Renderings", fit light to
guides in the neighbourhood of each pixel. Here one filter serves both light and guides, and the fits are few.

Planes are [C, H, W].
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.ops.affinity.filter import SPLINE
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.scales import add_planes, join_planes

SCALES = {"normal": 0.0, "position": 0.0, "gloss": 0.0, "depth": 0.0}
"""Logarithms of what the guides are multiplied by before training: more, and their slope is believed sooner."""
_CHANNELS = {"normal": 3, "position": 2, "gloss": 1, "depth": 1}
GUIDES = sum(_CHANNELS.values())
_POSITION = 1 / 32
"""A position in pixels is multiplied by this."""
CELL = 16
"""Moments are means over cells of CELL x CELL pixels, and slopes are interpolated between their centres."""
_WINDOWS = 1, 2
"""Distances, in cells, of the taps of the filters: the first makes the smaller window, the second the larger of it."""
_DOUBT = 64.0
"""k, by measurement: with less, noise is given back at one sample a pixel; with more, less of all."""
_LEAST = 1e-4
"""Added to u: a guide that hardly varies explains nothing. It is 1 % of a guide's unit, squared."""
_TINY = 1e-8
"""Added too, where there is no surface."""


def regressors_of(normal: jax.Array, gloss: jax.Array, inverse: jax.Array) -> jax.Array:
    """[7, H, W] what light may follow, from [H, W, 3] normals, [H, W, 1] gloss and [H, W] inverse depth."""
    rows, columns = (_POSITION * lax.broadcasted_iota(inverse.dtype, inverse.shape, axis) for axis in (0, 1))
    rest = jnp.stack([columns, rows])
    return join_planes([("pixels", normal), ("planes", rest), ("pixels", gloss), ("planes", inverse[None])])


def regress_residual(
    scales: dict[str, jax.Array], before: jax.Array, after: jax.Array, hit: jax.Array, floor: jax.Array
) -> jax.Array:
    """[3, H, W] what to add to the filtered light; it may be negative.

    Args:
      scales: logarithms, see :data:`SCALES`.
      before: [C, H, W] light >= 0 (3 planes) and guides of :func:`regressors_of` (7); others are not read.
      after: the same after the filter.
      hit: [H, W] bool, there is a surface.
      floor: scalar > 0, light that is dark: brightness is relative to no less.
    """
    factors = jnp.concatenate([jnp.full(n, jnp.exp(scales[name])) for name, n in _CHANNELS.items()])
    given = before, after, hit, jnp.asarray(floor, before.dtype), factors
    return _predict(_slopes(_moments(*given)), *given)


def _level(after: jax.Array, floor: jax.Array) -> jax.Array:
    """[H, W] the brightness that light is relative to."""
    return add_planes(after[:3]) / 3.0 + floor


def _residual_regressors(before: jax.Array, after: jax.Array, hit: jax.Array, factors: jax.Array) -> jax.Array:
    """[7, H, W] d."""
    guides = slice(3, 3 + GUIDES)
    return factors[:, None, None] * jnp.where(hit[None], before[guides] - after[guides], 0.0)


@operation(name="regression_moments")
def _moments(before: jax.Array, after: jax.Array, hit: jax.Array, floor: jax.Array, factors: jax.Array) -> jax.Array:
    """[11, 11, h, w] means over cells of the products of d, r, and whether there is a surface, with each other."""
    rest = jnp.where(hit[None], before[:3] - after[:3], 0.0) / _level(after, floor)[None]
    both = jnp.concatenate([_residual_regressors(before, after, hit, factors), rest, hit[None].astype(rest.dtype)])
    rows, columns = (-(-size // CELL) for size in hit.shape)
    wide = jnp.pad(both, ((0, 0), *((0, -size % CELL) for size in hit.shape)))
    cells = wide.reshape(-1, rows, CELL, columns, CELL).transpose(1, 3, 0, 2, 4).reshape(rows, columns, -1, CELL**2)
    found = jnp.einsum("yxip,yxjp->ijyx", cells, cells, precision=lax.Precision.HIGHEST)
    return found / CELL**2


@numba_call.implements(_moments)
def _moments_by_numba(
    before: jax.Array, after: jax.Array, hit: jax.Array, floor: jax.Array, factors: jax.Array
) -> jax.Array:
    from jaxdn.methods.steady.numba_regression import moments

    rows, columns = (-(-size // CELL) for size in hit.shape)
    shape = GUIDES + 4, GUIDES + 4, rows, columns
    return numba_call.call(moments, [shape], [before, after, hit, floor.reshape(1), factors], CELL, rows=rows)[0]


def _slopes(moments: jax.Array) -> jax.Array:
    """[7, 3, h, w] b of the smaller window, by the unit of each guide."""
    windows, pixels, wide = [], [], moments
    for step in _WINDOWS:
        wide = _blur(wide, step)
        windows.append(wide)
        # That of independent pixels whose mean is as sure, for the one filter; those before add little.
        pixels.append((CELL * step / sum(np.square([SPLINE[abs(tap)] for tap in range(-2, 3)]))) ** 2)
    slopes = jnp.zeros((GUIDES, 3, *moments.shape[2:]), moments.dtype)
    for window, number in zip(reversed(windows), reversed(pixels), strict=True):
        variance = sum(window[index, index] for index in range(GUIDES, GUIDES + 3)) / 3.0
        ridge = _DOUBT / number * variance + _LEAST * window[-1, -1] + _TINY
        slopes = solve(window[:GUIDES, :-1], ridge, slopes)
    return slopes


@operation(name="regression_solve")
def solve(system: jax.Array, ridge: jax.Array, expected: jax.Array) -> jax.Array:
    """b [7, 3, h, w] for all cells at once, from E[d d'] and E[d r'] side by side [7, 10, h, w], u [h, w] and b'.

    Gauss and Jordan's elimination, which needs no pivots as E[d d'] + u I is positive definite.
    """
    units = np.eye(GUIDES, dtype=system.dtype)[..., None, None]
    prior = jnp.concatenate([jnp.broadcast_to(units, (GUIDES, GUIDES, *ridge.shape)), expected], axis=1)
    system = system + ridge[None, None] * prior
    for index in range(GUIDES):
        row = system[index] / system[index, index][None]
        # Less the unit, so that what is left of the row itself is the row.
        system = system - (system[:, index] - units[:, index])[:, None] * row[None]
    return system[:, GUIDES:]


@numba_call.implements(solve)
def _solve_by_numba(system: jax.Array, ridge: jax.Array, expected: jax.Array) -> jax.Array:
    from jaxdn.methods.steady.numba_regression import solve

    return numba_call.call(solve, [expected.shape], [system, ridge, expected], rows=ridge.shape[0])[0]


def _blur(planes: jax.Array, step: int) -> jax.Array:
    """By the B3 spline, taps ``step`` apart; 0 beyond the border."""
    for axis in (-2, -1):
        size = planes.shape[axis]
        wide = jnp.pad(planes, [(2 * step, 2 * step) if each == axis else (0, 0) for each in range(-planes.ndim, 0)])
        taps = [lax.slice_in_dim(wide, (2 + tap) * step, (2 + tap) * step + size, axis=axis) for tap in range(-2, 3)]
        planes = jnp.sum(jnp.stack([SPLINE[abs(tap)] * part for tap, part in zip(range(-2, 3), taps, strict=True)]), 0)
    return planes


@operation(name="regression_explain")
def _predict(
    slopes: jax.Array, before: jax.Array, after: jax.Array, hit: jax.Array, floor: jax.Array, factors: jax.Array
) -> jax.Array:
    """[3, H, W] b . d, slopes interpolated between the centres of cells, times the brightness."""
    height, width = hit.shape
    between = _interpolate(_interpolate(slopes, 2), 3)[..., :height, :width]
    found = jnp.sum(between * _residual_regressors(before, after, hit, factors)[:, None], axis=0)
    return _level(after, floor)[None] * found


def _interpolate(cells: jax.Array, axis: int) -> jax.Array:
    """CELL times the size along an axis, linear, with edge clamp."""
    size = cells.shape[axis]
    first, last = (lax.slice_in_dim(cells, at, at + 1, axis=axis) for at in (0, size - 1))
    before = jnp.concatenate([first, lax.slice_in_dim(cells, 0, size - 1, axis=axis)], axis)
    after = jnp.concatenate([lax.slice_in_dim(cells, 1, size, axis=axis), last], axis)
    parts = []
    for offset in (np.arange(CELL) + 0.5) / CELL - 0.5:
        other = before if offset < 0 else after
        parts.append(cells + abs(offset) * (other - cells))
    found = jnp.stack(parts, axis + 1)
    return found.reshape(*cells.shape[:axis], CELL * size, *cells.shape[axis + 1 :])


@numba_call.implements(_predict)
def _predict_by_numba(
    slopes: jax.Array, before: jax.Array, after: jax.Array, hit: jax.Array, floor: jax.Array, factors: jax.Array
) -> jax.Array:
    from jaxdn.methods.steady.numba_regression import predict

    arrays = [_interpolate(slopes, 3), before, after, hit, floor.reshape(1), factors]
    return numba_call.call(predict, [(3, *hit.shape)], arrays, CELL, rows=hit.shape[0])[0]


def receptive_field() -> int:
    """How far :func:`regress_residual` sees, in pixels: the windows, and the cells that are interpolated."""
    return CELL * (2 * sum(_WINDOWS) + 2)


def _draw_planes(rng: np.random.Generator, height: int, width: int) -> tuple[Any, ...]:
    """Light and guides before and after a filter, where there are surfaces, the floor, the guides' factors."""
    before, after = rng.random((2, 3 + GUIDES, height, width))
    return before, after, rng.random((height, width)) > 0.1, np.array(0.05), rng.uniform(0.5, 2, GUIDES)


@_moments.example
def _moments_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    yield Example(_draw_planes(rng, height, width))


@_predict.example
def _predict_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    cells = -(-height // CELL), -(-width // CELL)
    yield Example((rng.normal(size=(GUIDES, 3, *cells)), *_draw_planes(rng, height, width)))


@solve.example
def _solve_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    both = rng.normal(size=(GUIDES + 3, 32, height, width))
    system = np.einsum("inyx,jnyx->ijyx", both[:GUIDES], both) / 32
    yield Example((system, rng.uniform(0.1, 1, (height, width)), rng.normal(size=(GUIDES, 3, height, width))))
