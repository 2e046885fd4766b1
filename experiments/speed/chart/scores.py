"""Errors against the reference: the numbers of one point of the chart."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.chart.footage import SCORED, EvaluationClip
from jaxdn import color, metrics
from jaxdn.evaluation.compare import unbiased_scores


class Measure(NamedTuple):
    """One error measure."""

    field: str
    label: str
    better: int
    """1 if higher is better, -1 if lower is."""


# The first is the one to read and the default of the page, unless the clips keep halves: see summary.headline.
MEASURES = (
    Measure("psnr", "PSNR dB", 1),
    Measure("temporal_psnr", "temporal PSNR dB", 1),
    Measure("relative_mse", "relative MSE", -1),
    Measure("mse", "MSE", -1),
    Measure("flip", "FLIP", -1),
    Measure("disoccluded_psnr", "PSNR dB, disoccluded pixels", 1),
    Measure("disoccluded_l1", "L1, disoccluded pixels", -1),
    Measure("unbiased_psnr", "PSNR dB, unbiased", 1),
    Measure("unbiased_temporal_psnr", "temporal PSNR dB, unbiased", 1),
    Measure("unbiased_mse", "MSE, unbiased", -1),
    Measure("unbiased_relative_mse", "relative MSE, unbiased", -1),
)


@jax.jit
def _scores(
    images: jax.Array, reference: jax.Array, hidden: jax.Array, halves: tuple[jax.Array, jax.Array] | None
) -> dict[str, jax.Array]:
    shown, wanted = color.tonemap(images), color.tonemap(reference)
    found = {
        "psnr": metrics.psnr(shown, wanted),
        "temporal_psnr": metrics.temporal_psnr(shown, wanted),
        "relative_mse": metrics.relative_mse(images, reference),
        "mse": metrics.mse(shown, wanted),
        "flip": metrics.flip(shown, wanted),
        "disoccluded_psnr": metrics.psnr(shown, wanted, mask=hidden, average="mse"),
        "disoccluded_l1": metrics.l1(shown, wanted, mask=hidden),
    }
    return found if halves is None else found | unbiased_scores(images, hidden, halves)


def score(images: np.ndarray, clip: EvaluationClip) -> dict[str, float]:
    """Every measure over the last frames of images [T, H, W, 3], linear; all except relative MSE on sRGB, clipped at 1.

    NaN in disoccluded pixels where the clip has none, and without the noise of the reference where it keeps no half.
    """
    hidden = clip.hidden[-SCORED:]
    halves = None if clip.halves is None else tuple(jnp.asarray(half[-SCORED:]) for half in clip.halves)
    given = (jnp.asarray(each[-SCORED:]) for each in (images, clip.reference, hidden))
    found = _scores(*given, halves)
    nothing = () if hidden.any() else ("disoccluded_psnr", "disoccluded_l1")
    known = {name: float(value) for name, value in found.items() if name not in nothing}
    return {measure.field: known.get(measure.field, float("nan")) for measure in MEASURES}


def picture(image: np.ndarray) -> np.ndarray:
    """A linear image for display: sRGB, clipped at 1."""
    return np.asarray(color.tonemap(jnp.asarray(image)))
