"""A cross-bilateral filter whose weights are affinities: how alike the features of two pixels are.

    out(p) = sum_q h(o) c(q) exp(-d(p, q)) x(q) / sum_q h(o) c(q) exp(-d(p, q)),    q = p + step o,

over the offsets o of a 5x5 stencil; h is the B3 spline, c each pixel's confidence, and with features F, a slanted guide
z and its slopes g

    d(p, q) = sum_f (F_f(p) - F_f(q))^2 + (z(q) - z(p) - (q - p) . (g(p) + g(q)) / 2)^2.

The second term is 0 on a plane whose z is affine in screen coordinates, as the inverse depth is: a floor that recedes
is one surface. Both terms are those of q to p. Spacing the taps by ``step`` = 1, 2, 4 ... gives the levels of an
a-trous filter (Dammertz et al. 2010); learned features: Isik et al. 2021, "Interactive Monte Carlo Denoising using
Affinity of Neural Features".

Arrays are planar, ``[C, H, W]``: the stencil then runs along contiguous rows and vectorises. On CPUs both passes are
compiled loops (:mod:`jaxdn.ops.affinity.numba_kernels`) where these are available, on GPUs one kernel each
(:mod:`jaxdn.ops.affinity.pallas_kernels`). Elsewhere the forward pass works on tiles
of rows that fit into the cache; the gradient keeps only the arguments and recomputes the weights. Both scan over pairs
of opposite taps and compute the weights of one pair while they use those of the pair before: in one expression, XLA:CPU
would compute every weight once for each channel that uses it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.ops.affinity import pallas_kernels
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.dispatch.row_tiles import rows_per_tile

if TYPE_CHECKING:
    from jaxtyping import Array, Float

RADIUS = 2
SPLINE = (0.375, 0.25, 0.0625)
"""The B3 spline, from its centre outwards."""
_TILE_PIXELS = 32768
"""Approximate number of pixels in a tile."""
_NO_WEIGHT = 1e-12

Planes = list[jax.Array]


class Guide(NamedTuple):
    """What the weights are made of."""

    features: Float[Array, "F H W"]
    """[F, H, W]; a feature with standard deviation sigma of a Gaussian weight is divided by ``sqrt(2) sigma``."""
    slanted: Float[Array, "3 H W"]
    """[3, H, W] a value that is affine on planes, scaled likewise, and its slopes along x and y per pixel."""
    confidence: Float[Array, "H W"]
    """[H, W] >= 0; 0 for pixels that no other may take anything from."""
    scales: Float[Array, ...] | None = None
    """[F + 1] factors of every feature and of the slanted guide, where the same guide serves several filters."""

    def factors(self) -> jax.Array:
        """[F + 1] the scales, 1 where there are none."""
        return jnp.ones(self.features.shape[0] + 1, self.features.dtype) if self.scales is None else self.scales

    def scaled(self) -> Guide:
        """The same guide without scales, which have been multiplied into it."""
        if self.scales is None:
            return self
        factors = self.scales[:, None, None]
        return Guide(factors[:-1] * self.features, factors[-1:] * self.slanted, self.confidence)


def affinity_filter(
    image: Float[Array, "C H W"], guide: Guide, *, step: int = 1, implementation: str | None = None
) -> Float[Array, "C H W"]:
    """The mean of ``image`` [C, H, W], any colour space, weighted by how alike the features of two pixels are.

    ``out(p) = sum_q w(p, q) x(q) / sum_q w(p, q)`` over 5x5 taps that are ``step`` pixels apart. The weights w are
    those of :mod:`jaxdn.ops.affinity.filter`, from Isik et al. 2021. Taps beyond the border do not count. A pixel whose
    weights sum to nothing keeps its value. Differentiable by the image and by all of the guide. ``implementation``:
    "reference", "numba" or "pallas"; None selects the fastest. Raises ValueError for shapes that do not fit each other.
    """
    image = jnp.asarray(image)
    size = image.shape[1:]
    shapes = (guide.features.shape[1:], guide.slanted.shape, guide.confidence.shape)
    if image.ndim != 3 or shapes != (size, (3, *size), size):
        raise ValueError(
            f"guide: expected features [F, H, W], slanted [3, H, W] and confidence [H, W] for an image [C, H, W], got "
            f"{guide.features.shape}, {guide.slanted.shape} and {guide.confidence.shape} for {image.shape}."
        )
    if guide.scales is not None and jnp.shape(guide.scales) != (guide.features.shape[0] + 1,):
        raise ValueError(
            f"guide.scales: expected {guide.features.shape[0] + 1} factors, of each feature and of the slanted guide, "
            f"got shape {jnp.shape(guide.scales)}."
        )
    return _filter_by_affinity(image, guide, step=step, implementation=implementation)


@operation(name="affinity_filter")
def _filter_by_affinity(image: jax.Array, guide: Guide, *, step: int) -> jax.Array:
    """The reference, on CPUs in row tiles."""
    return _by_xla(image, guide.scaled(), step)


@_filter_by_affinity.implementation(
    "pallas", platforms=("gpu",), dtypes=(jnp.float32,), unavailable=pallas_kernels.unavailable
)
def _filter_by_pallas(image: jax.Array, guide: Guide, *, step: int) -> jax.Array:
    return _by_pallas(image, guide.scaled(), step)


@numba_call.implements(_filter_by_affinity, differentiable=True)
def _filter_by_numba(image: jax.Array, guide: Guide, *, step: int) -> jax.Array:
    return _by_numba(image, guide, step)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _by_numba(image: jax.Array, guide: Guide, step: int) -> jax.Array:
    return _numba_forward(image, guide, step)[0]


def _numba_forward(image: jax.Array, guide: Guide, step: int) -> tuple[jax.Array, _Residuals]:
    from jaxdn.ops.affinity.numba_kernels import filter_rows

    arrays = [image, *guide[:3], guide.factors()]
    numbers = step, np.asarray(SPLINE, np.float32), np.float32(_NO_WEIGHT)
    shapes = [image.shape, image.shape[1:]]
    found, weight = numba_call.call(filter_rows, shapes, arrays, *numbers, rows=image.shape[1], least=8 * step)
    return found, (image, guide, found, weight[None])


def _numba_backward(step: int, residuals: _Residuals, cotangent: jax.Array) -> tuple[jax.Array, Guide]:
    from jaxdn.ops.affinity.numba_kernels import filter_gradient_rows

    image, given, filtered, weight = residuals
    some, gains, level = _gains(filtered, weight, cotangent)
    guide, by_given = jax.vjp(Guide.scaled, given)
    arrays = [image, *guide[:3], gains, level]
    shapes = [each.shape for each in arrays[:4]]
    spline = np.asarray(SPLINE, np.float32)
    by_image, *by_guide = numba_call.call(filter_gradient_rows, shapes, arrays, step, spline, rows=image.shape[1])
    return by_image + jnp.where(some, 0.0, cotangent), *by_given(Guide(*by_guide))


class _Pair(NamedTuple):
    """Two opposite taps."""

    shift: jax.Array
    """[2] int32 (y, x) to the first of them, in pixels."""
    spline: jax.Array
    """h of both."""

    def offset(self, sign: int) -> tuple[jax.Array, jax.Array]:
        """(y, x) to one of them."""
        return sign * self.shift[0], sign * self.shift[1]

    def slant(self, sign: int, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
        """The same as numbers."""
        return sign * self.shift[0].astype(dtype), sign * self.shift[1].astype(dtype)


def _pairs(step: int, dtype: jnp.dtype) -> _Pair:
    """All pairs, stacked."""
    span = range(-RADIUS, RADIUS + 1)
    after = [(dy, dx) for dy in span for dx in span if (dy, dx) > (0, 0)]
    spline = [SPLINE[abs(dy)] * SPLINE[abs(dx)] for dy, dx in after]
    return _Pair(jnp.asarray(step * np.array(after), jnp.int32), jnp.asarray(spline, dtype))


def _drop_first(pairs: _Pair, first: int) -> _Pair:
    return jax.tree.map(lambda each: each[first:], pairs)


def _take(pairs: _Pair, index: int) -> _Pair:
    return jax.tree.map(lambda each: each[index], pairs)


def _window(planes: Planes, top: jax.Array | int, left: jax.Array | int, size: tuple[int, int]) -> Planes:
    corner = (jnp.asarray(top, jnp.int32), jnp.asarray(left, jnp.int32))
    return [lax.dynamic_slice(plane, corner, size) for plane in planes]


def _residual(here: Planes, there: Planes, dy: jax.Array, dx: jax.Array) -> jax.Array:
    """How far the slanted guide at q is from where the plane through p expects it; its three planes come last."""
    (z, slope_x, slope_y), (other_z, other_x, other_y) = here[-3:], there[-3:]
    return other_z - z - 0.5 * (dx * (slope_x + other_x) + dy * (slope_y + other_y))


def affinity(here: Planes, there: Planes, dy: jax.Array, dx: jax.Array) -> jax.Array:
    """exp(-d) between the guides of two pixels."""
    total = jnp.square(_residual(here, there, dy, dx))
    for one, other in zip(here[:-3], there[:-3], strict=True):
        total = total + jnp.square(one - other)
    return jnp.exp(-total)


def _dot(one: Planes, other: Planes) -> jax.Array:
    return functools.reduce(jnp.add, [a * b for a, b in zip(one, other, strict=True)])


_Residuals = tuple[jax.Array, Guide, jax.Array, jax.Array]
_Sums = Callable[[jax.Array, Guide, int], jax.Array]
"""(image, guide without scales, step) -> [C + 1, H, W] the weighted sums of light, and of weights."""
_Gradients = Callable[[jax.Array, Guide, jax.Array, jax.Array, int], tuple[jax.Array, Guide]]
"""(image, guide, gains and level of :func:`_gains`, step) -> gradients by image and guide, where there is weight."""


def _differentiable(sum_taps: _Sums, gather_gradients: _Gradients) -> Callable[[jax.Array, Guide, int], jax.Array]:
    """The filter of an image by a guide without scales, from the sums over its taps and their gradients.

    The gradients are gathered: every pixel p collects what it gets as the centre and what it gets as a tap of its
    neighbours q. With g = cotangent / W and s = <g, out>, the gradient by the weight of q in p is
    ``<g(p), x(q)> - s(p)``.
    """

    @functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
    def run(image: jax.Array, guide: Guide, step: int) -> jax.Array:
        return forward(image, guide, step)[0]

    def forward(image: jax.Array, guide: Guide, step: int) -> tuple[jax.Array, _Residuals]:
        totals = sum_taps(image, guide, step)
        weight = totals[-1:]
        some = weight > _NO_WEIGHT
        filtered = jnp.where(some, totals[:-1] / jnp.where(some, weight, 1.0), image)
        return filtered, (image, guide, filtered, weight)

    def backward(step: int, residuals: _Residuals, cotangent: jax.Array) -> tuple[jax.Array, Guide]:
        image, guide, filtered, weight = residuals
        some, gains, level = _gains(filtered, weight, cotangent)
        by_image, by_guide = gather_gradients(image, guide, gains, level, step)
        return by_image + jnp.where(some, 0.0, cotangent), by_guide

    run.defvjp(forward, backward)
    return run


def _sum_by_pallas(image: jax.Array, guide: Guide, step: int) -> jax.Array:
    mass = jnp.concatenate([image * guide.confidence[None], guide.confidence[None]])
    return pallas_kernels.sum_taps(_planes(guide), mass, step=step)


def _gather_by_pallas(
    image: jax.Array, guide: Guide, gains: jax.Array, level: jax.Array, step: int
) -> tuple[jax.Array, Guide]:
    given = _planes(guide), guide.confidence, image, gains, level
    by_image, by_confidence, by_planes = pallas_kernels.gather_gradients(*given, step=step)
    return by_image, Guide(by_planes[:-3], by_planes[-3:], by_confidence)


def _planes(guide: Guide) -> jax.Array:
    return jnp.concatenate([guide.features, guide.slanted])


def _sum_taps(image: jax.Array, guide: Guide, step: int) -> jax.Array:
    channels, height, width = image.shape
    dtype, margin = image.dtype, step * RADIUS
    rows = rows_per_tile(height, width, pixels=_TILE_PIXELS, least=8 * step)
    count = -(-height // rows)
    below = count * rows - height

    def around(plane: jax.Array, margin: int) -> jax.Array:
        return jnp.pad(plane, ((margin, margin + below), (margin, margin)))

    guides = [around(plane, 2 * margin) for plane in (*guide.features, *guide.slanted)]
    mass = [around(plane, margin) for plane in (*image * guide.confidence[None], guide.confidence)]
    pairs = _pairs(step, dtype)
    wide = (rows + margin, width + 2 * margin)

    def tile(top: jax.Array | int) -> jax.Array:
        def weigh(pair: _Pair) -> jax.Array:
            """The weight of p and p + o, for all p of the tile and the pixels before and beside it.

            It is that of p + o and p too: shifted by o, it serves the opposite tap.
            """
            there = _window(guides, top + margin + pair.shift[0], margin + pair.shift[1], wide)
            here = _window(guides, top + margin, margin, wide)
            return pair.spline * affinity(here, there, *pair.slant(1, dtype))

        def add(total: Planes, pair: _Pair, weights: jax.Array) -> Planes:
            for sign in (1, -1):
                back = pair.shift if sign < 0 else jnp.zeros_like(pair.shift)
                (weight,) = _window([weights], margin - back[0], margin - back[1], (rows, width))
                dy, dx = pair.offset(sign)
                taps = _window(mass, top + margin + dy, margin + dx, (rows, width))
                total = [old + weight * one for old, one in zip(total, taps, strict=True)]
            return total

        def body(carry: tuple[Planes, _Pair, jax.Array], pair: _Pair) -> tuple[tuple[Planes, _Pair, jax.Array], None]:
            return (add(*carry), pair, weigh(pair)), None

        first = _take(pairs, 0)
        centre = _window(mass, top + margin, margin, (rows, width))
        begin = ([SPLINE[0] ** 2 * plane for plane in centre], first, weigh(first))
        carry, _ = lax.scan(body, begin, _drop_first(pairs, 1))
        return jnp.stack(add(*carry))

    if count == 1:
        totals = tile(0)
    else:
        totals = lax.map(tile, rows * jnp.arange(count, dtype=jnp.int32))
        totals = totals.transpose(1, 0, 2, 3).reshape(channels + 1, count * rows, width)[:, :height]
    return totals


def _gains(filtered: jax.Array, weight: jax.Array, cotangent: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where there is weight [1, H, W], the cotangent over it [C, H, W], and the product of that and the result."""
    some = weight > _NO_WEIGHT
    scaled = jnp.where(some, cotangent / jnp.where(some, weight, 1.0), 0.0)
    return some, scaled, jnp.sum(scaled * filtered, axis=0)


