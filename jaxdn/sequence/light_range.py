"""Light of any unit and range, brought to where denoisers work, and what they cannot take set aside and added again.

Denoisers are made for light of about :data:`LEVEL`: they clamp at ``RADIANCE_MAX``, have no negative light, and some
add small constants. Files have any unit (candela, night scenes), suns, and colours outside of Rec.709, whose components
are negative. And a filter that gives a thousandth of a lamp's light to the wall beside it makes the wall white. So a
frame ``x`` is split with an exact power of two, ``g = 2^e``, into four parts:

    x = bounded / g + lamps + excess + negative,    0 <= bounded <= RADIANCE_MAX.

``bounded`` alone is denoised. The image is ``denoised / g`` with the three others:

* lamps: what is bright and has no noise, because three pixels around are as bright to a thousandth, and the edge of one
  pixel around such a group. The denoiser sees at most :data:`BRIGHTEST` of it, and it comes back as it was. What the
  denoiser gave of it to the pixels beside it is taken back (:func:`_bound_ring`);
* the excess over the limit elsewhere, as far as three pixels of the 3x3 around have as much of it. A firefly is one
  pixel, and is not given back;
* the negative part ``n``, which is as noisy as the light. Its share of the light hardly is, as one factor of noise is
  in both: over 3x3 pixels, ``sum(n) / sum(bounded) * denoised``, the ratio estimator of sampling theory (Cochran,
  "Sampling Techniques", 1977, ch. 6).

``g`` comes from the median of the light in blocks, which no lamp moves. It is one number as long as the light stays
within :data:`DRIFT` octaves of it, because histories are sums of light in that unit.
"""

import math

import numpy as np

from jaxdn.color import LUMINANCE
from jaxdn.core.frame import BUFFERS, GUIDES, RADIANCE_MAX
from jaxdn.data.clip.frames import StoredFrame

LEVEL = 0.18
"""Median light that frames are brought to: middle grey."""
DRIFT = 8
"""Octaves by which a frame's median may differ from :data:`LEVEL` before another factor is chosen."""
_BLOCK = 8
"""Side of the blocks, in pixels, whose means are compared: of few samples most pixels are much darker than the mean."""
_STRIP = 4 * _BLOCK
"""Rows whose blocks are summed at once."""
_GROUP = 3
"""Pixels of a 3x3 window that must be as bright for light beyond the limit to be a lamp's."""
LAMP = 8 * LEVEL
"""Luminance, at the usual level, from which on light without noise is a lamp's."""
BRIGHTEST = 256 * LEVEL
"""Luminance, at the usual level, of the brightest lamp that denoisers see. What a lamp lights up is found by its
brightness, too: in three clips with lamps, at 1 and 4 samples, Open Image Denoise loses up to 2.4 dB at 8 times the
level, 0.4 at 64 times, 0.03 at this one."""
_ALIKE = 0.001
"""Relative difference of luminances up to which two pixels are equally bright: one step of half precision. Of noise of
1 % of the light, 1 % of the pixels have three such neighbours, of 3 %, 0.04 %. A floor beneath a dim sky is as far
above the median as a lamp is elsewhere, so that noise alone tells them apart."""
_RING = 2
"""Pixels on each side among which a neighbour of a lamp that the lamp does not reach is sought."""
_OFFSETS = tuple((dy, dx) for dy in range(3) for dx in range(3))
"""Of the 3x3 pixels around one, in an image that is padded by one pixel."""
_LIGHT = tuple(name for name in GUIDES if BUFFERS[name].kind in ("light", "signed"))


def measure_octaves(radiance: np.ndarray) -> float | None:
    """``log2`` of :data:`LEVEL` over the median mean luminance of lit blocks of radiance [H, W, 3]; None: all is black.

    2 to this power is the factor that brings the frame to the level. Values that are not finite or negative are 0.
    """
    height, width = radiance.shape[:2]
    rows, columns = (np.arange(0, size, _BLOCK) for size in (height, width))
    # Strip by strip, whose numbers stay in the cache.
    strips = (radiance[top : top + _STRIP] for top in range(0, height, _STRIP))
    sums = np.concatenate([_sum_blocks(strip, columns) for strip in strips])
    means = sums / np.outer(np.diff([*rows, height]), np.diff([*columns, width]))
    lit = means[means > 0]
    return float(np.log2(LEVEL) - np.median(np.log2(lit))) if lit.size else None


