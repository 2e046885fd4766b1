"""Validation while a network is trained: the error on clips that it is not trained on."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color, metrics
from jaxdn.core.frame import Clip
from jaxdn.data.clip.noise_floor import second_half
from jaxdn.data.training.cache import CachedClip, read_array, read_window
from jaxdn.data.training.open_clips import open_clips
from jaxdn.denoiser import Denoiser, Params
from jaxdn.denoiser.rollout import denoise

LEAST_ERROR = 1e-6
"""Estimates of the mean squared error below it count as it (60 dB): where it is small they may be negative."""


class ValidationClip(NamedTuple):
    """A clip to validate on."""

    clip: Clip
    halves: tuple[jax.Array, jax.Array] | None
    """Two independent references [T, H, W, 3] of half the samples each, linear; None where the clip keeps none."""


def load_validation(denoiser: Denoiser, places: Sequence[Path], *, spp: int = 1) -> list[ValidationClip]:
    """Clips of folders, and windows of packed sets, each read whole; opened as those to train on."""
    return [_load(clip, denoiser, spp) for place in places for clip in open_clips(place)]


def _load(cached: CachedClip, denoiser: Denoiser, spp: int) -> ValidationClip:
    everything = (slice(None),) * 3
    clip = read_window(cached, everything, spp=spp, buffers=denoiser.reads, layers=denoiser.samples is not None)
    if "reference_half" not in cached.arrays:
        return ValidationClip(clip, None)
    first = read_array(cached, "reference_half", everything)
    return ValidationClip(clip, (jnp.asarray(first), jnp.asarray(second_half(np.asarray(clip.reference), first))))


def make_validation(denoiser: Denoiser, clips: Sequence[ValidationClip]) -> Callable[[Params], float]:
    """A function of the parameters: the mean over the clips of the PSNR of all their frames, tone-mapped, in dB.

    Free of the references' noise where clips keep halves of them (:func:`jaxdn.metrics.unbiased_mse`): references for
    training are noisy, and a network that gets better all the time would seem to stand still at their noise. Compiled
    once for clips of one size. NaN without clips.
    """

    @jax.jit
    def error(params: Params, one: ValidationClip) -> jax.Array:
        image = color.tonemap(denoise(denoiser, params, one.clip))
        if one.halves is None:
            return metrics.mse(image, color.tonemap(one.clip.reference))
        return metrics.unbiased_mse(image, *color.tonemap_halves(*one.halves))

    def score(params: Params) -> float:
        errors = [max(float(error(params, clip)), LEAST_ERROR) for clip in clips]
        return float(np.mean(-10.0 * np.log10(errors))) if errors else float("nan")

    return score
