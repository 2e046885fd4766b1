"""Validation while a network is trained: the error on clips that it is not trained on."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color, metrics
from jaxdn.core.frame import Clip
from jaxdn.data.clip.folder import find_clips
from jaxdn.data.clip.noise_floor import other_half, read_halves
from jaxdn.data.read import read_clip
from jaxdn.data.training.cache import read_array, read_window
from jaxdn.data.training.pack import open_pack
from jaxdn.denoiser import Denoiser, Params
from jaxdn.denoiser.rollout import denoise

LEAST_ERROR = 1e-6
"""Estimates of the mean squared error below it count as it (60 dB): where it is small they may be negative."""


class HeldOut(NamedTuple):
    """A clip to validate on."""

    clip: Clip
    halves: tuple[jax.Array, jax.Array] | None
    """Two independent references [T, H, W, 3] of half the samples each, linear; None where the clip keeps none."""


def load_validation(denoiser: Denoiser, places: Sequence[Path], *, spp: int = 1) -> list[HeldOut]:
    """Held-out clips of folders, and windows of packed sets, each read whole."""
    layers, everything = denoiser.samples is not None, (slice(None),) * 3
    found: list[HeldOut] = []
    for place in places:
        if not place.is_file():
            for folder in find_clips(place):
                found.append(_held_out(read_clip(folder, spp=spp, layers=layers), read_halves(folder)))
            continue
        for window in open_pack(place):
            clip = read_window(window, everything, spp=spp, buffers=denoiser.reads, layers=layers)
            halves = None
            if "reference_half" in window.arrays:
                first = read_array(window, "reference_half", everything)
                halves = first, other_half(np.asarray(clip.reference), first)
            found.append(_held_out(clip, halves))
    return found


def _held_out(clip: Clip, halves: tuple[np.ndarray, np.ndarray] | None) -> HeldOut:
    return HeldOut(clip, None if halves is None else (jnp.asarray(halves[0]), jnp.asarray(halves[1])))


def make_validation(denoiser: Denoiser, held_out: Sequence[HeldOut]) -> Callable[[Params], float]:
    """A function of the parameters: the mean over the clips of the PSNR of all their frames, tone-mapped, in dB.

    Free of the references' noise where clips keep halves of them (:func:`jaxdn.metrics.unbiased_mse`): references for
    training are noisy, and a network that gets better all the time would seem to stand still at their noise. Compiled
    once for clips of one size. NaN without clips.
    """

    @jax.jit
    def error(params: Params, held: HeldOut) -> jax.Array:
        image = color.tonemap(denoise(denoiser, params, held.clip))
        if held.halves is None:
            return metrics.mse(image, color.tonemap(held.clip.reference))
        return metrics.unbiased_mse(image, *color.tonemap_halves(*held.halves))

    def score(params: Params) -> float:
        errors = [max(float(error(params, held)), LEAST_ERROR) for held in held_out]
        return float(np.mean(-10.0 * np.log10(errors))) if errors else float("nan")

    return score