def _sum_blocks(radiance: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The luminance in blocks that begin at every eighth row and at ``columns``, float64."""
    lit = np.isfinite(radiance) & (radiance > 0)
    light = np.where(lit, radiance, 0).astype(np.float64) @ np.asarray(LUMINANCE)
    in_rows = np.add.reduceat(light, np.arange(0, len(light), _BLOCK), axis=0)
    return np.add.reduceat(in_rows, columns, axis=1)


def choose_exponent(radiance: np.ndarray, before: int | None) -> int | None:
    """The exponent e of the factor for a frame [H, W, 3], given that of the frame before it; None: none was lit yet."""
    octaves = measure_octaves(radiance)
    if octaves is None or (before is not None and abs(octaves - before) <= DRIFT):
        return before
    return round(octaves)


def bound_light(stored: StoredFrame, exponent: int, lamps: np.ndarray) -> StoredFrame:
    """The frame with all its light times 2^exponent, within ``RADIANCE_MAX``; radiance and layers are not negative.

    Lamps have at most the luminance :data:`BRIGHTEST`, in their own colour. What is not finite stays, so that denoisers
    see that it is no measurement. ``lamps``: :func:`find_lamps` of the radiance.
    """
    frame = stored.frame
    most = math.ldexp(RADIANCE_MAX, -exponent)
    noisy, shines = np.asarray(frame.radiance), bool(np.any(lamps))
    if exponent == 0 and not shines and not np.any((noisy < 0) | (noisy > most)):
        return stored

    def scaled(light: np.ndarray, least: float) -> np.ndarray:
        wide = np.asarray(light, np.result_type(light, np.float32))
        bounded, known = np.clip(wide, wide.dtype.type(least), wide.dtype.type(most)), np.isfinite(wide)
        if not known.all():
            bounded = np.where(known, bounded, wide)
        return np.ldexp(bounded, exponent, out=bounded)

    given = {name: scaled(light, -most) for name in _LIGHT if (light := getattr(frame, name)) is not None}
    layers = {count: scaled(layer, 0.0) for count, layer in stored.layers.items()}
    radiance = scaled(_dim(noisy, lamps, exponent) if shines else noisy, 0.0)
    return stored._replace(frame=frame._replace(**given, radiance=radiance), layers=layers)


def restore_light(image: np.ndarray, radiance: np.ndarray, exponent: int, lamps: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] in the unit of the noisy radiance, with what :func:`bound_light` set aside.

    Args:
      image: what was made of the bounded frame.
      radiance: [H, W, 3] as it came.
      exponent: as the frame was bounded with.
      lamps: as the frame was bounded with.
    """
    image = np.ldexp(np.asarray(image, np.float32), -exponent)
    known = np.isfinite(radiance)
    noisy = np.asarray(radiance if known.all() else np.where(known, radiance, 0), np.float32)
    limit = np.float32(math.ldexp(RADIANCE_MAX, -exponent))
    if np.any(noisy < 0):
        image = image + _denoise_negative(np.minimum(noisy, 0), np.clip(noisy, 0, limit), image)
    if np.any(noisy > limit):
        image = image + _keep_groups(np.maximum(noisy - limit, 0))
    return np.where(lamps, noisy, _bound_ring(image, noisy, lamps)) if np.any(lamps) else image


def restore_lamps(image: np.ndarray, radiance: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] with the ``lamps`` of the noisy radiance as they came: they have no noise."""
    return np.where(lamps, radiance, image) if np.any(lamps) else image


def find_lamps(radiance: np.ndarray, exponent: int) -> np.ndarray:
    """[H, W, 1] bool, where a frame [H, W, 3] shows bright light without noise, and one pixel around it."""
    with np.errstate(invalid="ignore", over="ignore"):
        light = np.pad(np.asarray(radiance, np.float32) @ np.asarray(LUMINANCE, np.float32), 1)
        bright = np.isfinite(light) & (light > math.ldexp(LAMP, -exponent))
        # Few pixels are: nothing is compared elsewhere. Places count along all rows, one after the other.
        places, values = np.flatnonzero(bright), light.ravel()
        steps = [(dy - 1) * light.shape[1] + dx - 1 for dy, dx in _OFFSETS]
        own = values[places]
        near = _ALIKE * np.abs(own)
        alike = sum((np.abs(values[places + step] - own) <= near).astype(np.int8) for step in steps)
    group = places[alike > _GROUP]
    around = np.zeros(light.size, bool)
    for step in steps:
        around[group + step] = True
    return (bright & around.reshape(light.shape))[1:-1, 1:-1, None]


def _bound_ring(image: np.ndarray, noisy: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] with the light bounded of pixels that touch lamps [H, W, 1], in their own colour.

    It is at most what is brightest of the 5x5 pixels around that touch no lamp, or the noisy light of pixels that do:
    the pixel's own, or the mean of those in the 5x5 around and twice its standard error. By the pixel's own alone, what
    is taken back would have the noise of one pixel. Between two lamps, without pixels that touch none, the light stays.
    Open Image Denoise gives a twentieth of a lamp to the pixel beside it.
    """
    touched = np.any(_window(lamps), axis=0)[..., 0]
    rows, columns = np.nonzero(touched & ~lamps[..., 0])
    weights = np.asarray(LUMINANCE, np.float32)
    light = image @ weights
    steps = range(2 * _RING + 1)

    def near(values: np.ndarray, outside: float) -> np.ndarray:
        """[25, N] of those around each pixel of the ring."""
        padded = np.pad(values, _RING, constant_values=outside)
        return np.stack([padded[rows + dy, columns + dx] for dy in steps for dx in steps])

    around = near(np.where(touched, -np.inf, light), -np.inf).max(axis=0)
    drawn = np.zeros_like(light)
    drawn[rows, columns] = noisy[rows, columns] @ weights
    number = near(touched & ~lamps[..., 0], False).sum(axis=0)
    mean, square = (near(values, 0.0).sum(axis=0) / number for values in (drawn, drawn**2))
    likely = mean + 2 * np.sqrt(np.maximum(square - mean**2, 0) / number)
    own, most = light[rows, columns], np.max([drawn[rows, columns], likely, around], axis=0)
    over = np.isfinite(around) & (own > most)
    bounded = image.copy()
    bounded[rows[over], columns[over]] *= (most[over] / own[over])[:, None]
    return bounded


def _dim(radiance: np.ndarray, lamps: np.ndarray, exponent: int) -> np.ndarray:
    """The frame with the luminance of lamps brought down to :data:`BRIGHTEST`."""
    most = np.float32(math.ldexp(BRIGHTEST, -exponent))
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is no lamp's
        light = (radiance @ np.asarray(LUMINANCE, np.float32))[..., None]
        return np.where(lamps, radiance * (most / np.maximum(light, most)), radiance)


def _denoise_negative(negative: np.ndarray, positive: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The negative part [H, W, 3] of a frame as free of noise as the image of its positive part.

    Where there is less positive light around than negative, as in the ringing of a pixel filter, it stays: it is no
    share of that light.
    """
    light = _window(np.sum(positive, axis=-1, keepdims=True)).sum(axis=0)
    around = _window(negative).sum(axis=0)
    lit = light > -np.sum(around, axis=-1, keepdims=True)
    share = around / np.where(lit, light, 1)
    return np.where(lit, share * np.sum(image, axis=-1, keepdims=True), negative)


def _keep_groups(excess: np.ndarray) -> np.ndarray:
    """At most the third largest of the 3x3 pixels around, per colour."""
    third = np.partition(_window(excess), -_GROUP, axis=0)[-_GROUP]
    return np.minimum(excess, third)


def _window(image: np.ndarray) -> np.ndarray:
    """[9, H, W, C] the 3x3 pixels around each; around the frame there is nothing."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    return np.stack([padded[dy : dy + height, dx : dx + width] for dy, dx in _OFFSETS])
