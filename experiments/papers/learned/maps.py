"""Where denoisers that ask for samples put them: pictures, and the rank correlation with the noise."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments.papers.learned.stages import BUDGET
from experiments.papers.preintegration import file_name
from jaxdn import color
from jaxdn.clips import read_clip
from jaxdn.core.frame import Clip, frame_at, only
from jaxdn.denoiser.rollout import render_requested
from jaxdn.evaluation.report.images import save_png
from jaxdn.zoo.ready import Model


def asks(one: Model) -> bool:
    """Whether a method says where its samples go, unless it has been told to put as many everywhere."""
    uniform = one.options.get("adaptive") is False
    return one.denoiser is not None and one.denoiser.samples is not None and not uniform


def counts_of(one: Model, clip: Clip) -> jax.Array:
    """[T, H, W, 1] the numbers of samples that each frame is given."""
    denoiser, params = one.denoiser, one.params
    assert denoiser is not None

    def step(state: Any, given: Any) -> tuple[Any, jax.Array]:
        frame = render_requested(denoiser, params, state, *given)
        return denoiser.step(params, state, frame)[0], frame.sample_count

    frames = only(clip.frames, denoiser.reads)
    return lax.scan(step, denoiser.start(params, frame_at(frames, 0)), (frames, clip.layers))[1]


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Of the ranks of two images (Spearman); equal values have the mean of their ranks. NaN where one is constant."""
    first, second = (each - each.mean() for each in (_ranks(first), _ranks(second)))
    with np.errstate(invalid="ignore"):
        return float((first * second).sum() / np.sqrt((first**2).sum() * (second**2).sum()))


def _ranks(values: np.ndarray) -> np.ndarray:
    """1 for the smallest value of all; equal values have the mean of their ranks."""
    _, place, count = np.unique(values.ravel(), return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[place]


def save_maps(asking: list[Model], folders: list[Path], out: Path) -> str:
    """The map of the last frame of each clip as a picture, and its rank correlation with the noise, as Markdown.

    The noise is that of compressed radiance (:func:`variance_of`); it is saved as a picture too.
    """
    lines = ["| clip | " + " | ".join(one.label for one in asking) + " |", "|---" * (len(asking) + 1) + "|"]
    requests = [jax.jit(partial(counts_of, one)) for one in asking]
    for folder in folders:
        clip = jax.tree.map(jnp.asarray, read_clip(folder, layers=True))
        noise = variance_of(clip)
        save_png(out / folder.name / "noise.png", np.sqrt(noise / noise.max()))
        cells = []
        for one, request in zip(asking, requests, strict=True):
            counts = np.asarray(request(clip))[-1, ..., 0]
            save_png(out / folder.name / f"{file_name(one.label)}-samples.png", np.sqrt(counts / counts.max()))
            few, many = counts.min(), counts.max()
            cells.append("even" if few == many else f"{correlation(counts, noise):.2f}, {few:.0f} to {many:.0f}")
        lines.append(f"| {folder.name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def variance_of(clip: Clip) -> np.ndarray:
    """[H, W] the noise of the last frame at 4 samples and more, as the losses see it, in the mean over 5 x 5 pixels.

    The variance of compressed radiance, of the layers of at least 4 samples: of fewer, the curve hides most of it.
    """
    wanted, layers = color.compress(clip.reference[-1]), clip.layers or {}
    noisy = {n: color.compress(layer[-1]) for n, layer in layers.items() if n >= BUDGET}
    errors = [n * np.square(np.asarray(layer - wanted)).mean(-1) for n, layer in noisy.items()]
    return windowed(np.mean(errors, axis=0), 2)


def windowed(image: np.ndarray, radius: int) -> np.ndarray:
    """[H, W] the mean over squares of ``2 radius + 1`` pixels, whose edges are repeated."""
    padded = np.pad(image, radius, mode="edge")
    side = 2 * radius + 1
    return np.lib.stride_tricks.sliding_window_view(padded, (side, side)).mean((-1, -2))