def _gather_gradients(
    image: jax.Array, guide: Guide, scaled: jax.Array, level: jax.Array, step: int
) -> tuple[jax.Array, Guide]:
    _, height, width = image.shape
    dtype, margin = image.dtype, step * RADIUS

    def around(planes: Planes | jax.Array) -> Planes:
        return [jnp.pad(plane, margin) for plane in planes]

    here = [*guide.features, *guide.slanted]
    guides, lights, gains = around(here), around(image), around(scaled)
    trusts, levels = around([guide.confidence]), around([level])
    x, g, c = list(image), list(scaled), guide.confidence
    pairs = _pairs(step, dtype)

    def at(planes: Planes, pair: _Pair, sign: int) -> Planes:
        dy, dx = pair.offset(sign)
        return _window(planes, margin + dy, margin + dx, (height, width))

    def weigh(pair: _Pair) -> Planes:
        signed = [affinity(here, at(guides, pair, sign), *pair.slant(sign, dtype)) for sign in (1, -1)]
        return [pair.spline * one for one in signed]

    def slopes(pair: _Pair, weights: Planes) -> list[Planes]:
        """By the distance (times -2), the same times the slanted residual, by the confidence; for both taps."""
        found = []
        for sign, one in zip((1, -1), weights, strict=True):
            p_takes = _dot(g, at(lights, pair, sign)) - level
            q_takes = _dot(at(gains, pair, sign), x) - at(levels, pair, sign)[0]
            by_distance = -2.0 * one * (at(trusts, pair, sign)[0] * p_takes + c * q_takes)
            residual = _residual(here, at(guides, pair, sign), *pair.slant(sign, dtype))
            found.append([by_distance, by_distance * residual, one * q_takes])
        return found

    def add(sums: Planes, pair: _Pair, weights: Planes, ready: list[Planes]) -> Planes:
        by_image, by_confidence, by_guides = sums[: len(x)], sums[len(x)], sums[len(x) + 1 :]
        for sign, one, (by_distance, by_residual, by_trust) in zip((1, -1), weights, ready, strict=True):
            share = one * c
            by_image = [old + share * gain for old, gain in zip(by_image, at(gains, pair, sign), strict=True)]
            by_confidence = by_confidence + by_trust
            there = at(guides, pair, sign)[:-3]
            features = [old + by_distance * (a - b) for old, a, b in zip(by_guides[:-3], here[:-3], there, strict=True)]
            dy, dx = pair.slant(sign, dtype)
            z, slope_x, slope_y = by_guides[-3:]
            slanted = [z - by_residual, slope_x - 0.5 * dx * by_residual, slope_y - 0.5 * dy * by_residual]
            by_guides = [*features, *slanted]
        return [*by_image, by_confidence, *by_guides]

    # Three stages, each one pair behind the one before.
    Carry = tuple[Planes, tuple[_Pair, Planes, list[Planes]], tuple[_Pair, Planes]]

    def body(carry: Carry, pair: _Pair) -> tuple[Carry, None]:
        sums, oldest, (older, weights) = carry
        return (add(sums, *oldest), (older, weights, slopes(older, weights)), (pair, weigh(pair))), None

    centre = SPLINE[0] ** 2
    begin = [centre * one * c for one in g] + [centre * (_dot(g, x) - level)] + [jnp.zeros_like(level)] * len(here)
    first, second = _take(pairs, 0), _take(pairs, 1)
    ready = weigh(first)
    carry: Carry = (begin, (first, ready, slopes(first, ready)), (second, weigh(second)))
    # Two pairs without weight come last: whatever follows the scan is computed once for every one of the sums.
    nothing = jax.tree.map(lambda each: jnp.zeros_like(each[:2]), pairs)
    rest = jax.tree.map(lambda one, other: jnp.concatenate([one, other]), _drop_first(pairs, 2), nothing)
    (sums, _, _), _ = lax.scan(body, carry, rest)
    by_guides = sums[len(x) + 1 :]
    by_features, by_slanted = jnp.split(jnp.stack(by_guides), [len(by_guides) - 3])  # there may be no features
    return jnp.stack(sums[: len(x)]), Guide(by_features, by_slanted, sums[len(x)])


_by_xla = _differentiable(_sum_taps, _gather_gradients)
_by_pallas = _differentiable(_sum_by_pallas, _gather_by_pallas)
_by_numba.defvjp(_numba_forward, _numba_backward)


def draw_guide(rng: np.random.Generator, height: int, width: int, *, scales: np.ndarray | None = None) -> Guide:
    """A guide of four features with edges and with pixels that no other may take anything from, in NumPy's float64."""
    features = rng.uniform(-1, 1, (4, height, width)).round()
    features[:, height // 2, width // 2] = 50.0  # a pixel that is like no other
    confidence = rng.random((height, width)) * (rng.random((height, width)) > 0.2)
    guide: Any = features, 0.3 * rng.normal(size=(3, height, width)), confidence, scales
    return Guide(*guide)


@_filter_by_affinity.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    image = rng.random((3, height, width))
    yield Example((image, draw_guide(rng, height, width)), {"step": 1})
    scales = np.array([0.5, 1.0, 0.7, 0.1, 1.5])
    yield Example((image, draw_guide(rng, height, width, scales=scales)), {"step": 2})
