"""One method of the chart, from noisy frames to images: a row of its tables, a colour and a marker in its plot."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.chart.render_cost import FRACTIONS, named
from experiments.speed.timing import Call
from experiments.speed.works import steps
from jaxdn.core.frame import BUFFERS, Frame, frame_at, only, written_out
from jaxdn.denoiser.rollout import stream
from jaxdn.zoo.ready import Model

DENOISED_SPP = (1, 2, 4, 8)
"""Samples per pixel of the denoised images."""

STILL = frozenset({"previous_depth", "visible", *(name for name, each in BUFFERS.items() if each.kind == "vector")})
"""The buffers that a static scene does not have."""

PLAIN = "plain"
"""The variant that the others differ from."""
ALL = "effects all"
"""The variant with every buffer explicit: the image is that of the plain form, only the time differs."""

Prepare = Callable[[Frame, frozenset[str]], Frame]
"""(frame, the buffers that the denoiser reads) -> the frame that it gets."""


class Way(NamedTuple):
    """One method that makes images from noisy frames."""

    name: str
    family: str
    """The method that it is a variant of: one colour in the plot."""
    variant: str
    """How it differs from the plain form: one marker in the plot."""
    reads: str
    """The buffers that it needs of the renderer besides radiance, by the name that
    :func:`experiments.speed.chart.render_cost.named` gives them."""
    timed: Callable[[Frame], Call]
    """A call that denoises one frame [H, W, C], for timing."""
    images: Callable[[Frame], np.ndarray] | None
    """Frames [T, H, W, C] -> images [T, H, W, 3]; None if only the time can be measured."""
    group: str
    """Methods of one group are timed interleaved."""
    samples: tuple[float, ...] = DENOISED_SPP
    """Samples per pixel of its points, ascending; below 1 of methods that take frames with gaps."""


def as_it_is(frame: Frame, reads: frozenset[str]) -> Frame:
    """The buffers of the clip."""
    return frame


def all_written_out(frame: Frame, reads: frozenset[str]) -> Frame:
    """Every buffer that is read, whichever effects the scene has: effects ``all``."""
    return written_out(frame, reads)


def standing_still(frame: Frame, reads: frozenset[str]) -> Frame:
    """The frame of a static scene."""
    return frame._replace(**dict.fromkeys(STILL))


def way(candidate: Model, variant: str = PLAIN, *, prepare: Prepare = as_it_is, scored: bool = True) -> Way:
    """The chart's entry for a denoiser of this package. Unless ``scored``, only its time is measured."""
    denoiser, params = candidate.denoiser, candidate.params
    if denoiser is None:
        raise ValueError(f"{candidate.label}: expected a denoiser, got the noisy image itself.")

    def select(frame: Frame) -> Frame:
        return jax.tree.map(jnp.asarray, prepare(only(frame, denoiser.reads), denoiser.reads))

    def timed(frame: Frame) -> Call:
        return steps.recurrent(denoiser, params, select(frame))

    def images(frames: Frame) -> np.ndarray:
        frames = select(frames)
        single = (frame_at(frames, index) for index in range(frames.radiance.shape[0]))
        return np.stack([np.asarray(image) for image in stream(denoiser, params).each(single)])

    family = candidate.label
    name = family if variant == PLAIN else f"{family}, {variant}"
    sparse = candidate.method is not None and candidate.method.sparse
    samples = (*FRACTIONS, *DENOISED_SPP) if sparse and variant != ALL else DENOISED_SPP
    return Way(name, family, variant, named(denoiser.reads), timed, images if scored else None, family, samples)
