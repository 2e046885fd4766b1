"""What a fetch of the history between pixels may err by, as the new image itself shows.

A history that is fetched every frame is blurred every frame. How much, depends on what is there: a fetch with the
fraction f of a pixel, and a second one back, have symmetric weights, the autocorrelation of the interpolation's, so
that the new image can be blurred alike in its place. What that changes counts as the error of one fetch. Bilinear
interpolation errs by that much on waves of two pixels, and by half of it on long ones. Catmull-Rom interpolation also
shifts the finest waves by too little, which this does not show: of a fraction of 0.1 it may err by three times as much.

Two more errors are not those of an interpolation. At a silhouette, taps of other surfaces are left out, and a pixel is
a mixture that changes with every fraction of a pixel that the surfaces move by. Beyond the outermost pixels' centres
nothing was seen. There the square of the error is that of the way, in pixels and at most 1, times the contrast of the
3x3 pixels.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.filters.albedo_history import follow_albedo
from jaxdn.filters.catmull_rom import catmull_rom
from jaxdn.filters.surface_test import Guides, expect_surface, guides_of, same_surface
from jaxdn.ops.motion import find_targets
from jaxdn.ops.scales import add_planes

_MIXED = 2.0
"""Factor of the squared error at silhouettes: of 3x3 pixels two thirds at least are on one side, which adds no
contrast."""


def measure_fetch_error(
    image: jax.Array, albedo: jax.Array | None, share: jax.Array, motion: jax.Array, cubic: jax.Array, whole: jax.Array
) -> jax.Array:
    """[H, W] the square of what one fetch of the history may err by: the mean of the channels, the maximum of 3x3.

    Args:
      image: [3, H, W] the new image.
      albedo: [3, H, W] which the history follows, see :mod:`jaxdn.filters.albedo_history`.
      share: [H, W] how far.
      motion: [H, W, 2] in pixels.
      cubic: [H, W] bool, the fetch is by Catmull-Rom interpolation, else bilinear.
      whole: [H, W] bool, no silhouette is near, now or before.
    """
    motion = jnp.where(jnp.all(jnp.isfinite(motion), axis=-1, keepdims=True), motion, 0.0)
    fraction = motion - jnp.floor(motion)
    planes = image if albedo is None else jnp.concatenate([image, albedo])

    def error(there: jax.Array) -> jax.Array:
        found = there[:3]
        if albedo is not None:
            found = follow_albedo(found, there[3:], albedo, share)
        return add_planes((image - found) ** 2) / 3.0

    across, down = (_weigh_there_and_back(fraction[..., axis], cubic) for axis in (0, 1))
    blurred = error(_filter(_filter(planes, across, 2), down, 1))
    blurred = jax.lax.reduce_window(blurred, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")
    beyond = find_beyond(motion)
    contrast = functools.reduce(jnp.add, map(error, _around(planes))) / 8
    mixed = _MIXED * jnp.minimum(_find_way(motion, beyond), 1.0) * contrast
    return jnp.where(whole & (beyond == 0), blurred, jnp.maximum(blurred, mixed))


def find_whole(frame: Frame, *, depth_tolerance: float = 0.02, normal_threshold: float = 0.9) -> jax.Array:
    """[H, W] bool: all 3x3 pixels show the surface of the pixel itself, by the test of :func:`jaxdn.reproject`."""
    guides = guides_of(frame)
    expected = expect_surface(frame._replace(previous_depth=None), guides, depth_tolerance=depth_tolerance)
    around = [
        None if each is None else [near.transpose(1, 2, 0) for near in _around(each.transpose(2, 0, 1))]
        for each in guides
    ]
    whole = jnp.ones(frame.radiance.shape[:2], bool)
    for index in range(8):
        tap = Guides(*(None if each is None else each[index] for each in around))
        whole &= same_surface(tap, expected, normal_threshold=normal_threshold)
    return whole


def find_beyond(motion: jax.Array) -> jax.Array:
    """[H, W] how many pixels the target of motion [H, W, 2] is beyond the outermost pixels' centres; else 0."""
    height, width = motion.shape[:2]
    x, y = find_targets(motion)
    return functools.reduce(jnp.maximum, (-x, x - (width - 1), -y, y - (height - 1), jnp.zeros_like(x)))


def _weigh_there_and_back(fraction: jax.Array, cubic: jax.Array) -> list[jax.Array]:
    """Seven weights [H, W]: the autocorrelation of the four of the interpolation."""
    nothing = jnp.zeros_like(fraction)
    linear = (nothing, 1 - fraction, fraction, nothing)
    four = [jnp.where(cubic, *pair) for pair in zip(catmull_rom(fraction), linear, strict=True)]
    half = [sum((four[i] * four[i + lag] for i in range(4 - lag)), nothing) for lag in range(4)]
    return half[:0:-1] + half


def _filter(planes: jax.Array, weights: list[jax.Array], axis: int) -> jax.Array:
    """Planes [C, H, W] filtered along an axis, with weights [H, W] of each pixel's own."""
    radius, size = len(weights) // 2, planes.shape[axis]
    wide = jnp.pad(planes, [(radius, radius) if each == axis else (0, 0) for each in range(3)], mode="edge")
    parts = (jax.lax.slice_in_dim(wide, i, i + size, axis=axis) for i in range(len(weights)))
    return sum((weight[None] * part for weight, part in zip(weights, parts, strict=True)), jnp.zeros_like(planes))


def _around(planes: jax.Array) -> list[jax.Array]:
    """The eight neighbours of every pixel of planes [C, H, W]; beyond the border the nearest pixel's."""
    height, width = planes.shape[1:]
    wide = jnp.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="edge")
    return [wide[:, dy : dy + height, dx : dx + width] for dy, dx in np.ndindex(3, 3) if (dy, dx) != (1, 1)]


def _find_way(motion: jax.Array, beyond: jax.Array) -> jax.Array:
    """[H, W] the square of the way, in pixels, that a mixture may have changed by.

    Of all motion within 3x3 pixels, that is the farthest from the whole pixels that the pixel itself has moved by: as
    mixtures stay what they are where all moves by whole pixels.
    """
    planes = motion.transpose(2, 0, 1)
    steps = jnp.round(planes)
    ways = (add_planes((each - steps) ** 2) for each in (planes, *_around(planes)))
    return functools.reduce(jnp.maximum, ways, beyond**2)
