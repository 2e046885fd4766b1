"""One way from noisy frames to images: a column of the chart's tables, a colour and a sign in its plot."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.timing import Call
from experiments.speed.works import steps
from jaxdn.candidates import Candidate
from jaxdn.frame import BUFFERS, Frame, frame_at, only, written_out
from jaxdn.rollout import stream

DENOISED_SPP = (1, 2, 4, 8)
"""Samples a pixel of what is denoised."""

STILL = frozenset({"previous_depth", "visible", *(name for name, each in BUFFERS.items() if each.kind == "vector")})
"""The buffers that a scene in which nothing moves does not have."""

PLAIN = "plain"
"""The variant that the others differ from."""
ALL = "effects all"
"""The variant with every buffer written out: the image is that of the plain form, which differs in its time alone."""

_FEATURES = frozenset({"albedo", "normal", "depth"})

Prepare = Callable[[Frame, frozenset[str]], Frame]
"""(frame, what the denoiser reads) -> the frame that it gets."""


class Way(NamedTuple):
    """One way from noisy frames to images."""

    name: str
    family: str
    """What it is a variant of: one colour in the plot."""
    variant: str
    """How it differs from the plain form: one sign in the plot."""
    guides: str
    """What it needs of the renderer besides light: "none", "features" (albedo, normals, depth), or "motion" too."""
    timed: Callable[[Frame], Call]
    """A call that denoises one frame [H, W, C] once more, for timing."""
    images: Callable[[Frame], np.ndarray] | None
    """Frames [T, H, W, C] -> images [T, H, W, 3]; None where only the time can be measured."""
    group: str
    """Ways of one group are timed interleaved."""
    small: bool = True
    """Whether a small frame is timed too."""


def as_it_is(frame: Frame, reads: frozenset[str]) -> Frame:
    """The buffers that the clip calls for."""
    return frame


def all_written_out(frame: Frame, reads: frozenset[str]) -> Frame:
    """Every buffer that is read, whatever the scene calls for: effects ``all``."""
    return written_out(frame, reads)


def standing_still(frame: Frame, reads: frozenset[str]) -> Frame:
    """The frame of a scene in which nothing moves."""
    return frame._replace(**dict.fromkeys(STILL))


def way(candidate: Candidate, variant: str = PLAIN, *, prepare: Prepare = as_it_is, scored: bool = True) -> Way:
    """The way of a denoiser of this package. Unless ``scored``, its time alone is measured."""
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

    guides = "none" if not denoiser.reads else "features" if denoiser.reads <= _FEATURES else "motion"
    family = candidate.label
    name = family if variant == PLAIN else f"{family}, {variant}"
    return Way(name, family, variant, guides, timed, images if scored else None, family)
