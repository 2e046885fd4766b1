"""Demodulation: a wrapper that makes any denoiser filter radiance divided by what the surface reflects."""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.checks import check_option
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Denoiser, Params, RecurrentStep, State, recurrent
from jaxdn.denoiser.statistics import FrameStatistics

SMALLEST_ALBEDO = 0.01
"""Radiance is not divided by an albedo below this (``by="albedo"``)."""

Demodulation = Literal["brdf", "albedo", "none"]
"""What light is divided by, see :func:`demodulated`."""


def demodulated(denoiser: Denoiser, *, by: Demodulation | bool = "brdf") -> Denoiser:
    """The denoiser applied to radiance divided by what the surface reflects; its image is multiplied by the same again.

    Textures are thus removed before filtering and cannot be blurred. The state, including the history, is demodulated
    too. ``by`` is

    * ``"brdf"``: :func:`jaxdn.brdf.divisor` of the frame's ``reflectance``, of its albedo where that is absent;
    * ``"albedo"``: the albedo where that exceeds 0.01 and 1 elsewhere, as in earlier versions: on dark and on glossy
      surfaces the divided light of neighbours may differ by a factor of 100, and colours appear that are not there;
    * ``"none"``: the denoiser is returned unchanged.

    Divided radiance may exceed 65504: a clamp there would make the result depend on the exposure. ``True`` is
    ``"albedo"`` and ``False`` is ``"none"``. Frames with neither buffer are not divided. The parameters are those of
    the denoiser. Raises ValueError for another ``by``, and for a denoiser that :func:`jaxdn.denoiser.recurrent` did not
    make, because invalid values have to be sanitized before the division.
    """
    by = _chosen(by)
    if by == "none":
        return denoiser
    if not isinstance(denoiser.step, RecurrentStep):
        raise ValueError("demodulated: expected a denoiser made by jaxdn.denoiser.recurrent, got another; make it so.")
    core = denoiser.step.core

    def start(params: Params, frame: Frame) -> State:
        return core.start(params, _divided(frame, by)[0])

    def step(
        params: Params, state: State, frame: Frame, first: jax.Array, *whole: FrameStatistics
    ) -> tuple[State, jax.Array, jax.Array | int]:
        frame, divisor = _divided(frame, by)
        state, image, lost = core.step(params, state, frame, first, *whole)
        return state, image if divisor is None else image * divisor, lost

    def samples(params: Params, state: State, frame: Frame, first: jax.Array, most: int) -> jax.Array:
        assert core.samples is not None
        return core.samples(params, state, _divided(frame, by)[0], first, most)

    def measure(frame: Frame) -> FrameStatistics:
        assert core.measure is not None
        return core.measure(_divided(frame, by)[0])

    requests = None if core.samples is None else samples
    measuring = None if core.measure is None else measure
    reads = {"albedo", "reflectance"} if by == "brdf" else {"albedo"}
    changed = core._replace(start=start, step=step, reads=core.reads | reads, samples=requests, measure=measuring)
    return recurrent(changed)


def texture_left(frame: Frame, by: Demodulation | bool, whole: FrameStatistics | None = None) -> jax.Array | None:
    """The texture [H, W, 3] that the division leaves in a frame inside :func:`demodulated`; None if it leaves none.

    A filter that averages it with the weights of the light can give it back (:func:`jaxdn.brdf.restore`). If the
    reflectance is the albedo everywhere, nothing tells that the albedo is all that is reflected: only its colours are
    to be given back then (:func:`jaxdn.brdf.hue_left`; on frames of metal and gloss without a reflectance, giving
    back brightness too costs svgf 1.4 dB). ``by="albedo"`` leaves the textures of black pixels alone, as it was.
    ``whole`` is what was measured of the frame that this one is a part of; None: it is the whole one.
    """
    reflectance = _reflectance(frame)
    if _chosen(by) != "brdf" or reflectance is None:
        return None
    return texture_of(reflectance, frame, frame.radiance, whole)


def texture_of(
    reflectance: jax.Array, frame: Frame, light: jax.Array, whole: FrameStatistics | None = None
) -> jax.Array:
    """The texture [H, W, 3] that a division leaves of a reflectance of the frame, whole or without its specular part.

    As in :func:`texture_left`. ``light`` [H, W, 3] is what is divided by it, or was.
    """
    if frame.albedo is None or frame.reflectance is None:
        return brdf.texture_or_hue(reflectance, light, jnp.asarray(frame.albedo is not None))
    other = jnp.any(frame.reflectance != frame.albedo) if whole is None else whole.reflectance_differs > 0
    return brdf.texture_or_hue(reflectance, light, ~other)


def _divided(frame: Frame, by: Demodulation) -> tuple[Frame, jax.Array | None]:
    """The frame with demodulated radiance, and the divisor."""
    divisor = _divisor(frame, by)
    if divisor is None:
        return frame, None
    return frame._replace(radiance=frame.radiance / divisor), divisor


def _divisor(frame: Frame, by: Demodulation) -> jax.Array | None:
    if by == "brdf":
        reflectance = _reflectance(frame)
        return None if reflectance is None else brdf.divisor(reflectance)
    return None if frame.albedo is None else jnp.where(frame.albedo > SMALLEST_ALBEDO, frame.albedo, 1.0)


def _reflectance(frame: Frame) -> jax.Array | None:
    # The albedo is the reflectance's neutral value: the same function of either.
    return frame.albedo if frame.reflectance is None else frame.reflectance


def _chosen(by: Demodulation | bool) -> Demodulation:
    if isinstance(by, bool):  # as it was before there were three choices
        return "albedo" if by else "none"
    check_option(by, "by", ("brdf", "albedo", "none"))
    return by
