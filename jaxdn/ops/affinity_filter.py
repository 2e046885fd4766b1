"""A cross-bilateral filter whose weights come from the distances between the features of two pixels.

``out(p) = sum_q h(q - p) c(q) exp(-d(p, q)) x(q) / sum_q h(q - p) c(q) exp(-d(p, q))`` over the taps q = p + step * o, o
in a (2r+1)^2 stencil. The distance ``d(p, q) = sum_f (F_f(p) - F_f(q))^2 + (z(q) - z(p) - (q - p) . (g(p) + g(q)) / 2)^2``
is that of q to p, so that one exponential serves two taps; the second term is 0 on a plane, whose inverse depth z is
affine in screen coordinates with slopes g. c is each pixel's confidence; pixels beyond the border have none.

Planar arrays: [C, H, W] runs along contiguous rows and vectorises. The gradient recomputes the weights.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

SPLINE = (0.375, 0.25, 0.0625)
"""The B3 spline, from its centre outwards."""
_STRIP = 16384
"""Approximate number of pixels in a strip."""


class Guide(NamedTuple):
    """What the weights are made of."""

    features: jax.Array
    """[F, H, W]."""
    slanted: jax.Array
    """[3, H, W] a value that is affine on planes and its slopes along x and y."""
    confidence: jax.Array
    """[H, W] >= 0."""


def _half(radius: int) -> np.ndarray:
    """Rows of (dy, dx) of the second half of the taps; the others are their opposites."""
    taps = [(dy, dx) for dy in range(-radius, radius + 1) for dx in range(-radius, radius + 1)]
    return np.array(taps[len(taps) // 2 + 1 :], np.int32)


def _spatial(offsets: np.ndarray) -> np.ndarray:
    return np.array([SPLINE[abs(dy)] * SPLINE[abs(dx)] for dy, dx in offsets], np.float32)


def affinity_filter(image: jax.Array, guide: Guide, *, step: int = 1, radius: int = 2) -> jax.Array:
    """The filtered image [C, H, W]; a pixel without any weight keeps its value."""
    return _filtered(image, guide, step, radius)


Planes = list[jax.Array]


def _window(planes: Planes, top, left, shape) -> Planes:
    at = tuple(jnp.asarray(each, jnp.int32) for each in (top, left))
    return [lax.dynamic_slice(plane, at, shape) for plane in planes]


def _affinity(here: Planes, there: Planes, count: int, dy: jax.Array, dx: jax.Array) -> jax.Array:
    """exp(-d) of the features, the slanted value and its slopes at both ends."""
    total = jnp.square(_slant(here, there, count, dy, dx))
    for f in range(count):
        total = total + jnp.square(here[f] - there[f])
    return jnp.exp(-total)


def _slant(here: Planes, there: Planes, count: int, dy: jax.Array, dx: jax.Array) -> jax.Array:
    slope_x, slope_y = here[count + 1] + there[count + 1], here[count + 2] + there[count + 2]
    return there[count] - here[count] - 0.5 * (dx * slope_x + dy * slope_y)


def _dot(one: Planes, other: Planes) -> jax.Array:
    return functools.reduce(jnp.add, [a * b for a, b in zip(one, other, strict=True)])


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _filtered(image: jax.Array, guide: Guide, step: int, radius: int) -> jax.Array:
    return _forward(image, guide, step, radius)[0]


def _taps(step: int, radius: int, dtype) -> tuple[jax.Array, jax.Array]:
    offsets = _half(radius)
    return jnp.asarray(step * offsets, jnp.int32), jnp.asarray(_spatial(offsets), dtype)


def _forward(image, guide, step, radius):
    channels, height, width = image.shape
    dtype, count, margin = image.dtype, guide.features.shape[0], step * radius
    rows = height if jax.default_backend() != "cpu" else min(height, max(8 * step, _STRIP // width))
    strips = -(-height // rows)
    spare = strips * rows - height

    def around(plane):
        return jnp.pad(plane, ((margin, margin + spare), (margin, margin)))

    guides = [around(plane) for plane in (*guide.features, *guide.slanted)]
    mass = [around(plane * guide.confidence) for plane in image] + [around(guide.confidence)]
    shifts, numbers = _taps(step, radius, dtype)

    def strip(top):
        def at(planes, dy, dx):
            return _window(planes, top + margin + dy, margin + dx, (rows, width))

        def weigh(tap):
            (dy, dx), number = tap
            fy, fx = dy.astype(dtype), dx.astype(dtype)
            here = at(guides, 0, 0)
            after = _affinity(here, at(guides, dy, dx), count, fy, fx)
            before = _affinity(at(guides, -dy, -dx), here, count, fy, fx)
            return number * after, number * before

        def add(total, ready, shift):
            (after, before), (dy, dx) = ready, shift
            pairs = zip(total, at(mass, dy, dx), at(mass, -dy, -dx), strict=True)
            return [old + after * a + before * b for old, a, b in pairs]

        def body(carry, tap):
            total, ready, shift = carry
            return (add(total, ready, shift), weigh(tap), tap[0]), None

        # While a tap's weights are computed, the tap before is added: fused into the sums, XLA:CPU would compute every
        # weight once for each channel.
        own = [SPLINE[0] ** 2 * plane for plane in at(mass, 0, 0)]
        first = weigh((shifts[0], numbers[0]))
        (total, ready, shift), _ = lax.scan(body, (own, first, shifts[0]), (shifts[1:], numbers[1:]))
        return jnp.stack(add(total, ready, shift))

    if strips == 1:
        totals = strip(0)
    else:
        totals = lax.map(strip, rows * jnp.arange(strips, dtype=jnp.int32))
        totals = totals.transpose(1, 0, 2, 3).reshape(channels + 1, strips * rows, width)[:, :height]
    weight = totals[-1:]
    some = weight > 1e-12
    out = jnp.where(some, totals[:-1] / jnp.where(some, weight, 1.0), image)
    return out, (image, guide, out, weight)


def _backward(step, radius, residuals, cotangent):
    image, guide, out, weight = residuals
    channels, height, width = image.shape
    dtype, count, margin = image.dtype, guide.features.shape[0], step * radius
    some = weight > 1e-12
    scaled = jnp.where(some, cotangent / jnp.where(some, weight, 1.0), 0.0)
    level = jnp.sum(scaled * out, axis=0)

    def around(planes):
        return [jnp.pad(plane, margin) for plane in planes]

    guides = around([*guide.features, *guide.slanted])
    lights, trust, gains, levels = around(image), around([guide.confidence]), around(scaled), around([level])
    shifts, numbers = _taps(step, radius, dtype)

    def at(planes, dy, dx):
        return _window(planes, margin + dy, margin + dx, (height, width))

    here, x, g, s, c = list((*guide.features, *guide.slanted)), list(image), list(scaled), level, guide.confidence
    inner = _dot(g, x) - s
    centre = SPLINE[0] ** 2
    begin = ([centre * one * c for one in g], centre * inner, [jnp.zeros_like(s)] * (count + 3))

    def signed(shift, sign):
        dy, dx = sign * shift[0], sign * shift[1]
        return (dy, dx), (dy.astype(dtype), dx.astype(dtype))

    def weigh(shift, number):
        return [number * _affinity(here, at(guides, *signed(shift, sign)[0]), count, *signed(shift, sign)[1]) for sign in (1, -1)]

    def slope(shift, ready):
        found = []
        for sign, e in zip((1, -1), ready, strict=True):
            place, ends = signed(shift, sign)
            p_reads = _dot(g, at(lights, *place)) - s
            q_reads = _dot(at(gains, *place), x) - at(levels, *place)[0]
            by_distance = -2.0 * e * (at(trust, *place)[0] * p_reads + c * q_reads)
            found.append((by_distance, by_distance * _slant(here, at(guides, *place), count, *ends), e * q_reads))
        return found

    def add(sums, shift, ready, slopes):
        by_x, by_c, by_guides = sums
        for sign, e, (by_distance, slant, by_confidence) in zip((1, -1), ready, slopes, strict=True):
            place, (fy, fx) = signed(shift, sign)
            share = e * c
            by_x = [old + share * one for old, one in zip(by_x, at(gains, *place), strict=True)]
            by_c = by_c + by_confidence
            there = at(guides[:count], *place)
            features = [old + by_distance * (a - b) for old, a, b in zip(by_guides, here, there, strict=False)]
            a, b, d = by_guides[count:]
            by_guides = [*features, a - slant, b - 0.5 * fx * slant, d - 0.5 * fy * slant]
        return by_x, by_c, by_guides

    # A pipeline of three stages, for the same reason as in the forward pass.
    def body(carry, tap):
        sums, (older, oldest_ready, slopes), (shift, ready) = carry
        return (add(sums, older, oldest_ready, slopes), (shift, ready, slope(shift, ready)), (tap[0], weigh(*tap))), None

    first, second = weigh(shifts[0], numbers[0]), weigh(shifts[1], numbers[1])
    carry = (begin, (shifts[0], first, slope(shifts[0], first)), (shifts[1], second))
    (sums, (older, oldest_ready, slopes), (shift, ready)), _ = lax.scan(body, carry, (shifts[2:], numbers[2:]))
    sums = add(sums, older, oldest_ready, slopes)
    by_x, by_c, by_guides = add(sums, shift, ready, slope(shift, ready))
    by_image = jnp.stack(by_x) + jnp.where(some, 0.0, cotangent)
    return by_image, Guide(jnp.stack(by_guides[:count]), jnp.stack(by_guides[count:]), by_c)


_filtered.defvjp(_forward, _backward)
