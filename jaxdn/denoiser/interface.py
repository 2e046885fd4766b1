"""What a denoiser is, and the processing that all methods share.

:class:`Denoiser` is the one interface that training, evaluation, the planner, the chart and the command line use. A
method is written as a :class:`Core`, which gets only valid frames. :func:`recurrent` turns it into a denoiser and adds
what every method needs: it checks shapes, sanitizes frames and counts the replaced values, measures the frame's
statistics, keeps the age of the state, and clamps the image to values from 0 to the largest that a file holds.

Wrappers (demodulation, antialiasing after a denoiser) take :func:`core_of` any denoiser; tiles and exported programs
take :func:`stages_of` it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.core.frame import BUFFERS, RADIANCE_MAX, Frame, only
from jaxdn.denoiser.sanitize import sanitize
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.ops.sampling import draw_random_numbers

Params = dict[str, Any]
"""Nested dicts of arrays; ``{}`` for a filter without weights."""
State = Any
"""What is carried from one frame to the next: a flat pytree of few, large arrays."""
Prepared = Any
"""What a core makes of a frame before its step: the frame itself, or with it what statistics and step both need."""
Step = Callable[[Params, State, Frame], tuple[State, jax.Array]]
"""(params, state, frame) -> (state, image [H, W, 3] >= 0)."""
Pattern = Callable[[int, int, jax.Array | int], jax.Array]
"""(height, width, number of the frame) -> [H, W, 1] in [0, 1): where fractions of samples are rounded up."""

_COUNTED = frozenset({"count", "flag", "id"})
"""Kinds of buffers that may be integers."""


class Denoiser(NamedTuple):
    """The interface of every denoiser; a clip is a scan over ``step``. The functions are pure and not jitted.

    The first four fields make a denoiser. The others are optional: they say what else it can do.
    """

    init: Callable[[jax.Array, Frame], Params]
    """(key, frame) -> params. The frame may be any of the clip: it tells sizes and which buffers there are."""
    start: Callable[[Params, Frame], State]
    """(params, frame) -> state before the first frame."""
    step: Step
    reads: frozenset[str]
    """Names of the Frame buffers, in addition to ``radiance``, that it can use."""
    samples: Callable[[Params, State, Frame, int], jax.Array] | None = None
    """(params, state, frame, most) -> [H, W, 1] samples per pixel that it requests from the renderer before ``step``
    (fractions are rounded up with their probability); a pixel can have ``most``. Here the frame's radiance is what has
    been rendered before; in ``step`` it is the mean of the requested samples, with ``sample_count``. None: no request,
    the radiance is used as it is."""
    receptive_field: int | None = None
    """Radius in pixels: what is farther from a pixel than this does not change its image. Excepted are the history,
    which may come from as much farther as vectors are long, and the frame's statistics (:class:`Core`). None: it is
    not known, and frames cannot be denoised in tiles."""
    core: "Core | None" = None
    """The method inside the processing that all share, for wrappers; :func:`recurrent` sets it. None: there is no such
    processing, and wrappers take the functions above. Who replaces one of these replaces the core, too."""
    sees_sample: bool = True
    """``samples`` looks at the frame's radiance: a sample of every pixel has to be rendered before it is called."""
    pattern: Pattern = draw_random_numbers
    """The numbers below which a fraction that ``samples`` requests is rounded up."""


class Core(NamedTuple):
    """A method without the shared processing. Frames hold only what it reads, already sanitized."""

    start: Callable[[Params, Frame], State]
    """(params, frame) -> its own state."""
    step: Callable[[Params, State, Prepared, jax.Array, FrameStatistics], tuple[State, jax.Array, jax.Array | int]]
    """(params, state, prepared, first, statistics) -> (state, image [H, W, 3], number of invalid values of the
    history). ``first`` is a bool scalar: there is no history yet, regardless of state and motion."""
    reads: frozenset[str]
    init: Callable[[jax.Array, Frame], Params] = lambda key, frame: {}
    samples: Callable[[Params, State, Frame, jax.Array, int], jax.Array] | None = None
    """(params, state, frame, first, most) -> [H, W, 1]."""
    prepare: Callable[[Frame], tuple[FrameStatistics, Prepared]] = lambda frame: (
        measure_frame(frame.radiance, frame.depth, frame),
        frame,
    )
    """frame -> (statistics, prepared), once a frame. Statistics are of the whole frame, also where ``prepared`` is a
    tile of it. By default they are those of the frame's radiance and depth, and the frame is prepared as it is."""
    receptive_field: int | None = None
    """As of :class:`Denoiser`; what a pixel's value in the state depends on counts, too."""
    requires_validity_mask: bool = False
    """Its frames always have a ``sample_count``, whether or not it reads one: 0 where the radiance is no measurement,
    because a value was not finite, elsewhere the given one if it reads that, else 1. Without it such pixels look like
    pixels without light."""
    sees_sample: bool = True
    """As of :class:`Denoiser`."""
    pattern: Pattern = draw_random_numbers
    """As of :class:`Denoiser`."""


class Recurrent(NamedTuple):
    """The state of a denoiser that :func:`recurrent` made."""

    core: State
    """The method's own."""
    age: jax.Array
    """int32, frames processed; at 0 there is no history."""
    sanitized: jax.Array
    """int32, values of frames and histories that had to be replaced so far."""


