"""A noisy image and what a denoiser made of it, combined so that the result is not worse than either.

What a denoiser changes, ``d = noisy - denoised``, is noise that it took away and detail that it lost. With the noise's
variance ``V``, the best mixture ``denoised + w d`` has the weight that James and Stein's estimator has,

    w = max(0, 1 - c V / mean(d^2)),

where the mean is over a window: nothing of ``d`` where all of it is noise, all where none is (Efron and Morris,
"Stein's estimation rule and its competitors", 1973; for renderings: Gu et al., "Neural James-Stein Combiner for
Unbiased and Biased Renderings", 2022, whose V comes from the renderer's samples).

Here V comes from the image alone. Noise of a renderer without a pixel filter differs from pixel to pixel, lost detail
mostly does not: V is the mean of squared second differences of ``d``, which are free of slopes (Immerkaer, "Fast Noise
Variance Estimation", 1996, whose mask is the same in two dimensions), along that of four directions in which it is
smallest, because edges are smooth along themselves.

Texture of single pixels has no such direction, but it is seldom everywhere, and noise is: where there is little noise,
V is that of the quietest block of pixels around. Of much noise this would be far too little, because few samples are
mostly dark, with a few bright ones: there the mean of the whole window counts.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.core.frame import RADIANCE_MAX
from jaxdn.core.separable import correlate

RADIUS = 7
"""Windows have 2 RADIUS + 1 = 15 pixels a side."""
DOUBT, MOST = 2.0, 2.0
"""c = 1 + DOUBT / sqrt(n), at most 1 + MOST: V is uncertain by the inverse root of the number n of values it is from.
Where there is little noise, the quietest block decides, and c - 1 is half of that."""
CLEAN, NOISY = 0.02, 0.06
"""Noise, as a share of the light, up to which a region is left as it is, and from which the weight above decides."""
BLOCK = 32
"""Side of the regions whose noise is judged, in pixels."""
REACH = 2 * BLOCK + RADIUS + 1
"""In pixels: the next region, with the windows of its pixels."""
_DARK = 0.05
"""Differences are relative to the light plus this share of the image's mean."""
_WHITE, _STRONG = 0.7, 0.1
"""What is so much noise of so large a mean square is not kept in a clean region either: a firefly."""
_OUTLIER, _ISOLATED = 50.0, 0.4
"""A pixel that is brighter than what was made of it, by so many times the mean square around it, is a firefly too, if
it is isolated: its second differences are large in all directions (two thirds of its square for a single pixel)."""
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))

QUIET = 8
"""Side of the blocks whose noise is compared, in pixels; :data:`BLOCK` is a multiple of it."""
LITTLE, MUCH = 0.4, 0.6
"""Noise, as a share of the light, up to which that of the quietest block counts, and from which that of the window."""
LOST, LOST_TO_NOISE = (0.25, 0.35), (0.9, 1.2)
"""Detail, as a share of the light and relative to the noise, up to which a denoised frame is trusted, and from which
not. Frames of 96 x 96 pixels lose 0.14 to 0.29 with their own guides, 0.37 to 0.52 with guides turned by 180 degrees.
"""
_LEAST = {1: 1.68, 2: 1.88}
"""Blocks around a pixel's own on each side -> variance of grey Gaussian noise, relative to the mean of the least of
their measured ones."""


class JamesStein(NamedTuple):
    """The combined image and what it was decided by."""

    image: jax.Array
    """[H, W, 3]."""
    noisy_weight: jax.Array
    """[H, W, 1] in [0, 1], how much of the noisy image is in it."""
    noise: jax.Array
    """[H, W, 1] the noisy image's noise (standard deviation), as a share of the light."""
    lost: jax.Array
    """[H, W, 1] what else the denoiser changed, in the same unit: detail, or what its guides drew into the image."""


class Confidence(NamedTuple):
    """How far a denoised frame is to be trusted; scalars."""

    noise: jax.Array
    """The median of its noise."""
    lost: jax.Array
    """The root of the mean square of what was lost."""
    fallback: jax.Array
    """In [0, 1], the weight of the noisy image against the combined one; 0 is full confidence."""


def combine(
    noisy: jax.Array,
    denoised: jax.Array,
    mean_light: jax.Array | float | None = None,
    *,
    texture_unknown: bool = False,
) -> JamesStein:
    """The mixture of a noisy image [H, W, 3] and its denoised version, linear radiance >= 0.

    Noisy values that are not finite, negative or above ``RADIANCE_MAX`` are not used. Pixels up to :data:`REACH` away
    decide about one, and ``mean_light``. Raises ValueError for other shapes.

    Args:
      noisy: what was rendered.
      denoised: what was made of it.
      mean_light: the mean of the denoised image, or of the one that it is a tile of; None: it is the whole one.
      texture_unknown: no guide told the denoiser of textures. It has lost them, and quiet blocks are sought farther
        away.
    """
    check_image(noisy, "noisy", channels=3)
    check_same_size(noisy, denoised, ("noisy", "denoised"))
    usable = jnp.all(jnp.isfinite(noisy) & (noisy >= 0) & (noisy <= RADIANCE_MAX), axis=-1, keepdims=True)
    change = jnp.where(usable, noisy - denoised, 0.0)
    light = jnp.mean(denoised, axis=-1, keepdims=True)
    light = light + _DARK * (jnp.mean(light) if mean_light is None else mean_light)
    # Limited, so that the fourth power is finite.
    relative = jnp.clip(change / jnp.where(light > 0, light, 1.0), -1e4, 1e4)
    energy, variance, number = _moments(relative, texture_unknown=texture_unknown)
    doubt = jnp.minimum(DOUBT / jnp.sqrt(number), MOST) * (1 - 0.5 * _falling(jnp.sqrt(variance), LITTLE, MUCH))
    weight = jnp.clip(1 - (1 + doubt) * variance / jnp.where(energy > 0, energy, 1.0), 0.0, 1.0)
    firefly = (variance > _WHITE * energy) & (energy > _STRONG)
    kept = jnp.where(firefly, 0.0, _clean(jnp.sqrt(variance)))
    weight = weight + (1 - weight) * kept
    lost = jnp.sqrt(jnp.maximum(energy - variance, 0.0))
    return JamesStein(denoised + weight * change, jnp.where(usable, weight, 0.0), jnp.sqrt(variance), lost)


