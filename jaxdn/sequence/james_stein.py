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
noise explains, or where the quietest block has a small part of the noise (:data:`QUIETER`). A brighter block tells how
much noise there is in light, not in its share: sun beside a shadow adds light without noise. Of much noise all this
would be far too little, because few samples are mostly dark, with a few bright ones. The first two hold for renderers
that filter their pixels by drawing samples from the filter, as Cycles and our renderer do: the noise of two pixels is
independent. Neither is moved by single values, because d is Winsorized (Tukey 1962): it counts as at most :data:`BOUND`
times the light, unless most of the 3x3 pixels around agree. Light is that of the denoised image plus a share of its
median, which no lamp moves.

Where many of the blocks around have no noise at all, the image is kept as it is. Where nothing was rendered, as in a
sky, that says nothing.
"""

import functools
import math
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.core.medians import median, median_3x3
from jaxdn.core.separable import correlate
from jaxdn.filters.atrous import B3_SPLINE

GAINS = (0.8907**2, 0.2007**2, 0.0856**2, 0.0413**2, 0.0009009)
"""Variance of each band, and of the rest, of white noise of variance 1, in two dimensions (Starck and Murtagh)."""
DOUBT = (4.0, 8.0, 16.0, 32.0, math.inf)
"""A band's c - 1, times the root of the number of values: twice as much for each band, whose values are as many times
fewer independent ones. With 1 instead of 4, a denoiser that is 25 dB better than its input loses 1.8 dB, and Cycles
frames gain 0.2 dB more."""
MOST_DOUBT = 9.0
RADII = (7, 7, 7, 15, 15)
"""Of each band's window: 2 r + 1 pixels a side."""
SLOPE = 2.0
"""Least energy of lost detail in the finest band, relative to the next one. In frames of Cycles and of our renderer
it is 3 to 18, of strongly blurred ones 1 to 2."""
BOUND = 3.0
"""d counts as at most so many times the light."""
_DIRECTION_BIAS = 1.1
"""One over the mean of the least of four measured variances of noise in a window, relative to its variance."""
_LEAST = 0.5
_NEAR = 4
"""Of the windows for what is mostly without noise."""
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_DARK = 0.05
"""Differences are relative to the light plus this share of the image's median."""

BLOCK = 8
"""Side of the blocks that may be without noise, in pixels."""
CLEAN = (0.01, 0.02)
"""Noise, as a share of the light, up to which a block has none, and from which it has some."""
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
"""Noise (variance) of the quietest block around, relative to a pixel's, up to which that counts although nothing was
blurred, and from which it does not. Rendered noise differs by so much where the light does."""
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
    """The median of its noise."""
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
    usable = jnp.all(jnp.isfinite(noisy), axis=-1, keepdims=True)
    level = measure_level(denoised) if level is None else level
    light = jnp.maximum(jnp.mean(denoised, axis=-1, keepdims=True), 0.0) + _DARK * level
    light = jnp.where(light > 0, light, 1.0)
    whole = jnp.where(usable, noisy - denoised, 0.0) / light
    change, common = _winsorize(whole)
    curved = _second_differences(change)
    bands = _split(change)
    variance = _measure_noise(bands, curved, light, surface)
    weights = _weigh(bands, _split(whole)[-1], variance)
    kept = sum(weight * band for weight, band in zip(weights, bands, strict=True))
    own = sum(weight * center for weight, center in zip(weights, _CENTERS, strict=True))
    clean = _clean(curved, surface)
    own, kept = own + clean * (1 - own), kept + clean * (change - kept)
    # A firefly among quiet blocks is noise none the less.
    own, kept, clean = (jnp.where(usable & common, part, 0.0) for part in (own, kept, clean))
    # Stein's estimate: the mean square of what is left, less the noise in it, of which `own` stays in the image.
    risk = _mean_square(change - kept) + (2 * own - 1) * variance
    lost = jnp.sqrt(jnp.maximum(_window(_mean_square(change), RADII[0]) - variance, 0.0))
    image = jnp.where(clean == 1, noisy, denoised + light * kept)
    seen = _visibility(light, level)
    return JamesStein(image, own, jnp.sqrt(variance), lost, seen * risk, seen * variance)


def keep_detail(noisy: jax.Array, denoised: jax.Array) -> jax.Array:
    """The mixture of images [H, W, C] that are mostly without noise, as alpha is, by noise around each pixel alone.

    As :func:`combine` in one band: ``denoised + w d`` with ``w = max(0, 1 - 2 V / E)``, where E is the mean square of d
    and V its noise by direction, in windows of :data:`_NEAR`. Blocks without noise say nothing of those beside them.
    """
    change = noisy - denoised
    by_direction = _window(_second_differences(change), _NEAR)
    variance = _DIRECTION_BIAS * jnp.min(by_direction, axis=-1, keepdims=True)
    energy = _window(_mean_square(change), _NEAR)
    weight = jnp.where(energy > 0, 1 - 2 * variance / jnp.where(energy > 0, energy, 1.0), 0.0)
    return denoised + jnp.clip(weight, 0.0, 1.0) * change


