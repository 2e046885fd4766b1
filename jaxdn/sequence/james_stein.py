"""A noisy image and what a denoiser made of it, combined so that the result is not worse than either.

What a denoiser changes, ``d = noisy - denoised``, is noise that it took away and detail that it lost. Both are apart
in scale. Noise differs from pixel to pixel and is gone in a mean; a shadow, a highlight or a reflection that was
blurred is a few pixels wide. So d, relative to the light, is split by the a-trous wavelet transform with the B3 spline
(Holschneider et al. 1989; Starck and Murtagh, "Image restoration with noise suppression using the wavelet transform",
1994): ``d = D0 + D1 + D2 + D3 + rest``. Of white noise with the variance V, band b has ``GAINS[b] V``: 0.79, 0.040,
0.0073, 0.0017, and the rest 0.00055. Each gets the weight of James and Stein's estimator,

    w_b = max(0, 1 - c_b GAINS[b] V / E_b),    c_b = 1 + DOUBT[b] / sqrt(n),

where E_b is the band's mean square in a window and n the number of equal values with the same fourth moment, by which
E_b is uncertain (Efron and Morris, "Stein's estimation rule and its competitors", 1973; for renderings, with variances
from the renderer: Gu et al., "Neural James-Stein Combiner for Unbiased and Biased Renderings", 2022). What is kept of
the coarse bands brings hardly any noise with it: of a mean over 8x8 pixels, 1/64.

V is the less of two estimates in windows, but at least half of the second:

* by scale: lost detail has at least ``SLOPE`` times as much energy in the finest band as in the next one, where noise
  has 20 times. ``E_0 = GAINS[0] V + SLOPE x`` and ``E_1 = GAINS[1] V + x`` give V;
* by direction: the mean of squared second differences of d (Immerkaer, "Fast Noise Variance Estimation", 1996), along
  that of four directions in which it is smallest, because edges are smooth along themselves.

The first alone would be 0 where all was blurred. Texture of single pixels looks like noise to both, but it is seldom
everywhere, and noise is: of little noise, V is at most that of the quietest block of surfaces around. Noise differs
from place to place, too, so that this holds only where the denoiser blurred, because then band 2 has more energy than
noise explains, or where a block that is not brighter has a small part of the noise (:data:`QUIETER`). A brighter block
tells how much noise there is in light, not in its share: sun beside a shadow adds light without noise. One that has far
less noise besides may be a window or another lamp, whose own light is not drawn by samples. Of much noise all this
would be far too little, because few samples are mostly dark, with a few bright ones. The first two hold for renderers
that filter their pixels by drawing samples from the filter, as Cycles and our renderer do: the noise of two pixels is
independent. Neither is moved by single values, because d is Winsorized (Tukey 1962): it counts as at most :data:`BOUND`
times the light, unless most of the 3x3 pixels around agree. Light is that of the denoised image plus a share of its
median, which no lamp moves.

Where many of the blocks around have no noise at all, the image is kept as it is. Where nothing was rendered, as in a
sky, that says nothing.

Colours are planes here, [3, H, W], and what a pixel has one of is [1, H, W]: XLA:CPU vectorises neither three colours
side by side nor sums over them.
"""

import functools
import math
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.filters.atrous import B3_SPLINE
from jaxdn.ops.medians import median
from jaxdn.ops.scales import join_planes, to_pixels, to_planes
from jaxdn.ops.windows import smooth, window_means
from jaxdn.sequence.change import mean, mean_square, second_differences, winsorize

GAINS = (0.8907**2, 0.2007**2, 0.0856**2, 0.0413**2, 0.0009009)
"""Variance of each band, and of the rest, of white noise of variance 1, in two dimensions (Starck and Murtagh)."""
DOUBT = (4.0, 8.0, 16.0, 32.0, math.inf)
"""A band's c - 1, times the root of the number of values: twice as much for each band, whose values are as many times
fewer independent ones. With 1 instead of 4, a denoiser that is 25 dB better than its input loses 1.8 dB, and Cycles
frames gain 0.2 dB more."""
MOST_DOUBT = 9.0
RADII = (7, 7, 7, 15, 15)
"""Of each band's window: 2 r + 1 pixels a side."""
BOUND = 3.0
"""d counts as at most so many times the light."""
SLOPE = 2.0
"""Least energy of lost detail in the finest band, relative to the next one. In frames of Cycles and of our renderer
it is 3 to 18, of strongly blurred ones 1 to 2."""
_DIRECTION_BIAS = 1.1
"""One over the mean of the least of four measured variances of noise in a window, relative to its variance."""
_LEAST = 0.5
_TAPS = tuple(map(float, B3_SPLINE[2:]))
_NEAR = 4
"""Of the windows for what is mostly without noise."""
_DARK = 0.05
"""Differences are relative to the light plus this share of the image's median."""

