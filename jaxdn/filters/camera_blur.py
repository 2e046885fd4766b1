"""Motion blur and depth of field, put into a sharp image by motion vectors and depth.

A renderer without blur gives the light of one moment, through a pinhole. With it, what a pixel q shows is spread over
the way that it goes while the shutter is open, or over its circle of confusion: it covers the part ``k(q, p)`` of
pixel p. Here the places q are gathered for each p (McGuire, Hennessy, Bukowski, Osman, "A Reconstruction Filter for
Plausible Motion Blur", 2012; Guertin, McGuire, Nowrouzezahrai, "A Fast and Stable Feature-Aware Motion Blur Filter",
2014; Jimenez, "Next Generation Post Processing in Call of Duty: Advanced Warfare", 2014), as three layers of light c
and coverage a <= 1 that lie on each other:

    a_F = sum f k,  F = sum f k c;    a_S = sum e k,  S = sum e k c;    B = sum b c / sum b,
    result = F + (1 - a_F) (S + (1 - a_S) B).

With ``d = (z(p) - z(q)) / (0.05 min(z(p), z(q)))``, q is in front of p by ``f = clip(d, 0, 1)``, on its surface by
``e = clip(1 - |d|, 0, 1)``, behind it by ``b = clip(-d, 0, 1)``. F comes from wherever light may come: along the
longest way, or from the largest circle, of the neighbourhood. S and B come from p's own way or circle. What lies behind
a blurred edge no sharp frame shows, so B is what is seen beside it.

Unlike in the papers k has a unit: what is before p for a third of the time hides a third of it. Of two things in one
depth the one that is spread more counts as in front. Weights do not depend on light, so that parts of an image still
add up to it, and alpha stays that of its colour.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.ops.dispatch.row_tiles import map_row_tiles

LONGEST = 256.0
"""Pixels; longer ways are cut to this."""
WIDEST = 48.0
"""Pixels; larger radii of circles of confusion are cut to this."""
_MOST_SAMPLES = 512
_DEPTH = 0.05
"""Difference of depth, as a part of it, at which one thing is wholly in front of another."""
_PIXELS = 10_000
"""Approximate number of pixels in a tile."""
_GOLDEN = math.pi * (3 - math.sqrt(5))
_LEAST = math.sqrt(1 / math.pi)
"""The radius of a disc of one pixel."""


class _Spread(NamedTuple):
    """How pixels are spread, by their extents [..., D]: ways of two numbers, or radii."""

    lay: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
    """Of an extent, the number of a sample and how many there are: where it lies [..., 2], in pixels away; up to half a
    pixel beyond the extent, as edges are soft. Where that is less than half a pixel, all samples are at p."""
    laid: Callable[[jax.Array], jax.Array]
    """Of an extent: the pixels that all samples together stand for [...]."""
    area: Callable[[jax.Array], jax.Array]
    """Of an extent: the pixels that a pixel is spread over [...], at least 1."""
    inside: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
    """Of the extent of q, that along which q was found, and their distance [..., 2]: whether q reaches p, 0 to 1."""


def compute_confusion_radius(depth: jax.Array, focus: jax.Array | float, infinity: jax.Array | float) -> jax.Array:
    """The radius of the circle of confusion, ``infinity |1 - focus / z|``, in the unit of ``infinity`` and its shape.

    A lens of the diameter D and the focal length g, in pixels, spreads what is at the depth z over a circle of the
    diameter ``D g |z - focus| / (z focus)`` (thin lens; Potmesil, Chakravarty, "A Lens and Aperture Camera Model for
    Synthetic Image Generation", 1981): ``infinity`` is ``D g / (2 focus)``.
    """
    return infinity * jnp.abs(1.0 - focus / jnp.maximum(depth, 1e-6))


@jax.jit
def blur_motion(image: jax.Array, motion: jax.Array, depth: jax.Array, shutter: jax.Array | float) -> jax.Array:
    """An image [H, W, C] as a shutter sees it that is open around the moment of the sharp one.

    Everything goes straight on, half of its way before that moment and half after it. Beyond its borders the image
    goes on as at them. Has no reverse-mode gradient. Raises ValueError for arrays of other shapes or sizes.

    Args:
      image: any number of channels, linear.
      motion: [H, W, 2] (x, y) px, y down, previous minus current; what is not finite counts as 0.
      depth: [H, W, 1] > 0.
      shutter: the part of the time between two frames that it is open.
    """
    check_image(motion, "motion", channels=2)
    way = jnp.where(jnp.isfinite(motion), motion, 0.0) * shutter
    way = way * jnp.minimum(1.0, LONGEST / jnp.maximum(_length(way), 1e-6))[..., None]

    def lay(extent: jax.Array, number: jax.Array, count: jax.Array) -> jax.Array:
        length = _length(extent)
        longer = jnp.where(length > 0.5, (jnp.maximum(length, 1.0) + 1.0) / jnp.maximum(length, 0.5), 0.0)
        return extent * (longer * ((number + 0.5) / count - 0.5))[..., None]

    def laid(extent: jax.Array) -> jax.Array:
        return area(extent) + (_length(extent) > 0.5)

    def area(extent: jax.Array) -> jax.Array:
        return jnp.maximum(_length(extent), 1.0)

    def inside(there: jax.Array, along: jax.Array, away: jax.Array) -> jax.Array:
        both = _length(there) * _length(along)
        cosine = jnp.abs(jnp.sum(there * along, axis=-1)) / jnp.maximum(both, 1e-6)
        still = jnp.minimum(_length(there), _length(along)) < 1.0
        return jnp.clip(0.5 * area(there) + 0.5 - _length(away), 0.0, 1.0) * jnp.where(still, 1.0, cosine)

    spread = _Spread(lay, laid, area, inside)
    return _lay(image, depth, way, _largest_around(way, 0.5), spread)


@jax.jit
def blur_lens(image: jax.Array, radius: jax.Array, depth: jax.Array) -> jax.Array:
    """An image [H, W, C] as a lens sees it that spreads each pixel over a disc.

    Has no reverse-mode gradient. Raises ValueError for arrays of other shapes or sizes.

    Args:
      image: any number of channels, linear.
      radius: [H, W, 1] of the circles of confusion in pixels (:func:`compute_confusion_radius`).
      depth: [H, W, 1] > 0.
    """
    check_image(radius, "radius", channels=1)
    radius = jnp.clip(jnp.where(jnp.isfinite(radius), radius, 0.0), 0.0, WIDEST)

    def size(extent: jax.Array) -> jax.Array:
        return jnp.maximum(extent[..., 0], _LEAST)

    def lay(extent: jax.Array, number: jax.Array, count: jax.Array) -> jax.Array:
        turn, wide = _GOLDEN * number, jnp.where(extent[..., 0] > 0.5, size(extent) + 0.5, 0.0)
        away = jnp.sqrt((number + 0.5) / count) * wide
        return jnp.stack([away * jnp.cos(turn), away * jnp.sin(turn)], axis=-1)

    def laid(extent: jax.Array) -> jax.Array:
        return math.pi * (size(extent) + 0.5 * (extent[..., 0] > 0.5)) ** 2

    def area(extent: jax.Array) -> jax.Array:
        return math.pi * size(extent) ** 2

    def inside(there: jax.Array, along: jax.Array, away: jax.Array) -> jax.Array:
        return jnp.clip(size(there) + 0.5 - _length(away), 0.0, 1.0)

    spread = _Spread(lay, laid, area, inside)
    return _lay(image, depth, radius, _largest_around(radius, 1.0), spread)


def _lay(image: jax.Array, depth: jax.Array, extent: jax.Array, around: jax.Array, spread: _Spread) -> jax.Array:
    """The three layers on each other; ``around`` [H, W, D] is the largest extent of the neighbourhood."""
    check_image(depth, "depth", channels=1)
    check_same_size(image, depth, ("image", "depth"))
    check_same_size(image, extent, ("image", "motion or radius"))
    height, width, channels = image.shape
    packed = jnp.concatenate([image, jnp.maximum(depth, 1e-6), extent], axis=-1).reshape(height * width, -1)
    place = jnp.stack(jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij"), axis=-1).astype(jnp.int32)

    def tile(part: tuple[jax.Array, ...]) -> jax.Array:
        place, here, around = part
        light, z, own = here[..., :channels], here[..., channels], here[..., channels + 1 :]

        def find(along: jax.Array, number: jax.Array, count: jax.Array) -> tuple[jax.Array, ...]:
            away = spread.lay(along, number.astype(image.dtype), count)
            row = jnp.clip(place[..., 0] + jnp.round(away[..., 1]).astype(jnp.int32), 0, height - 1)
            column = jnp.clip(place[..., 1] + jnp.round(away[..., 0]).astype(jnp.int32), 0, width - 1)
            found = packed.at[row * width + column].get(mode="promise_in_bounds")
            there, at = found[..., channels + 1 :], found[..., channels]
            nearer = (z - at) / (_DEPTH * jnp.minimum(z, at))
            same, area = jnp.clip(1.0 - jnp.abs(nearer), 0.0, 1.0), spread.area(there)
            ahead = jnp.clip(1.0 - spread.area(own) / area, 0.0, 1.0) * same
            inside = spread.inside(there, along, away)
            share = inside * spread.laid(along) / (area * count)
            behind = jnp.clip(-nearer, 0.0, 1.0) + same * (1.0 - inside)
            lit = jnp.concatenate([found[..., :channels], jnp.ones_like(at)[..., None]], axis=-1)
            return lit, (jnp.clip(nearer, 0.0, 1.0) + ahead) * share, (same - ahead) * share, behind

        def add_front(number: jax.Array, front: jax.Array) -> jax.Array:
            lit, before, _, _ = find(around, number, many)
            return front + before[..., None] * lit

        def add_own(number: jax.Array, sums: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            lit, _, beside, behind = find(own, number, some)
            return sums[0] + beside[..., None] * lit, sums[1] + behind[..., None] * lit

        many, some = (jnp.clip(jnp.ceil(jnp.max(spread.laid(e))), 1.0, _MOST_SAMPLES) for e in (around, own))
        nothing = jnp.zeros((*z.shape, channels + 1), image.dtype)
        front = lax.fori_loop(0, many.astype(jnp.int32), add_front, nothing)
        surface, back = lax.fori_loop(0, some.astype(jnp.int32), add_own, (nothing, nothing))
        hidden, front_light = _cover(front, light)
        covered, surface_light = _cover(surface, light)
        rest = jnp.where(back[..., -1:] > 1e-6, back[..., :-1] / jnp.maximum(back[..., -1:], 1e-6), surface_light)
        return hidden * front_light + (1 - hidden) * (covered * surface_light + (1 - covered) * rest)

    centre = packed.reshape(height, width, -1)
    return map_row_tiles(tile, (place, centre, around), pixels=_PIXELS)


def _cover(layer: jax.Array, otherwise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Coverage [H, W, 1] of at most 1, and light [H, W, C], of a layer's sums [H, W, C + 1]."""
    total = layer[..., -1:]
    light = jnp.where(total > 1e-6, layer[..., :-1] / jnp.maximum(total, 1e-6), otherwise)
    return jnp.minimum(total, 1.0), light


def _length(vector: jax.Array) -> jax.Array:
    """[..., D] -> [...]."""
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def _largest_around(extent: jax.Array, reach: float) -> jax.Array:
    """For each pixel the longest of the extents [H, W, D] around, as far as ``reach`` times the longest of all.

    After steps of 1, 2, 4 ... 2^n pixels along both axes the window reaches 2^(n + 1) - 1 pixels.
    """
    far = reach * jnp.max(_length(extent))

    def widen(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        step, largest = state
        for axis in (0, 1):
            before = largest
            for shift in (step, -step):
                there = _shift(before, shift, axis)
                largest = jnp.where((_length(there) > _length(largest))[..., None], there, largest)
        return 2 * step, largest

    return lax.while_loop(lambda state: state[0] - 1 < far, widen, (jnp.int32(1), extent))[1]


def _shift(values: jax.Array, by: jax.Array, axis: int) -> jax.Array:
    """Values that lie ``by`` pixels further along an axis, the border's beyond it."""
    size = values.shape[axis]
    return jnp.take(values, jnp.clip(jnp.arange(size) + by, 0, size - 1), axis=axis)
