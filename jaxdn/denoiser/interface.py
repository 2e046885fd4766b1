"""What a denoiser is, and the processing that all of them share.

:class:`Denoiser` is the one interface that training, evaluation, the planner, the chart and the command line use. A
method is written as a :class:`Core`, which gets only valid frames. :func:`recurrent` turns it into a denoiser and adds
what every method needs: it checks shapes, sanitizes frames and counts sanitized values, keeps the age of the state, and
clamps the image to values from 0 to the largest that a file holds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.core.frame import RADIANCE_MAX, Frame, only
from jaxdn.denoiser.sanitize import sanitize
from jaxdn.denoiser.statistics import FrameStatistics

Params = dict[str, Any]
"""Nested dicts of arrays; ``{}`` for a filter without weights."""
State = Any
"""What is carried from one frame to the next: a flat pytree of few, large arrays."""
Step = Callable[[Params, State, Frame], tuple[State, jax.Array]]
"""(params, state, frame) -> (state, image [H, W, 3] >= 0)."""


class Denoiser(NamedTuple):
    """The interface of every denoiser; a clip is a scan over ``step``. The functions are pure and not jitted."""

    init: Callable[[jax.Array, Frame], Params]
    """(key, frame) -> params."""
    start: Callable[[Params, Frame], State]
    """(params, frame) -> state before the first frame."""
    step: Step
    reads: frozenset[str]
    """Names of the Frame buffers, in addition to ``radiance``, that it can use."""
    samples: Callable[[Params, State, Frame, int], jax.Array] | None = None
    """(params, state, frame, most) -> [H, W, 1] samples per pixel that it requests from the renderer before ``step``
    (rounded to whole numbers); a pixel can have ``most``. Here the frame's radiance is what has been rendered before;
    in ``step`` it is the mean of the requested samples, with ``sample_count``. None: no request, the radiance is used
    as it is."""


class Core(NamedTuple):
    """A method without the shared processing. Frames hold only what it reads, already sanitized."""

    start: Callable[[Params, Frame], State]
    """(params, frame) -> its own state."""
    step: Callable[..., tuple[State, jax.Array, jax.Array | int]]
    """(params, state, frame, first) -> (state, image [H, W, 3], values of the history that had to be replaced).
    ``first`` is a bool scalar: there is no history yet, regardless of state and motion. With ``measure``, its result is
    one argument more."""
    reads: frozenset[str]
    init: Callable[[jax.Array, Frame], Params] = lambda key, frame: {}
    samples: Callable[[Params, State, Frame, jax.Array, int], jax.Array] | None = None
    """(params, state, frame, first, most) -> [H, W, 1]."""
    measure: Callable[[Frame], FrameStatistics] | None = None
    """(frame) -> what ``step`` must know of the whole frame; None: nothing."""
    reach: int | None = None
    """In pixels: what is farther away decides nothing about a pixel, apart from the history, which may come from as
    much farther as vectors are long, and from what is measured. None: not known, and frames cannot be parted."""
    counted: bool = False
    """Its frames always have a ``sample_count``, whether or not it reads one: 0 where the radiance is no measurement,
    because a value was not finite, elsewhere the given one if it reads that, else 1. Without it such pixels look like
    pixels without light."""


class Recurrent(NamedTuple):
    """The state of a denoiser that :func:`recurrent` made."""

    core: State
    """The method's own."""
    age: jax.Array
    """int32, frames processed; at 0 there is no history."""
    sanitized: jax.Array
    """int32, values of frames and histories that had to be replaced so far."""


@dataclasses.dataclass(frozen=True, eq=False)
class RecurrentStep:
    """The ``step`` of a denoiser that :func:`recurrent` made; wrappers such as ``demodulated`` take its ``core``."""

    core: Core

    def __call__(self, params: Params, state: Recurrent, frame: Frame) -> tuple[Recurrent, jax.Array]:
        """Check, sanitize, step, clamp, count."""
        frame, whole, replaced = self.measured(frame)
        own, image, lost = self.part(params, state.core, frame, state.age == 0, whole)
        return Recurrent(own, state.age + 1, state.sanitized + replaced + lost), image

    def measured(self, frame: Frame) -> tuple[Frame, FrameStatistics | None, jax.Array]:
        """The sanitized frame, what is measured of it, and the number of values that were replaced."""
        frame = check_frame(frame, self.core.reads)
        if self.core.counted:
            finite = jnp.all(jnp.isfinite(frame.radiance), axis=-1, keepdims=True)
            given = 1.0 if frame.sample_count is None else frame.sample_count
            frame = frame._replace(sample_count=jnp.where(finite, given, 0.0))
        frame, replaced = sanitize(frame)
        return frame, None if self.core.measure is None else self.core.measure(frame), replaced

    def part(
        self, params: Params, state: State, frame: Frame, first: jax.Array, whole: FrameStatistics | None
    ) -> tuple[State, jax.Array, jax.Array | int]:
        """The step of the core, its image clamped, of a sanitized frame or of a part of the frame that was measured."""
        given = () if whole is None else (whole,)
        state, image, lost = self.core.step(params, state, frame, first, *given)
        return state, jnp.clip(image, 0.0, RADIANCE_MAX), lost


def recurrent(core: Core) -> Denoiser:
    """The denoiser of a core. Its functions raise ValueError for wrong shapes, never for pixel values."""

    def start(params: Params, frame: Frame) -> Recurrent:
        frame, _ = sanitize(check_frame(frame, core.reads))
        zero = jnp.zeros((), jnp.int32)
        return Recurrent(core.start(params, frame), zero, zero)

    samples = None
    if core.samples is not None:
        core_samples = core.samples

        def samples(params: Params, state: Recurrent, frame: Frame, most: int) -> jax.Array:
            return core_samples(params, state.core, sanitize(check_frame(frame, core.reads))[0], state.age == 0, most)

    return Denoiser(core.init, start, RecurrentStep(core), core.reads, samples)


def check_frame(frame: Frame, reads: frozenset[str]) -> Frame:
    """The buffers of a frame that a denoiser reads. Raises ValueError unless they are [H, W, C], all of one size."""
    frame = only(frame, reads)
    check_image(frame.radiance, "frame.radiance", channels=3)
    for name, buffer in frame._asdict().items():
        if buffer is not None:
            check_same_size(frame.radiance, buffer, ("frame.radiance", f"frame.{name}"))
    return frame
