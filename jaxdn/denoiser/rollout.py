"""Stepping through a clip: as one scan, for training and notebooks, or frame by frame."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.checks import check_image
from jaxdn.core.frame import RADIANCE_MAX, Clip, Frame, frame_at, only, present
from jaxdn.denoiser import Denoiser, Params, Recurrent, State
from jaxdn.ops.sampling import from_layers, round_stochastically

if TYPE_CHECKING:
    from jaxtyping import Array, Float


Layers = Mapping[int, Any] | None
"""Samples per pixel -> independent noisy radiance; see :class:`jaxdn.Clip`."""


def render_requested(
    denoiser: Denoiser, params: Params, state: State, frame: Frame, layers: Layers, reference: jax.Array | None = None
) -> Frame:
    """The frame with the samples that the denoiser requests, taken from stored layers; unchanged without a request.

    Without layers, a frame that has ``sample_count`` counts as rendered as requested. Raises ValueError for a request
    without layers, and for one that they cannot fulfil.

    Args:
      denoiser: what requests samples.
      params: its parameters.
      state: before this frame.
      frame: [H, W, C]; the denoiser sees the layer of one sample in place of its radiance.
      layers: samples per pixel -> independent radiance [H, W, 3].
      reference: [H, W, 3], for a gradient of the image with respect to the numbers of samples.
    """
    if denoiser.samples is None or (layers is None and frame.sample_count is not None):
        return only(frame, denoiser.reads)
    if layers is None:
        raise ValueError(
            "layers: expected independent noisy layers, as this denoiser requests samples, or frames that have been "
            "rendered as requested, with sample_count; got neither."
        )
    rendered_first = frame if 1 not in layers else frame._replace(radiance=layers[1])
    wanted = denoiser.samples(params, state, only(rendered_first, denoiser.reads), sum(layers))
    # Their sum must not overflow; what is not a number stays, to be sanitized and counted in the step.
    bounded = {
        n: jnp.where(jnp.isfinite(layer), jnp.minimum(layer, RADIANCE_MAX), layer) for n, layer in layers.items()
    }
    uniform = denoiser.pattern(frame.radiance.shape[0], frame.radiance.shape[1], _age(state))
    radiance, counts = from_layers(bounded, wanted, reference=reference, uniform=uniform)
    return only(frame._replace(radiance=radiance, sample_count=counts), denoiser.reads)


def _age(state: State) -> jax.Array | int:
    """How many frames a state has seen, for random numbers that are others in every frame; 0 where it does not tell."""
    return state.age if isinstance(state, Recurrent) else 0


def unroll(
    denoiser: Denoiser,
    params: Params,
    frames: Frame,
    layers: Layers = None,
    reference: Float[Array, "T H W 3"] | None = None,
    *,
    rematerialize: bool = False,
) -> Float[Array, "T H W 3"]:
    """Denoise consecutive frames with one recurrent state; returns images ``[T, H, W, 3]``.

    ``start`` gets the first frame, then ``step`` is scanned over all T frames.

    Args:
      denoiser: what denoises.
      params: its parameters.
      frames: a Frame of buffers ``[T, H, W, C]``.
      layers: samples per pixel -> ``[T, H, W, 3]``, for a denoiser that requests samples.
      reference: ``[T, H, W, 3]``, with which such a denoiser learns where samples should go.
      rematerialize: recompute each step from its carried state in the backward pass, so that memory grows by one
        frame's state per frame instead of one network's activations (about a quarter of the memory for 1.1 to 1.4
        times the time; Chen et al. 2016, "Training Deep Nets with Sublinear Memory Cost").
    """
    frames = only(frames, denoiser.reads)
    layers, reference = (layers, reference) if denoiser.samples is not None else (None, None)

    def step(state: State, given: tuple[Frame, Layers, jax.Array | None]) -> tuple[State, jax.Array]:
        return denoiser.step(params, state, render_requested(denoiser, params, state, *given))

    body = jax.checkpoint(step, prevent_cse=False) if rematerialize else step
    _, images = lax.scan(body, denoiser.start(params, frame_at(frames, 0)), (frames, layers, reference))
    return images


def denoise(denoiser: Denoiser, params: Params, clip: Clip) -> Float[Array, "T H W 3"]:
    """Denoise a clip; returns linear radiance ``[T, H, W, 3]``, >= 0.

    ``clip.frames`` are T frames of linear radiance and any other buffers; those that ``denoiser.reads`` does not name
    are left out of the program. Pure and not jitted: wrap it in ``jax.jit`` with the
    denoiser closed over. Raises ValueError when the radiance is not ``[T, H, W, 3]`` or a buffer's size differs.
    """
    radiance = clip.frames.radiance
    check_image(radiance, "clip.frames.radiance", channels=3, rank=4)
    for name, buffer in clip.frames._asdict().items():
        if buffer is not None and buffer.shape[:3] != radiance.shape[:3]:
            raise ValueError(
                f"clip.frames.{name}: expected [T, H, W] = {radiance.shape[:3]} as the radiance has, "
                f"got {buffer.shape[:3]}; crop or resample it."
            )
    return unroll(denoiser, params, clip.frames, clip.layers)


# Jitted once for all streams: a denoiser that is used on many clips is compiled once.
@functools.partial(jax.jit, static_argnums=0)
def _start(denoiser: Denoiser, params: Params, frame: Frame) -> State:
    """The state before the first frame, in memory of its own: a jitted function returns what it was given as it is."""
    return jax.tree.map(jnp.copy, denoiser.start(params, frame))


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(denoiser: Denoiser, params: Params, state: State, frame: Frame, layers: Layers) -> tuple[State, jax.Array]:
    return denoiser.step(params, state, render_requested(denoiser, params, state, frame, layers))


@functools.partial(jax.jit, static_argnums=(0, 4))
def _ask(denoiser: Denoiser, params: Params, state: State, frame: Frame, most: int) -> jax.Array:
    assert denoiser.samples is not None
    wanted = denoiser.samples(params, state, frame, most)
    uniform = denoiser.pattern(wanted.shape[0], wanted.shape[1], _age(state))
    return jnp.clip(round_stochastically(wanted, uniform), 0, most)


class Stream:
    """Frames in, images out, one at a time: the recurrent state is kept between calls. Made by :func:`stream`.

    A step is compiled for each distinct set of buffers; the memory of the state is reused.
    """

    def __init__(self, denoiser: Denoiser, params: Params) -> None:
        self._denoiser, self._params = denoiser, params
        self._state: State = None
        self.programs: set[tuple[str, ...]] = set()
        """The sets of buffers, without radiance, that a step was compiled for."""

    def __call__(self, frame: Frame, layers: Layers = None) -> jax.Array:
        """Denoise the next frame [H, W, C]; returns [H, W, 3]."""
        frame = self._begun(frame)
        self.programs.add(present(frame))
        self._state, image = _step(self._denoiser, self._params, self._state, frame, layers)
        return image

    def ask(self, frame: Frame, most: int) -> jax.Array | None:
        """The numbers of samples [H, W, 1], rounded to whole ones, that the denoiser requests for the next frame; None
        without a request.

        The frame's radiance is what has been rendered before; a pixel can have ``most`` samples. Then call with the
        frame as rendered with these, and its ``sample_count``.
        """
        if self._denoiser.samples is None:
            return None
        frame = self._begun(frame)
        return _ask(self._denoiser, self._params, self._state, frame, most)

    def _begun(self, frame: Frame) -> Frame:
        """What is read of a frame; the state starts with the first one."""
        frame = only(frame, self._denoiser.reads)
        if self._state is None:
            self._state = _start(self._denoiser, self._params, frame)
        return frame

    def each(self, frames: Iterable[Frame]) -> Iterator[jax.Array]:
        """The image of every frame, computed lazily."""
        return (self(frame) for frame in frames)

    @property
    def sanitized(self) -> int:
        """Values of frames and histories that had to be replaced so far."""
        return int(getattr(self._state, "sanitized", 0))


def stream(denoiser: Denoiser, params: Params) -> Stream:
    """A function from each frame of a sequence to its denoised image; memory is that of one frame.

    Used by the command line, the chart and notebooks; gives the same images as :func:`denoise`.
    """
    return Stream(denoiser, params)
