"""How good a clip's reference is: it is rendered too, and has noise of its own."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.data.clip.folder import read_frames, read_record


def noise_floor(reference: np.ndarray, reference_half: np.ndarray) -> float:
    """Mean squared error of a tone-mapped reference [H, W, 3] itself, from the mean of one half of its samples.

    With the halves ``a`` and ``b = 2 * reference - a``, which are independent, the reference ``(a + b) / 2`` has a
    quarter of the variance of ``a - b``; so its error is about ``mean((tonemap(a) - tonemap(b))^2) / 4``.
    """
    halves = reference_half, second_half(reference, reference_half)
    first, second = (np.asarray(color.tonemap(jnp.asarray(half))) for half in halves)
    return float(np.mean((first.astype(np.float64) - second) ** 2) / 4.0)


def second_half(reference: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The mean of the other half of a reference's samples: ``2 reference - first``.

    It is 0 where rounding to half precision has made that negative.
    """
    return np.maximum(2.0 * reference - first, 0.0)


def read_halves(folder: str | Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Two independent references [T, H, W, 3] of a clip, of half the samples each; None where it does not keep one.

    A clip keeps its reference and the mean of the first half of its samples.
    """
    first, second = [], []
    for stored in read_frames(folder, spp=read_record(folder)["layers"][0]):
        if stored.reference is None or stored.reference_half is None:
            return None
        first.append(stored.reference_half)
        second.append(second_half(stored.reference, stored.reference_half))
    return (np.stack(first), np.stack(second)) if first else None


def read_noise_floor(folder: str | Path) -> float:
    """The PSNR in dB that a perfect image would get against this clip's reference, averaged over frames.

    Not a number where the clip has no reference or does not keep its first half.
    """
    decibels = []
    for stored in read_frames(folder, spp=read_record(folder)["layers"][0]):
        if stored.reference is None or stored.reference_half is None:
            return float("nan")
        with np.errstate(divide="ignore"):
            decibels.append(-10.0 * np.log10(noise_floor(stored.reference, stored.reference_half)))
    return float(np.mean(decibels)) if decibels else float("nan")