def measure_confidence(combined: JamesStein) -> Confidence:
    """Whether a denoised frame is to be trusted, and the combined one at all.

    Guides of another picture draw their own edges everywhere: more is lost than noise was taken away. Part of that
    counts as noise, so that too much of it stays. Where the combined image's estimated error is about that of the noisy
    one, the noisy one is the result.
    """
    noise, lost = median(combined.noise), jnp.sqrt(jnp.mean(combined.lost**2))
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


def _winsorize(change: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Changes within :data:`BOUND`, or the median size of the 3x3 around if that is more; and [H, W, 1] which were."""
    size = jnp.mean(jnp.abs(change), axis=-1)
    bound = jnp.maximum(median_3x3(size), BOUND)[..., None]
    # Of a size of which the fourth power is finite.
    bounded = jnp.clip(jnp.clip(change, -bound, bound), -1e8, 1e8)
    return bounded, jnp.all(jnp.abs(change) <= bound, axis=-1, keepdims=True)


def _split(image: jax.Array) -> list[jax.Array]:
    """The bands [H, W, C] of an image, the finest first, and the rest; they add up to it."""
    bands = []
    for band in range(len(GAINS) - 1):
        smooth = _smooth(image, 2**band)
        bands.append(image - smooth)
        image = smooth
    return [*bands, image]


def _smooth(image: jax.Array, step: int) -> jax.Array:
    """[H, W, C] filtered with the B3 spline, whose taps are ``step`` apart, mirrored at the border."""
    for axis in (-3, -2):
        widths = [(0, 0)] * 3
        widths[axis] = (2 * step, 2 * step)
        wide, length = jnp.pad(image, widths, mode="symmetric"), image.shape[axis]
        parts = [jax.lax.slice_in_dim(wide, k * step, k * step + length, axis=axis + 3) for k in range(5)]
        image = functools.reduce(jnp.add, (float(tap) * part for tap, part in zip(B3_SPLINE, parts, strict=True)))
    return image


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


def _second_differences(change: jax.Array) -> jax.Array:
    """[H, W, 4] the squares of a change's second differences along each direction; the mean is V for noise."""
    height, width = change.shape[:2]
    # Mirrored: repeated pixels at the border would look smooth.
    padded = jnp.pad(change, ((1, 1), (1, 1), (0, 0)), mode="reflect")

    def at(dy: int, dx: int) -> jax.Array:
        return padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    along = [at(dy, dx) - 2 * change + at(-dy, -dx) for dy, dx in _DIRECTIONS]
    return jnp.concatenate([_mean_square(one) / 6 for one in along], axis=-1)


def _measure_noise(bands: list[jax.Array], curved: jax.Array, light: jax.Array, surface: jax.Array | None) -> jax.Array:
    """V of each pixel, [H, W, 1]."""
    finest, next_one, third = (_window(_mean_square(band), RADII[0]) for band in bands[:3])
    by_scale = jnp.maximum(finest - SLOPE * next_one, 0.0) / (GAINS[0] - SLOPE * GAINS[1])
    by_direction = _DIRECTION_BIAS * jnp.min(_window(curved, RADII[0]), axis=-1, keepdims=True)
    variance = jnp.clip(by_scale, _LEAST * by_direction, by_direction)
    quiet, some = _quietest(curved, light, surface), jnp.maximum(by_direction, _TINY)
    blurred = 1 - _falling(third / (GAINS[2] * some), *BLURRED)
    texture = jnp.maximum(blurred, _falling(quiet / some, *QUIETER)) * _falling(jnp.sqrt(by_direction), *LITTLE)
    return variance + texture * (jnp.minimum(variance, quiet) - variance)


def _quietest(curved: jax.Array, light: jax.Array, surface: jax.Array | None) -> jax.Array:
    """The least noise that blocks of surfaces near each pixel [H, W, 1] allow, without bias; interpolated between them.

    A sky has no noise, and says nothing of what is beside it. The result is very large where there is no such block. A
    brighter block says how much noise there is in light, not in its share: where a sun adds light without noise, that
    share is smaller.
    """
    blocks, bright = jnp.min(_mean_blocks(curved), axis=-1), _mean_blocks(light)[..., 0]
    if surface is not None:
        blocks = jnp.where(_mean_blocks(surface.astype(curved.dtype))[..., 0] == 1, blocks, _NO_BLOCK)
    rows, columns = blocks.shape
    around = [jnp.pad(image, QUIET, constant_values=value) for image, value in ((blocks, _NO_BLOCK), (bright, 0.0))]
    least = jnp.full_like(blocks, _NO_BLOCK)
    for dy, dx in np.ndindex(2 * QUIET + 1, 2 * QUIET + 1):
        noise, other = (image[dy : dy + rows, dx : dx + columns] for image in around)
        least = jnp.minimum(least, noise * jnp.maximum(other / bright, 1.0) ** 2)
    return _QUIETEST * _enlarge(least[..., None], curved.shape[:2])


def _weigh(bands: list[jax.Array], rest: jax.Array, variance: jax.Array) -> list[jax.Array]:
    """The weight of each band, [H, W, 1] each.

    Where Winsorizing cut off light, the mean of what it left is too low: by how much tells ``rest`` [H, W, C], that of
    the whole change. It counts as noise of the bands' rest. Of much noise that rest is not kept at all: the mean of
    noisy over denoised light is not 1, where noise is left in both.
    """
    cut = [0.0] * (len(bands) - 1) + [_window(_mean_square(rest - bands[-1]), RADII[-1])]
    weights = []
    for band, bias, gain, doubt, radius in zip(bands, cut, GAINS, DOUBT, RADII, strict=True):
        square = _mean_square(band)
        energy, fourth = _window(square, radius), _window(square**2, radius)
        noise = bias + gain * (variance if radius == RADII[0] else _window(variance, radius))
        number = (2 * radius + 1) ** 2 * energy**2 / jnp.where(fourth > 0, fourth, 1.0)
        excess = jnp.minimum(doubt / jnp.sqrt(jnp.maximum(number, 1.0)), MOST_DOUBT)
        weights.append(jnp.clip(1 - (1 + excess) * noise / jnp.where(energy > 0, energy, 1.0), 0.0, 1.0))
    weights[-1] = weights[-1] * _falling(jnp.sqrt(variance), *MUCH)
    return weights


def _clean(curved: jax.Array, surface: jax.Array | None) -> jax.Array:
    """How far pixels are among blocks without noise, [H, W, 1] in [0, 1]: by their share of the blocks with surfaces.

    Between blocks it is interpolated, before it is decided.
    """
    quiet = _falling(jnp.sqrt(jnp.min(_mean_blocks(curved), axis=-1, keepdims=True)), *CLEAN)
    known = jnp.ones_like(quiet)
    if surface is not None:
        known = (_mean_blocks(surface.astype(curved.dtype)) > 0.5).astype(curved.dtype)
    number = _window(known, AROUND)
    share = _window(quiet * known, AROUND) / jnp.where(number > 0, number, 1.0)
    return 1 - _falling(_enlarge(share, curved.shape[:2]), *MANY)


def _enlarge(blocks: jax.Array, size: tuple[int, ...]) -> jax.Array:
    """[H, W, 1] blocks of :data:`BLOCK` pixels a side, interpolated."""
    rows, columns = blocks.shape[:2]
    height, width = size
    return jax.image.resize(blocks, (rows * BLOCK, columns * BLOCK, 1), "linear")[:height, :width]


def _mean_blocks(image: jax.Array) -> jax.Array:
    """[h, w, C] the means of blocks of [H, W, C]; at the end of the frame the last pixels are repeated."""
    height, width, channels = image.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    widths = ((0, rows * BLOCK - height), (0, columns * BLOCK - width), (0, 0))
    return jnp.mean(jnp.pad(image, widths, mode="edge").reshape(rows, BLOCK, columns, BLOCK, channels), axis=(1, 3))


def _window(image: jax.Array, radius: int) -> jax.Array:
    """Means over windows of 2 radius + 1 pixels a side, of what of them is in the image [H, W, C]."""
    ones = jnp.ones((*image.shape[:2], 1), image.dtype)
    planes = jnp.concatenate([image, ones], axis=-1)
    planes = jnp.pad(planes, ((radius, radius), (radius, radius), (0, 0)))
    for axis in (-3, -2):
        planes = correlate(planes, np.ones((2 * radius + 1, 1)), axis=axis)
    return planes[..., :-1] / planes[..., -1:]


def _mean_square(image: jax.Array) -> jax.Array:
    """[H, W, 1] over the colours."""
    return jnp.mean(image**2, axis=-1, keepdims=True)


def _visibility(light: jax.Array, level: jax.Array | float) -> jax.Array:
    """The squared slope of x / (1 + x) over log x, where x is the light with the level at middle grey."""
    x = 0.18 * light / jnp.where(jnp.asarray(level) > 0, level, 1.0)
    return (x / (1 + x) ** 2) ** 2


def _falling(x: jax.Array, low: float, high: float) -> jax.Array:
    """1 up to ``low``, 0 from ``high`` on, smooth between them."""
    part = jnp.clip((high - x) / (high - low), 0.0, 1.0)
    return part * part * (3 - 2 * part)
