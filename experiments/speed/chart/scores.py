"""Errors against the reference: the numbers of one point of the chart."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.chart.footage import SCORED, Footage
from jaxdn import color, metrics


class Measure(NamedTuple):
    """One error measure."""

    field: str
    label: str
    better: int
    """1 if higher is better, -1 if lower is."""


MEASURES = (
    Measure("psnr", "PSNR dB", 1),
    Measure("temporal_psnr", "temporal PSNR dB", 1),
    Measure("relative_mse", "relative MSE", -1),
    Measure("flip", "FLIP", -1),
    Measure("disoccluded_psnr", "PSNR dB, disoccluded pixels", 1),
    Measure("disoccluded_l1", "L1, disoccluded pixels", -1),
)


@jax.jit
def _scores(images: jax.Array, reference: jax.Array, hidden: jax.Array) -> dict[str, jax.Array]:
    shown, wanted = color.tonemap(images), color.tonemap(reference)
    return {
        "psnr": metrics.psnr(shown, wanted),
        "temporal_psnr": metrics.temporal_psnr(shown, wanted),
        "relative_mse": metrics.relative_mse(images, reference),
        "flip": metrics.flip(shown, wanted),
        "disoccluded_psnr": metrics.psnr(shown, wanted, mask=hidden, average="mse"),
        "disoccluded_l1": metrics.l1(shown, wanted, mask=hidden),
    }


def score(images: np.ndarray, clip: Footage) -> dict[str, float]:
    """Every measure over the last frames of images [T, H, W, 3], linear; all except relative MSE on sRGB, clipped at 1.

    NaN in disoccluded pixels where the clip has none.
    """
    hidden = clip.hidden[-SCORED:]
    found = _scores(jnp.asarray(images[-SCORED:]), jnp.asarray(clip.reference[-SCORED:]), jnp.asarray(hidden))
    nothing = () if hidden.any() else ("disoccluded_psnr", "disoccluded_l1")
    return {name: float("nan") if name in nothing else float(value) for name, value in found.items()}


def picture(image: np.ndarray) -> np.ndarray:
    """A linear image for display: sRGB, clipped at 1."""
    return np.asarray(color.tonemap(jnp.asarray(image)))