BLOCK = 8
"""Side of the blocks that may be without noise, in pixels."""
CLEAN = (0.01, 0.02)
"""Noise, as a share of the light, up to which a block has none, and from which it has some."""
LAMP = 5.0
"""Light of a block without noise, relative to the median, above which it may be a lamp in view, which has none whatever
is beside it: what is white has 5 times the light of middle grey."""
NONE = (0.001, 0.002)
"""The same of light that is not drawn by samples at all; after 4,096 of them, light has more noise."""
LITTLE = (0.2, 0.3)
"""Noise, as a share of the light, up to which that of the quietest block counts, and from which it does not."""
QUIET = 2
"""Blocks on each side of a pixel's own among which the quietest is sought."""
_QUIETEST = 1.88
"""Variance of grey Gaussian noise, relative to the mean of the least of its measured ones in so many blocks."""
BLURRED = (1.0, 1.6)
"""Energy of the third band, relative to that of noise, up to which the denoiser blurred nothing here, and from which it
did: half of the pixels of Open Image Denoise have 0.3 to 0.8, of ``svgf`` 3 to 12."""
QUIETER = (0.08, 0.16)
"""Noise (variance) of the quietest block around that is not brighter, relative to a pixel's, up to which the quietest
counts although nothing was blurred, and from which it does not. Rendered noise differs by so much where light does."""
BRIGHTER = 1.02
"""Light of a block, relative to that of a pixel's own, above which it is brighter: denoised walls are as even."""
_NO_BLOCK = 1e9
_TINY = 1e-12
MANY = (0.25, 0.5)
"""Share of such blocks around from which on pixels begin to be kept, and from which on they are."""
AROUND = 4
"""Blocks on each side of a pixel's own that are looked at."""
LOST, LOST_TO_NOISE, USELESS = (0.25, 0.35), (0.9, 1.2), (2.4, 3.0)
"""Detail, as a share of the light and relative to the noise, up to which a denoised frame is trusted, and from which
not; and relative to noise that is not little, from which on nothing of it is taken. Frames of 96 x 96 pixels lose 0.14
to 0.29 with their own guides, 0.37 to 0.52 with guides turned by 180 degrees."""
RISK = (0.6, 0.9)
"""Estimated error of the combined image, relative to that of the noisy one, up to which the frame is trusted, and from
which it comes back as it came. Frames with their own guides have 0 to 0.45."""
MUCH = (0.4, 0.6)
"""Noise up to which means of relative changes say something, and from which they do not: neither is the rest kept then,
nor is a frame with so much noise in the median mistrusted."""
REACH = 64
"""Pixels farther away do not decide about one: the bands reach 30 and their windows 15, blocks and what is
interpolated between them 52."""


class JamesStein(NamedTuple):
    """The combined image and what it was decided by; all but the image are [H, W, 1]."""

    image: jax.Array
    """[H, W, 3]."""
    noisy_weight: jax.Array
    """In [0, 1], how much of the noisy pixel is in it."""
    noise: jax.Array
    """The noisy image's noise (standard deviation), as a share of the light."""
    lost: jax.Array
    """What else the denoiser changed, in the same unit: detail, or what its guides drew into the image."""
    risk: jax.Array
    """Estimated squared error of the combined image, as it is seen (:func:`_visibility`)."""
    noisy_risk: jax.Array
    """The same of the noisy image."""


class Confidence(NamedTuple):
    """How far a denoised frame is to be trusted; scalars."""

    noise: jax.Array
    """The median of its noise, of pixels that have more than :data:`CLEAN` if there are any: a sky has none."""
    lost: jax.Array
    """The root of the mean square of what was lost."""
    doubt: jax.Array
    """In [0, 1], whether more was lost than noise explains, as with guides of another picture."""
    fallback: jax.Array
    """In [0, 1], the weight of the noisy image against the combined one; 0 is full confidence."""


