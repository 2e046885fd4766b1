"""The images of all methods on the test clips, and what the tables say of them."""

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.papers import results
from experiments.papers.learned.stages import BUDGET, Clips, objective_of
from jaxdn.core.frame import Frame
from jaxdn.denoiser.rollout import unroll
from jaxdn.evaluation.compare import EvaluationClip, read_evaluation_clip
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores
from jaxdn.zoo.ready import find_model

CHANCE = 0.1
"""Decibels by which two trainings of the same network differ."""
NOT_STATED = "not stated"
"""What a paper says where it has no such figure."""


class Claim(NamedTuple):
    """What a paper says, beside what was measured here."""

    text: str
    paper: str
    ours: str
    holds: bool | None = None
    """None where the paper states nothing, and where what was found may be chance."""

    @property
    def verdict(self) -> str:
        """Whether it holds, in words; nothing where the paper states nothing."""
        if self.holds is None:
            return "" if self.paper == NOT_STATED else "chance"
        return "holds" if self.holds else "not here"


class Table(NamedTuple):
    """One table of a paper."""

    title: str
    rows: tuple[str, ...]
    """Stages of training, filters and shipped weights, in the order of the table."""
    text: Callable[[Results], str]
    """The results of all rows -> the table as Markdown."""
    claims: Callable[[Results], list[Claim]]
    spp: int = BUDGET
    """Samples a pixel of what the methods are given."""
    budgets: bool = False
    """Whether the methods differ by their samples a pixel."""
    clips: Clips = "families"
    """What the methods are tested on."""
    figures: Callable[[Results], list[dict[str, str | float]]] | None = None
    """The rows of the page of results, column -> value; None: the scores of all methods."""

    @property
    def heading(self) -> str:
        """The title, with the samples a pixel where all methods have the same."""
        return self.title if self.budgets else f"{self.title}, {self.spp} sample{'s' * (self.spp > 1)} a pixel"


def read(folder: Path, *, spp: int, layers: bool = False) -> EvaluationClip:
    """A test clip whose relative MSE is relative to the image that :func:`near` makes of all stored samples.

    The references have 128 samples, whose noise is 15 to 27 % of the light and has heavy tails: relative to them, the
    errors of all methods would be that noise's.
    """
    footage = read_evaluation_clip(folder, spp=spp, layers=True)
    stored = footage.clip.layers
    if not stored:
        raise ValueError(f"{folder}: expected layers of samples; render the clip with --layers.")
    mean = sum(n * layer for n, layer in stored.items()) / sum(stored)
    frames = footage.clip.frames._replace(radiance=jnp.asarray(mean), sample_count=None)
    clip = footage.clip if layers else footage.clip._replace(layers=None)
    return footage._replace(clip=clip, relative_to=near()(jax.tree.map(jnp.asarray, frames)))


NEAR = "steady-balanced"
"""A shipped network; no row shares it but its own in table 2 of Zeng et al."""


@cache
def near() -> Callable[[Frame], jax.Array]:
    """Frames [T, ...] -> images near the truth, by :data:`NEAR`."""
    one = find_model(NEAR)
    assert one.denoiser is not None
    denoiser = one.denoiser
    return jax.jit(lambda frames: unroll(denoiser, one.params, frames))


def rows_of(found: Results, labels: Iterable[str]) -> Results:
    """The results of some methods only."""
    return found._replace(methods=list(labels))


def ordinary(found: Results, labels: Iterable[str]) -> str:
    """PSNR, temporal PSNR and others with what each is trained by, in the mean over the clips, as Markdown."""
    some = rows_of(found, labels)
    means = mean_scores(some)
    columns = {
        "relative MSE": {label: f"{one.unbiased_relative_mse:.4f}" for label, one in means.items()},
        "MSE": {label: f"{one.unbiased_mse:.5f}" for label, one in means.items()},
        "SSIM": {label: f"{one.ssim:.4f}" for label, one in means.items()},
        "trained by": {label: objective_of(label) for label in means},
    }
    return results.table(some, columns)


def over_frames(found: Results, labels: Iterable[str]) -> str:
    """PSNR of each frame in the mean over the clips, as Markdown; with the references' noise in it."""
    curves = {label: np.mean([clip.per_frame[label]["psnr"] for clip in found.clips], axis=0) for label in labels}
    numbers = range(1, 1 + len(next(iter(curves.values()))))
    lines = ["| PSNR of frame | " + " | ".join(map(str, numbers)) + " |", "|---" * (len(numbers) + 1) + "|"]
    lines += [f"| {label} | " + " | ".join(f"{value:.2f}" for value in curve) + " |" for label, curve in curves.items()]
    return "\n".join(lines)


def error_ratio(found: Results, first: str, second: str) -> float:
    """Of the mean relative MSE of two methods."""
    means = mean_scores(found)
    return means[first].unbiased_relative_mse / means[second].unbiased_relative_mse


def psnr_gain(found: Results, first: str, second: str) -> float:
    """Mean decibels of the first above the second."""
    means = mean_scores(found)
    return means[first].unbiased_psnr - means[second].unbiased_psnr


def is_gain(decibels: float) -> bool | None:
    """Whether it is one; None for what may be chance."""
    return None if abs(decibels) < CHANCE else decibels > 0


def claims_table(claims: Iterable[Claim]) -> str:
    """As Markdown."""
    lines = ["| the paper's claim | there | here | |", "|---|---|---|---|"]
    lines += [f"| {one.text} | {one.paper} | {one.ours} | {one.verdict} |" for one in claims]
    return "\n".join(lines)
