"""What a denoiser is, and the ritual that all of them share.

:class:`Denoiser` is the one interface that training, evaluation, the planner, the chart and the command line know. A
method is written as a :class:`Core`, which sees nothing but sound frames; :func:`recurrent` makes a denoiser of it and
does for all methods, once, what each would otherwise repeat: shapes are checked, frames repaired and counted, the age
of the state is kept, and no image leaves with a value that is negative or beyond what a file holds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.checks import check_image, check_same_size
from jaxdn.frame import RADIANCE_MAX, Frame, only
from jaxdn.repair import repair

Params = Any
"""Nested dicts of arrays; ``{}`` for a filter without weights."""
State = Any
"""What one frame leaves to the next: a flat pytree of few, large arrays."""
Step = Callable[[Params, State, Frame], tuple[State, jax.Array]]
"""(params, state, frame) -> (state, image [H, W, 3] >= 0)."""


class Denoiser(NamedTuple):
    """The one interface; a clip is a scan over ``step``. The functions are pure, and not jitted."""

    init: Callable[[jax.Array, Frame], Params]
    """(key, frame) -> params."""
    start: Callable[[Params, Frame], State]
    """(params, frame) -> state before the first frame."""
    step: Step
    reads: frozenset[str]
    """Names of the Frame buffers, besides ``radiance``, that it can make use of."""
    samples: Callable[[Params, State, Frame], jax.Array] | None = None
    """(params, state, frame) -> [H, W, 1] samples a pixel that it asks the renderer for before ``step`` (rounded to
    whole numbers). The frame's radiance is then what has been rendered beforehand, and in ``step`` the mean of the
    samples asked for, with ``sample_count``. None: it takes the radiance as it comes."""


class Core(NamedTuple):
    """A method without the ritual. Frames hold what it reads, repaired; there is no need to look for broken values."""

    start: Callable[[Params, Frame], State]
    """(params, frame) -> its own state."""
    step: Callable[[Params, State, Frame, jax.Array], tuple[State, jax.Array, jax.Array | int]]
    """(params, state, frame, first) -> (state, image [H, W, 3], values of the history that had to be replaced).
    ``first`` is a bool scalar: there is no history yet, whatever the state and the motion say."""
    reads: frozenset[str]
    init: Callable[[jax.Array, Frame], Params] = lambda key, frame: {}
    samples: Callable[[Params, State, Frame], jax.Array] | None = None


class Recurrent(NamedTuple):
    """The state of a denoiser that :func:`recurrent` made."""

    core: State
    """The method's own."""
    age: jax.Array
    """int32, frames seen; at 0 there is no history."""
    repaired: jax.Array
    """int32, values of frames and histories that had to be replaced so far."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ritual:
    """The ``step`` of a denoiser that :func:`recurrent` made; wrappers such as ``demodulated`` take its ``core``."""

    core: Core

    def __call__(self, params: Params, state: Recurrent, frame: Frame) -> tuple[Recurrent, jax.Array]:
        """Check, repair, step, clamp, count."""
        frame, replaced = repair(checked(frame, self.core.reads))
        own, image, lost = self.core.step(params, state.core, frame, state.age == 0)
        image = jnp.clip(image, 0.0, RADIANCE_MAX)
        return Recurrent(own, state.age + 1, state.repaired + replaced + lost), image


def recurrent(core: Core) -> Denoiser:
    """The denoiser of a core. Its functions raise ValueError for shapes that do not fit, never for pixel contents."""

    def start(params: Params, frame: Frame) -> Recurrent:
        frame, _ = repair(checked(frame, core.reads))
        zero = jnp.zeros((), jnp.int32)
        return Recurrent(core.start(params, frame), zero, zero)

    samples = None
    if core.samples is not None:
        asked = core.samples

        def samples(params: Params, state: Recurrent, frame: Frame) -> jax.Array:
            return asked(params, state.core, repair(checked(frame, core.reads))[0])

    return Denoiser(core.init, start, Ritual(core), core.reads, samples)


def checked(frame: Frame, reads: frozenset[str]) -> Frame:
    """What a denoiser reads of a frame. Raises ValueError unless that is [H, W, C], all of one size."""
    frame = only(frame, reads)
    check_image(frame.radiance, "frame.radiance", channels=3)
    for name, buffer in frame._asdict().items():
        if buffer is not None:
            check_same_size(frame.radiance, buffer, ("frame.radiance", f"frame.{name}"))
    return frame