def combine(
    noisy: jax.Array,
    denoised: jax.Array,
    level: jax.Array | float | None = None,
    surface: jax.Array | None = None,
) -> JamesStein:
    """The mixture of a noisy image [H, W, 3] and its denoised version, linear radiance of any unit.

    Noisy values that are not finite are not used. Pixels up to :data:`REACH` away decide about one, and ``level``.
    Raises ValueError for other shapes.

    Args:
      noisy: what was rendered.
      denoised: what was made of it.
      level: :func:`measure_level` of the denoised image, or of the one that it is a tile of; None: it is the whole one.
      surface: [H, W, 1] bool, where anything was rendered; None: everywhere.
    """
    check_image(noisy, "noisy", channels=3)
    check_same_size(noisy, denoised, ("noisy", "denoised"))
    level = measure_level(denoised) if level is None else level
    planes, before = (join_planes([("pixels", jnp.asarray(image))]) for image in (denoised, noisy))
    known = None if surface is None else to_planes(surface)
    usable = jnp.all(jnp.isfinite(before), axis=0, keepdims=True)
    light = jnp.maximum(mean(planes), 0.0) + _DARK * level
    light = jnp.where(light > 0, light, 1.0)
    whole = jnp.where(usable, before - planes, 0.0) / light
    change, common = winsorize(whole, BOUND)
    curved = second_differences(change)
    bands = _split(change)
    energies = [_energy(band, radius) for band, radius in zip(bands, RADII, strict=True)]
    sampled = _sampled(curved, light, level, known)
    variance = _measure_noise([energy for energy, _ in energies[:3]], curved, light, sampled)
    weights = _weigh(energies, mean_square(_split(whole)[-1] - bands[-1]), variance)
    kept = sum(weight * band for weight, band in zip(weights, bands, strict=True))
    own = sum(weight * center for weight, center in zip(weights, _CENTERS, strict=True))
    clean = _enlarge_clean(curved, sampled)
    own, kept = own + clean * (1 - own), kept + clean * (change - kept)
    # A firefly among quiet blocks is noise none the less.
    own, kept, clean = (jnp.where(usable & (common > 0), part, 0.0) for part in (own, kept, clean))
    # Stein's estimate: the mean square of what is left, less the noise in it, of which `own` stays in the image.
    risk = mean_square(change - kept) + (2 * own - 1) * variance
    lost = jnp.sqrt(jnp.maximum(window_means(mean_square(change), RADII[0]) - variance, 0.0))
    image = jnp.where(clean == 1, before, planes + light * kept)
    seen = _visibility(light, level)
    return JamesStein(*map(to_pixels, (image, own, jnp.sqrt(variance), lost, seen * risk, seen * variance)))


def keep_detail(noisy: jax.Array, denoised: jax.Array) -> jax.Array:
    """The mixture of images [H, W, C] that are mostly without noise, as alpha is, by noise around each pixel alone.

    As :func:`combine` in one band: ``denoised + w d`` with ``w = max(0, 1 - 2 V / E)``, where E is the mean square of d
    and V its noise by direction, in windows of :data:`_NEAR`. Blocks without noise say nothing of those beside them.
    """
    change = to_planes(noisy - denoised)
    variance = _DIRECTION_BIAS * _least(window_means(second_differences(change), _NEAR))
    energy = window_means(mean_square(change), _NEAR)
    weight = jnp.where(energy > 0, 1 - 2 * variance / jnp.where(energy > 0, energy, 1.0), 0.0)
    return denoised + to_pixels(jnp.clip(weight, 0.0, 1.0)) * (noisy - denoised)


def measure_confidence(combined: JamesStein) -> Confidence:
    """Whether a denoised frame is to be trusted, and the combined one at all.

    Guides of another picture draw their own edges everywhere: more is lost than noise was taken away. Part of that
    counts as noise, so that too much of it stays. Where the combined image's estimated error is about that of the noisy
    one, the noisy one is the result.
    """
    noise = median(combined.noise, combined.noise > CLEAN[0])
    noise = jnp.where(noise > 0, noise, median(combined.noise))
    lost = jnp.sqrt(jnp.mean(combined.lost**2))
    noisy_risk = jnp.sum(combined.noisy_risk)
    relative = jnp.sum(combined.risk) / jnp.where(noisy_risk > 0, noisy_risk, 1.0)
    much, ratio = 1 - _falling(lost, *LOST), lost / jnp.maximum(noise, 1e-6)
    risky = (1 - _falling(relative, *RISK)) * _falling(noise, *MUCH)
    doubt = 1 - _falling(ratio, *LOST_TO_NOISE)
    useless = jnp.maximum(1 - _falling(ratio, *USELESS), _falling(noise, *LITTLE) * doubt)
    return Confidence(noise, lost, much * doubt, jnp.maximum(risky, much * useless))


