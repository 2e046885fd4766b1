"""Temporal antialiasing (``taa``): the history is blended in after it was clipped to what the new frame shows.

It compares colours and no surfaces: whatever the new frame does not show around a pixel, old light as well as what lies
behind a moved edge, is pulled into the range of its 3x3 neighbourhood. That needs an image with little noise, because
noise widens the range: it follows a denoiser (``taa(after=jaxdn.denoisers.svgf())``), whose remaining flicker it
removes. Alone, on noisy frames, it darkens: where nine pixels found no light, the history is clipped to black.

In games the camera rays are moved within the pixel from frame to frame, and the mean of the history smooths edges. A
:class:`jaxdn.Frame` has no such offset: rays are taken to go through the same point of every pixel, so edges are
smoothed only where the image moves. By default colours are averaged without weights against bright pixels, which would
darken light that is still noisy.

Brian Karis, "High Quality Temporal Supersampling", 2014.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, Prepared, State, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.accumulation import find_least_share
from jaxdn.filters.catmull_rom import warp_cubic
from jaxdn.filters.neighbourhood import (
    Box,
    box_around,
    clip_to_box,
    extremes_around,
    from_ycocg,
    mean_around,
    nearest_motion,
    to_ycocg,
)
from jaxdn.methods.registry import method

READS = frozenset({"motion", "depth"})


@dataclass(frozen=True)
class Options:
    """The parameters; defaults as they are common in games."""

    after: Denoiser | None = None
    """The denoiser whose images are smoothed; parameters are those of that one. None: the noisy frames."""
    alpha: Annotated[float, Range(0, 1, without_low=True)] = 0.1
    """Minimum weight of the new frame; the weight is ``max(alpha, 1 / N)`` at history length N."""
    ramp: bool = True
    """The new frame weighs at least 1 / N. Without, it is alpha from the second frame on."""
    light: Literal["linear", "tone-mapped"] = "linear"
    """The light that is clipped and averaged: linear, or ``x / (1 + luma)``, whose mean is weighted against bright
    pixels and is made linear again afterwards (Karis 2014)."""
    box: Box = "variance"
    """What the history is clipped to: mean and deviation of the 3x3 neighbourhood, its extremes (``"minmax"``), or the
    mean of these and of the extremes of the pixel and the four beside it (``"rounded"``)."""
    gamma: Annotated[float, Range(0)] = 1.0
    """Half size of the ``"variance"`` box in standard deviations."""
    sharpening: Annotated[float, Range(0, 1)] = 0.0
    """How much of the difference from the 3x3 mean is added to the image, but not to the history."""


class TaaState(NamedTuple):
    """What is carried from one frame to the next."""

    after: State
    """Of the denoiser before; () without one."""
    history: jax.Array
    """[H, W, 4] the last image, not sharpened, tone-mapped if it is averaged so, and the history length in frames."""


PAPER = Options(alpha=0.04, ramp=False, light="tone-mapped", box="rounded")
"""The settings of Karis 2014: a constant weight of 4 %, colours weighted by 1 / (1 + luma), and the mean of two boxes
of extremes, of 3x3 pixels and of the plus shape. The nearest motion, YCoCg and clipping to the box are the defaults."""


@method(Options, title="Temporal antialiasing (Karis 2014)", presets={"paper": PAPER})
def taa(options: Options) -> Denoiser:
    """TAA, a filter without weights, alone or after any denoiser.

    Reads motion and depth, besides what the denoiser before reads. Without depth, edges do not take over the motion of
    the thing in front; without motion the image is taken to stand still.
    Raises ValueError for options out of range and for radiance that is not [H, W, 3].
    """
    before = Core(_start_noisy, _step_noisy, frozenset(), receptive_field=0)
    if options.after is not None:
        before = core_of(options.after)

    def start(params: Params, frame: Frame) -> TaaState:
        nothing = jnp.zeros((*frame.radiance.shape[:2], 4), frame.radiance.dtype)
        return TaaState(before.start(params, frame), nothing)

    def prepare(frame: Frame) -> tuple[FrameStatistics, tuple[Prepared, Frame]]:
        statistics, prepared = before.prepare(frame)
        return statistics, (prepared, frame)

    def step(
        params: Params, state: TaaState, prepared: tuple[Prepared, Frame], first: jax.Array, statistics: FrameStatistics
    ) -> tuple[TaaState, jax.Array, jax.Array | int]:
        given, frame = prepared
        inner, image, inner_invalid = before.step(params, state.after, given, first, statistics)
        image = jnp.clip(image, 0.0, RADIANCE_MAX)
        if options.light == "tone-mapped":
            image = tone_map(image)
        history, invalid = resolve(options, image, state.history, frame, first)
        shown = sharpen(history[..., :3], options.sharpening)
        if options.light == "tone-mapped":
            shown = invert_tone_map(shown)
        return TaaState(inner, history), shown, inner_invalid + invalid

    samples = None
    if before.samples is not None:
        request = before.samples

        def samples(params: Params, state: TaaState, frame: Frame, first: jax.Array, most: int) -> jax.Array:
            return request(params, state.after, frame, first, most)

    field = None if before.receptive_field is None else before.receptive_field + _RECEPTIVE_FIELD
    mask = before.requires_validity_mask
    sees = before.sees_sample
    reads = before.reads | READS
    return recurrent(Core(start, step, reads, before.init, samples, prepare, field, mask, sees, before.pattern))


_RECEPTIVE_FIELD = 4
"""That of the 3x3 pixels whose motion and colours count, and of the cubic interpolation."""


def _start_noisy(params: Params, frame: Frame) -> tuple[()]:
    return ()


def _step_noisy(
    params: Params, state: State, frame: Frame, first: jax.Array, statistics: FrameStatistics
) -> tuple[State, jax.Array, int]:
    return state, frame.radiance, 0


def resolve(
    options: Options, image: jax.Array, history: jax.Array, frame: Frame, first: Any
) -> tuple[jax.Array, jax.Array]:
    """The new history [H, W, 4], colour and length, and how many pixels of the old one were invalid.

    ``image`` [H, W, 3] is blended with weight ``max(alpha, 1 / N)``, or without ``ramp`` alpha, into the fetched
    history, clipped to the box of the image's 3x3 neighbourhood in YCoCg.
    """
    sound = jnp.all(jnp.isfinite(history) & (history >= 0), axis=-1, keepdims=True)
    invalid = jnp.sum(~sound & ~first, dtype=jnp.int32)
    past = jnp.where(sound & ~first, history, 0.0)
    if frame.motion is not None:
        motion = frame.motion if frame.depth is None else nearest_motion(frame.motion, frame.depth)
        past = warp_cubic(past, motion)
    length = jnp.minimum(past[..., 3:], 1.0 / options.alpha) + 1.0
    center, size = box_around(to_ycocg(image), options.box, options.gamma)
    clipped = jnp.maximum(from_ycocg(clip_to_box(to_ycocg(past[..., :3]), center, size)), 0.0)
    share = jnp.maximum(options.alpha, find_least_share(past[..., 3:], length, ramp=options.ramp))
    # In this form the image itself, to the last bit, where there is no history.
    return jnp.concatenate([share * image + (1.0 - share) * clipped, length], axis=-1), invalid


def tone_map(image: jax.Array) -> jax.Array:
    """Light [H, W, 3] >= 0 as ``x / (1 + luma)``, luma = (R + 2 G + B) / 4 < 1 afterwards (Karis 2014)."""
    return image / (1.0 + to_ycocg(image)[..., :1])


def invert_tone_map(image: jax.Array) -> jax.Array:
    """The inverse of :func:`tone_map`, ``x / (1 - luma)``; luma counts as at most that of :data:`RADIANCE_MAX`."""
    return image / jnp.maximum(1.0 - to_ycocg(image)[..., :1], 1.0 / (1.0 + RADIANCE_MAX))


def sharpen(image: jax.Array, strength: float) -> jax.Array:
    """``image + strength (image - its 3x3 mean)``, within the extremes of the 3x3 neighbourhood: no halos."""
    if not strength:
        return image
    low, high = extremes_around(image)
    return jnp.clip(image + strength * (image - mean_around(image)), low, high)
