"""The noise of a training element: drawn anew for every crop from what a clip stores.

A clip has at most one image of each sample count in its layers, but may have many single samples (``draws``), of
indirect and of direct light. ``n`` samples a pixel are the mean of ``n`` of them, chosen at random, so that a crop
rarely has the same noise twice. More samples come from the layers, and as many as half of the reference's from its
first half, whose target is then the other half: independent, and nearly clean.
"""

from typing import NamedTuple

import numpy as np

from jaxdn.data.clip.frames import layers_for
from jaxdn.data.errors import ClipError
from jaxdn.data.training.cache import CachedClip, read_array, read_guide, read_layers, read_stored

Window = tuple[slice, ...]
_BEAUTY = ("direct", "emission")


class LightSamples(NamedTuple):
    """Noisy radiance and what it converges to, [T, H, W, 3]; their noise is independent."""

    noisy: np.ndarray
    reference: np.ndarray


def check_samples(clip: CachedClip, spp: int) -> None:
    """Raise ClipError, saying what there is, unless ``spp`` samples a pixel can be had from the clip."""
    if type(spp) is int and (1 <= spp <= clip.draws or spp == clip.half_spp):
        return
    try:
        layers_for(spp, clip.layers, clip.path)
    except ClipError as error:
        half = f", or {clip.half_spp} (half of the reference)" if clip.half_spp else ""
        raise ClipError(
            f"{error} Its single samples give 1 to {clip.draws}{half}." if clip.draws else str(error)
        ) from error


def sample_light(
    clip: CachedClip, window: Window, spp: int, rng: np.random.Generator, *, beauty: bool = False, widen: bool = True
) -> LightSamples:
    """Light of ``spp`` samples a pixel in a window (frames, rows, columns) of a clip.

    Args:
      clip: to read.
      window: the part of it.
      spp: as :func:`check_samples` allows.
      rng: chooses among the single samples.
      beauty: all light instead of the denoised part, if the clip has that many single samples, whose direct light is
        noisy too, or if its pixels were filtered, so that each image has its own direct and emitted light.
      widen: in single precision; else in that of the files where nothing is computed.
    """
    if spp <= clip.draws:
        chosen = np.sort(rng.permutation(clip.draws)[:spp])
        samples = read_array(clip, "draws", (window[0], chosen, *window[1:])).astype(np.float32).mean(axis=1)
        reference = (read_array if widen or beauty else read_stored)(clip, "reference", window)
        if not beauty or samples.shape[-1] == 3:  # a packed set may have indirect light alone
            return LightSamples(samples[..., :3], reference)
        direct, emission = (read_array(clip, name, window) if name in clip.arrays else 0.0 for name in _BEAUTY)
        return LightSamples(samples[..., :3] + samples[..., 3:] + emission, reference + direct + emission)
    light = _sample_stored(clip, window, spp, widen=widen or beauty)
    if beauty and clip.filtered:
        for name in set(_BEAUTY) & clip.arrays:
            clean = read_array(clip, f"reference_{name}", window)
            light = LightSamples(light.noisy + read_guide(clip, name, window, spp), light.reference + clean)
    return light


def _sample_stored(clip: CachedClip, window: Window, spp: int, *, widen: bool) -> LightSamples:
    """Light of layers, or of the halves of the reference."""
    if spp == clip.half_spp:
        half, both = (read_array(clip, name, window) for name in ("reference_half", "reference"))
        shares = np.float32(spp), np.float32(clip.reference_spp)
        other = (both * shares[1] - half * shares[0]) / (shares[1] - shares[0])
        return LightSamples(half, np.maximum(other, 0.0, dtype=np.float32))
    reference = (read_array if widen else read_stored)(clip, "reference", window)
    return LightSamples(read_layers(clip, window, spp, widen=widen), reference)