def measure_level(denoised: jax.Array) -> jax.Array:
    """The median light of an image [H, W, 3] where it is lit; 0 for a black one."""
    light = jnp.mean(denoised, axis=-1)
    return jnp.nan_to_num(median(jnp.maximum(light, 0.0), light > 0))


def _split(image: jax.Array) -> list[jax.Array]:
    """The bands [3, H, W] of an image, the finest first, and the rest; they add up to it."""
    bands = []
    for band in range(len(GAINS) - 1):
        coarse = smooth(image, _TAPS, 2**band)
        bands.append(image - coarse)
        image = coarse
    return [*bands, image]


def _centers() -> tuple[float, ...]:
    """What a pixel of each band, and of the rest, has of the pixel itself."""
    impulse = np.zeros((1, 129))
    impulse[0, 64] = 1
    line = [impulse[0]]
    for band in range(len(GAINS) - 1):
        spread = np.zeros(4 * 2**band + 1)
        spread[:: 2**band] = B3_SPLINE
        line.append(np.convolve(line[-1], spread, mode="same"))
    bands = [one[64] ** 2 - other[64] ** 2 for one, other in pairwise(line)]
    return tuple(map(float, [*bands, line[-1][64] ** 2]))


_CENTERS = _centers()


def _energy(band: jax.Array, radius: int) -> tuple[jax.Array, jax.Array]:
    """The mean square of a band in windows, and the mean of the squares of that of pixels, [1, H, W] each."""
    square = mean_square(band)
    energy, fourth = jnp.split(window_means(jnp.concatenate([square, square**2]), radius), 2)
    return energy, fourth


def _measure_noise(energies: list[jax.Array], curved: jax.Array, light: jax.Array, sampled: jax.Array) -> jax.Array:
    """V of each pixel, [1, H, W], by the energies of the three finest bands and the second differences."""
    finest, next_one, third = energies
    by_scale = jnp.maximum(finest - SLOPE * next_one, 0.0) / (GAINS[0] - SLOPE * GAINS[1])
    by_direction = _DIRECTION_BIAS * _least(window_means(curved, RADII[0]))
    variance = jnp.clip(by_scale, _LEAST * by_direction, by_direction)
    quiet, darker = _quietest(curved, light, sampled)
    some = jnp.maximum(by_direction, _TINY)
    blurred = 1 - _falling(third / (GAINS[2] * some), *BLURRED)
    texture = jnp.maximum(blurred, _falling(darker / some, *QUIETER)) * _falling(jnp.sqrt(by_direction), *LITTLE)
    return variance + texture * (jnp.minimum(variance, quiet) - variance)


