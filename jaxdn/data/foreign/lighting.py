"""Which layers are light: is one called ``diffuse`` an albedo or a lighting pass, and which are parts of the beauty.

V-Ray for Maya calls its albedo ``diffuse``, others a lighting pass.

A lighting pass in place of the albedo would be divided out of the beauty, noise and all, and multiplied back after the
filter: the image would stay as noisy as it was.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from jaxdn.data.foreign.layers import LAYERS, Channels, group_layers, plain, stack_channels

SLACK = 0.1
"""By so much fractions may leave [0, 1]: pixel filters with negative lobes overshoot at edges."""
_PART = 0.999
"""Share of pixels where a part of the beauty is not brighter than it; the rest may be clamped in one of them alone."""
_CLEARLY = 0.1
"""Share of pixels that are brighter than the beauty in what is surely no part of it."""
_NOISE = 0.25
"""Median deviation of a pixel from its four neighbours, relative to them, that no texture has over half of an image.

Of exponential noise (one sample) it is 0.6, of a mean of 16 samples 0.19; wood, stone and cloth have 0.02 to 0.15."""


_NO_LIGHT = ("variance", "_var", "mse", "crypto", "noisy image", "denoised")
"""Words in the names of layers that may pass for a part of the beauty by their values."""


def explain_light(values: np.ndarray, beauty: np.ndarray) -> str | None:
    """Why a layer [H, W, 3] is light and not an albedo, in words; None where nothing says so.

    Three things tell light: values above 1, noise, and that it is nowhere brighter than the beauty, as only a part of
    the beauty can be (an albedo is brighter than the radiance of every surface in shadow).
    """
    values = np.nan_to_num(np.asarray(values, np.float64), posinf=np.inf)
    if values.size and values.max() > 1 + SLACK:
        return f"it has values up to {values.max():.3g}, and an albedo is at most 1"
    noise = _noise(values)
    if noise > _NOISE:
        return f"it is noisy: pixels differ by {noise:.0%} from their neighbours"
    if _is_part(values, beauty):
        return "it is nowhere brighter than the beauty, as a part of it is"
    return None


def is_clearly_brighter(values: np.ndarray, beauty: np.ndarray) -> bool:
    """Whether many pixels of a layer [H, W, 3] are brighter than the beauty, so that it is surely no part of it."""
    lit = np.any(values > 0, axis=-1)
    return bool(lit.any() and np.mean(np.any(values > 1.1 * beauty + 1e-3 * _level(beauty), axis=-1)[lit]) > _CLEARLY)


def coloured_layers(names: Iterable[str], beauty: Channels, buffers: Mapping[str, Channels]) -> dict[str, Channels]:
    """Layer -> channels of what may be an additive part of the beauty, by names alone.

    Left out are layers that are read as something else, whose names are those of guides, or that hold variances, and
    ``Noisy Image``, which is to stay as it is.

    Args:
      names: of every channel of the file.
      beauty: the channels of the beauty, which is no part of itself.
      buffers: buffer -> channels that are read.
    """
    known = {plain(name) for buffer, layers in LAYERS.items() if buffer != "radiance" for name in layers} - {"diffuse"}
    read = {channel for channels in buffers.values() for channel in channels} | set(beauty)
    found: dict[str, Channels] = {}
    for layer, group in group_layers(list(names)).items():
        last = layer.rpartition(".")[2].lower()
        channels = tuple(group[letter] for letter in "rgb" if letter in group)
        if len(channels) == 3 and not (
            read & set(channels) or plain(last) in known or any(word in last for word in _NO_LIGHT)
        ):
            found[layer] = channels
    return found


def is_additive(pixels: Mapping[str, np.ndarray], channels: Channels, beauty: np.ndarray) -> bool | None:
    """Whether a layer is a part of the beauty [H, W, 3], by its values; None: it is black, which tells nothing."""
    values = stack_channels(pixels, channels)
    if not np.any((values != 0) & ~np.isnan(values)):
        return None
    # A pixel filter with negative lobes rings at edges; normals and vectors are as often below 0 as above.
    numbers = np.nan_to_num(np.asarray(values, np.float64), posinf=0, neginf=0)
    rings = np.sum(np.minimum(numbers, 0)) >= -SLACK * np.sum(np.maximum(numbers, 0))
    return bool(rings) and _is_part(values, beauty)


def find_beauty_copies(
    pixels: Mapping[str, np.ndarray], beauty: Channels, layers: Mapping[str, Channels]
) -> frozenset[str]:
    """Those of the layers that are the beauty once more, within half precision: the compositor's, a viewer's."""
    radiance = stack_channels(pixels, beauty).astype(np.float64)

    def same(channels: Channels) -> bool:
        values = stack_channels(pixels, channels)
        return bool(np.mean(np.abs(values - radiance) <= 2e-3 * np.abs(radiance)) >= _PART)

    return frozenset(layer for layer, channels in layers.items() if same(channels))


def _is_part(values: np.ndarray, beauty: np.ndarray) -> bool:
    """Whether values [H, W, 3] are nowhere brighter than the beauty, and anywhere above 0."""
    lit = np.any(values > 0, axis=-1)
    part = np.all(values <= 1.002 * np.asarray(beauty, np.float64) + 1e-4 * _level(beauty), axis=-1)[lit]
    return bool(part.size and part.mean() >= _PART)


def _level(beauty: np.ndarray) -> float:
    """Median of the finite values above 0, which a few lamps do not change; 0 if there are none."""
    lit = beauty[(beauty > 0) & np.isfinite(beauty)]
    return float(np.median(lit)) if lit.size else 0.0


def _noise(values: np.ndarray) -> float:
    """Median over the lit pixels of |luminance - mean of the four neighbours| / that mean."""
    light = values.mean(axis=-1)
    if min(light.shape) < 3:
        return 0.0
    around = (light[:-2, 1:-1] + light[2:, 1:-1] + light[1:-1, :-2] + light[1:-1, 2:]) / 4
    lit = around > 1e-2 * np.mean(np.maximum(around, 0))
    return float(np.median(np.abs(light[1:-1, 1:-1] - around)[lit] / around[lit])) if lit.any() else 0.0