def measure_confidence(combined: JamesStein) -> Confidence:
    """Whether a denoised frame is to be trusted at all: not where more of it is lost than noise was taken away.

    Guides of another picture draw their own edges everywhere, textures that no guide tells of are lost everywhere, and
    in either case what was drawn counts as noise, so that pixel by pixel too much of it stays. Up to :data:`LOST` all
    is well.
    """
    noise, lost = jnp.median(combined.noise), jnp.sqrt(jnp.mean(combined.lost**2))
    relative = lost / jnp.maximum(noise, 1e-6)
    fallback = (1 - _falling(lost, *LOST)) * (1 - _falling(relative, *LOST_TO_NOISE))
    return Confidence(noise, lost, fallback)


def _moments(change: jax.Array, *, texture_unknown: bool = False) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of each pixel's window, [H, W, 1] each: the mean square, the variance of noise, and the number of values.

    The number is that of equal values with the same fourth moment: 1 if all is in one pixel.
    """
    height, width = change.shape[:2]
    # Mirrored: repeated pixels at the border would look smooth.
    padded = jnp.pad(change, ((1, 1), (1, 1), (0, 0)), mode="reflect")

    def at(dy: int, dx: int) -> jax.Array:
        return padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    curved = [at(dy, dx) - 2 * change + at(-dy, -dx) for dy, dx in _DIRECTIONS]
    curved = [jnp.mean(one**2, axis=-1) / 6 for one in curved]
    square = jnp.mean(change**2, axis=-1)
    moments = [jnp.ones_like(square), square, square**2, *curved]
    planes = jnp.pad(jnp.stack(moments, axis=-1), ((RADIUS, RADIUS), (RADIUS, RADIUS), (0, 0)))
    for axis in (-3, -2):
        planes = correlate(planes, np.ones((2 * RADIUS + 1, 1)), axis=axis)
    count, energy, fourth, variance = planes[..., :1], planes[..., 1:2], planes[..., 2:3], planes[..., 3:]
    number = jnp.where(fourth > 0, energy**2 / jnp.where(fourth > 0, fourth, 1.0), count)
    energy, variance = energy / count, jnp.min(variance, axis=-1, keepdims=True) / count
    little = _falling(jnp.sqrt(variance), LITTLE, MUCH)
    isolated = functools.reduce(jnp.minimum, curved) > _ISOLATED * square
    outlier = (square > _OUTLIER * energy[..., 0]) & isolated & (jnp.mean(change, axis=-1) > 0)
    quiet = jnp.minimum(variance, _quietest(curved, around=2 if texture_unknown else 1))
    return energy, variance + jnp.where(outlier[..., None], 0.0, little) * (quiet - variance), jnp.maximum(number, 1.0)


def _quietest(squares: list[jax.Array], *, around: int) -> jax.Array:
    """The least mean of squares [H, W] over blocks near each pixel and over directions, [H, W, 1], without its bias.

    The block of a pixel and ``around`` more on each side are compared, and what is found is interpolated.
    """
    height, width = squares[0].shape
    rows, columns = -(-height // QUIET), -(-width // QUIET)
    widths = ((0, rows * QUIET - height), (0, columns * QUIET - width))
    padded = jnp.pad(jnp.stack(squares), ((0, 0), *widths), mode="edge")
    least = jnp.min(jnp.mean(padded.reshape(-1, rows, QUIET, columns, QUIET), axis=(2, 4)), axis=0)
    side = 2 * around + 1
    least = jax.lax.reduce_window(least, jnp.inf, jax.lax.min, (side, side), (1, 1), "SAME")
    return _LEAST[around] * _enlarged(least, QUIET)[:height, :width]


def _clean(noise: jax.Array) -> jax.Array:
    """How clean a region is, [H, W, 1] in [0, 1], by the median noise [H, W, 1] of blocks, interpolated between them.

    A region whose flat parts are without noise has none at its edges either, whatever was lost there.
    """
    height, width = noise.shape[:2]
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    widths = ((0, rows * BLOCK - height), (0, columns * BLOCK - width))
    blocks = jnp.pad(noise[..., 0], widths, mode="edge").reshape(rows, BLOCK, columns, BLOCK)
    return _falling(_enlarged(jnp.median(blocks, axis=(1, 3)), BLOCK)[:height, :width], CLEAN, NOISY)


def _enlarged(blocks: jax.Array, side: int) -> jax.Array:
    """[h, w] interpolated to [side h, side w, 1]."""
    height, width = blocks.shape
    return jax.image.resize(blocks, (side * height, side * width), "linear")[..., None]


def _falling(x: jax.Array, low: float, high: float) -> jax.Array:
    """1 up to ``low``, 0 from ``high`` on, smooth between them."""
    part = jnp.clip((high - x) / (high - low), 0.0, 1.0)
    return part * part * (3 - 2 * part)