def _quietest(curved: jax.Array, light: jax.Array, sampled: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The least noise that blocks near each pixel [1, H, W] allow, without bias; interpolated between them.

    And that of the blocks which are not brighter than the pixel's own, as it is.

    Blocks count that are ``sampled`` altogether (:func:`_sampled`). Few without any noise, among others that have some,
    may be a screen in view, and say nothing of what is beside it: they and those that they touch, whose pixels may be
    theirs in part, count as if they had much. The result is very large where no block counts. A brighter block says how
    much noise there is in light, not in its share: where a sun adds light without noise, that share is smaller.
    """
    blocks, bright = _least(_mean_blocks(curved)), _mean_blocks(light)
    few = _falling(jnp.sqrt(blocks), *NONE) * _falling(_share_of_quiet(blocks, sampled), *MANY)
    touched = jax.lax.reduce_window(few, 0.0, jax.lax.max, (1, 3, 3), (1, 1, 1), "SAME")
    blocks = jnp.where(sampled == 1, blocks + touched * LITTLE[1] ** 2, _NO_BLOCK)
    rows, columns = blocks.shape[1:]
    widths = ((0, 0), (QUIET, QUIET), (QUIET, QUIET))
    around = [jnp.pad(image, widths, constant_values=value) for image, value in ((blocks, _NO_BLOCK), (bright, 0.0))]
    least = darker = jnp.full_like(blocks, _NO_BLOCK)
    for dy, dx in np.ndindex(2 * QUIET + 1, 2 * QUIET + 1):
        noise, other = (image[:, dy : dy + rows, dx : dx + columns] for image in around)
        least = jnp.minimum(least, noise * jnp.maximum(other / bright, 1.0) ** 2)
        darker = jnp.minimum(darker, jnp.where(other <= BRIGHTER * bright, noise, _NO_BLOCK))
    return _QUIETEST * _enlarge(least, light.shape[1:]), _QUIETEST * _enlarge(darker, light.shape[1:])


def _weigh(energies: list[tuple[jax.Array, jax.Array]], cut: jax.Array, variance: jax.Array) -> list[jax.Array]:
    """The weight of each band, [1, H, W] each.

    Where Winsorizing cut off light, the mean of what it left is too low: the square of that is ``cut`` [1, H, W], by
    the rest of the whole change. It counts as noise of the bands' rest. Of much noise that rest is not kept at all: the
    mean of noisy over denoised light is not 1, where noise is left in both.
    """
    biases = [0.0] * (len(energies) - 1) + [window_means(cut, RADII[-1])]
    weights = []
    for (energy, fourth), bias, gain, doubt, radius in zip(energies, biases, GAINS, DOUBT, RADII, strict=True):
        noise = bias + gain * (variance if radius == RADII[0] else window_means(variance, radius))
        number = (2 * radius + 1) ** 2 * energy**2 / jnp.where(fourth > 0, fourth, 1.0)
        excess = jnp.minimum(doubt / jnp.sqrt(jnp.maximum(number, 1.0)), MOST_DOUBT)
        weights.append(jnp.clip(1 - (1 + excess) * noise / jnp.where(energy > 0, energy, 1.0), 0.0, 1.0))
    weights[-1] = weights[-1] * _falling(jnp.sqrt(variance), *MUCH)
    return weights


def _sampled(curved: jax.Array, light: jax.Array, level: jax.Array | float, surface: jax.Array | None) -> jax.Array:
    """[1, h, w] the share of each block that may have noise: none of a sky, nor of what may be a lamp in view.

    That is bright and has no noise. What is bright and noisy is none: a thing before black is far above the median.
    """
    bright = _mean_blocks(light) > LAMP * jnp.asarray(level)
    known = jnp.ones_like(bright, light.dtype) if surface is None else _mean_blocks(surface.astype(light.dtype))
    return jnp.where(bright, known * (1 - _falling(jnp.sqrt(_least(_mean_blocks(curved))), *CLEAN)), known)


def _share_of_quiet(blocks: jax.Array, sampled: jax.Array) -> jax.Array:
    """[1, h, w] the share of blocks without noise, of those around that may have some."""
    known = (sampled > 0.5).astype(blocks.dtype)
    number = window_means(known, AROUND)
    return window_means(_falling(jnp.sqrt(blocks), *CLEAN) * known, AROUND) / jnp.where(number > 0, number, 1.0)


def _enlarge_clean(curved: jax.Array, sampled: jax.Array) -> jax.Array:
    """How far pixels are among blocks without noise, [1, H, W] in [0, 1].

    The share of such blocks is interpolated between blocks, before it is decided.
    """
    share = _share_of_quiet(_least(_mean_blocks(curved)), sampled)
    return 1 - _falling(_enlarge(share, curved.shape[1:]), *MANY)


def _enlarge(blocks: jax.Array, size: tuple[int, ...]) -> jax.Array:
    """[1, h, w] blocks of :data:`BLOCK` pixels a side, interpolated."""
    rows, columns = blocks.shape[1:]
    height, width = size
    return jax.image.resize(blocks, (1, rows * BLOCK, columns * BLOCK), "linear")[:, :height, :width]


def _mean_blocks(image: jax.Array) -> jax.Array:
    """[C, h, w] the means of blocks of [C, H, W]; at the end of the frame the last pixels are repeated."""
    channels, height, width = image.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    widths = ((0, 0), (0, rows * BLOCK - height), (0, columns * BLOCK - width))
    return jnp.mean(jnp.pad(image, widths, mode="edge").reshape(channels, rows, BLOCK, columns, BLOCK), axis=(2, 4))


def _least(planes: jax.Array) -> jax.Array:
    """[1, H, W] of planes [C, H, W], plane by plane as :func:`mean`."""
    return functools.reduce(jnp.minimum, jnp.split(planes, len(planes)))


def _visibility(light: jax.Array, level: jax.Array | float) -> jax.Array:
    """The squared slope of x / (1 + x) over log x, where x is the light with the level at middle grey."""
    x = 0.18 * light / jnp.where(jnp.asarray(level) > 0, level, 1.0)
    return (x / (1 + x) ** 2) ** 2


def _falling(x: jax.Array, low: float, high: float) -> jax.Array:
    """1 up to ``low``, 0 from ``high`` on, smooth between them."""
    part = jnp.clip((high - x) / (high - low), 0.0, 1.0)
    return part * part * (3 - 2 * part)