def recurrent(core: Core) -> Denoiser:
    """The denoiser of a core. Its functions raise ValueError for wrong shapes, never for pixel values."""
    stages = _shared_stages(core)

    def start(params: Params, frame: Frame) -> Recurrent:
        zero = jnp.zeros((), jnp.int32)
        return Recurrent(stages.start(params, frame), zero, zero)

    def step(params: Params, state: Recurrent, frame: Frame) -> tuple[Recurrent, jax.Array]:
        statistics, prepared, replaced = stages.prepare(frame)
        own, image, invalid = stages.step(params, state.core, prepared, state.age == 0, statistics)
        return Recurrent(own, state.age + 1, state.sanitized + replaced + invalid), image

    samples = None
    if core.samples is not None:
        core_samples = core.samples

        def samples(params: Params, state: Recurrent, frame: Frame, most: int) -> jax.Array:
            return core_samples(params, state.core, sanitize(check_frame(frame, core.reads))[0], state.age == 0, most)

    return Denoiser(
        core.init, start, step, core.reads, samples, core.receptive_field, core, core.sees_sample, core.pattern
    )


class Stages(NamedTuple):
    """A step in two stages, so that a frame can be measured as a whole and stepped tile by tile."""

    start: Callable[[Params, Frame], State]
    """(params, frame) -> state without an age. Any state of the same shapes will do for a first frame."""
    prepare: Callable[[Frame], tuple[FrameStatistics, Prepared, jax.Array | int]]
    """frame -> (statistics, prepared, number of values that were replaced)."""
    step: Callable[[Params, State, Prepared, jax.Array, FrameStatistics], tuple[State, jax.Array, jax.Array | int]]
    """As :attr:`Core.step`; the image is final."""


def stages_of(denoiser: Denoiser) -> Stages:
    """The two stages of any denoiser's step; one after the other they do what ``denoiser.step`` does."""
    if denoiser.core is not None:
        return _shared_stages(denoiser.core)
    core = core_of(denoiser)

    def prepare(frame: Frame) -> tuple[FrameStatistics, Prepared, int]:
        return *core.prepare(only(frame, core.reads)), 0

    return Stages(core.start, prepare, core.step)


def core_of(denoiser: Denoiser) -> Core:
    """The core of any denoiser: what a wrapper changes and gives to :func:`recurrent` again.

    Of a denoiser that was written as three functions it is these; with ``first`` the state is that of ``start``.
    """
    if denoiser.core is not None:
        return denoiser.core

    def begin(params: Params, state: State, frame: Frame, first: jax.Array) -> State:
        new = denoiser.start(params, only(frame, denoiser.reads))
        return jax.tree.map(lambda new, old: jnp.where(first, new, old), new, state)

    def step(
        params: Params, state: State, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[State, jax.Array, int]:
        return *denoiser.step(params, begin(params, state, frame, first), only(frame, denoiser.reads)), 0

    samples = None
    if denoiser.samples is not None:
        request = denoiser.samples

        def samples(params: Params, state: State, frame: Frame, first: jax.Array, most: int) -> jax.Array:
            return request(params, begin(params, state, frame, first), only(frame, denoiser.reads), most)

    core = Core(denoiser.start, step, denoiser.reads, denoiser.init, samples)
    return core._replace(
        receptive_field=denoiser.receptive_field, sees_sample=denoiser.sees_sample, pattern=denoiser.pattern
    )


def _shared_stages(core: Core) -> Stages:
    """The stages of a core with the processing that all methods share."""

    def start(params: Params, frame: Frame) -> State:
        return core.start(params, sanitize(check_frame(frame, core.reads))[0])

    def prepare(frame: Frame) -> tuple[FrameStatistics, Prepared, jax.Array]:
        frame = check_frame(frame, core.reads)
        if core.requires_validity_mask:
            finite = jnp.all(jnp.isfinite(frame.radiance), axis=-1, keepdims=True)
            given = 1.0 if frame.sample_count is None else frame.sample_count
            frame = frame._replace(sample_count=jnp.where(finite, given, 0.0))
        frame, replaced = sanitize(frame)
        return *core.prepare(frame), replaced

    def step(
        params: Params, state: State, prepared: Prepared, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[State, jax.Array, jax.Array | int]:
        state, image, invalid = core.step(params, state, prepared, first, statistics)
        return state, jnp.clip(image, 0.0, RADIANCE_MAX), invalid

    return Stages(start, prepare, step)


def check_frame(frame: Frame, reads: frozenset[str]) -> Frame:
    """The buffers of a frame that a denoiser reads.

    Raises ValueError unless they are [H, W, C], all of one size, with the channels of the table
    (:data:`jaxdn.core.frame.BUFFERS`), and of floating point where they are no numbers of shapes, flags or counts.
    """
    frame = only(frame, reads)
    check_image(frame.radiance, "frame.radiance", channels=3)
    for name, values in frame._asdict().items():
        if values is None:
            continue
        buffer = BUFFERS[name]
        check_same_size(frame.radiance, values, ("frame.radiance", f"frame.{name}"))
        if jnp.shape(values)[-1] != buffer.channels:
            raise ValueError(f"frame.{name}: expected {buffer.channels} channels, got shape {jnp.shape(values)}.")
        if buffer.kind not in _COUNTED:
            check_image(values, f"frame.{name}")
    return frame
