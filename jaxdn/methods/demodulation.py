"""Demodulation: a wrapper that makes any denoiser filter radiance divided by what the surface reflects."""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.checks import check_option
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Denoiser, Params, Prepared, State, core_of, recurrent
from jaxdn.denoiser.statistics import FrameStatistics

SMALLEST_ALBEDO = 0.01
"""Radiance is not divided by an albedo below this (``by="albedo"``)."""

Demodulation = Literal["brdf", "albedo", "none"]
"""What light is divided by, see :func:`demodulated`."""


def demodulated(denoiser: Denoiser, *, by: Demodulation = "brdf") -> Denoiser:
    """The denoiser applied to radiance divided by what the surface reflects; its image is multiplied by the same again.

    Textures are thus removed before filtering and cannot be blurred. What a denoiser keeps is divided too, each frame
    by its own divisor. The divisor of a dark surface is larger than its reflectance, so some of its texture is left
    (:func:`find_texture_left`). The filters of this library average that as they average light, over pixels and
    frames, and so it is not blurred; a denoiser that does not mixes dark textures of several frames. ``by`` is

    * ``"brdf"``: :func:`jaxdn.brdf.demodulate` by the frame's ``reflectance``, by its albedo where that is absent;
    * ``"albedo"``: by the albedo where that exceeds 0.01 and by 1 elsewhere: on dark and on glossy surfaces the divided
      light of neighbours may differ by a factor of 100, and colours appear that are not there;
    * ``"none"``: the denoiser is returned unchanged.

    Any denoiser can be wrapped. One that was written as three functions gets sanitized frames inside, as invalid values
    have to be replaced before the division. Divided radiance may exceed 65504: a clamp there would make the result
    depend on the exposure. Frames with neither buffer are not divided. The parameters are those of the denoiser. Raises
    ValueError for another ``by``.
    """
    check_option(by, "by", ("brdf", "albedo", "none"))
    if by == "none":
        return denoiser
    core = core_of(denoiser)

    def start(params: Params, frame: Frame) -> State:
        return core.start(params, _demodulate(frame, by))

    def prepare(frame: Frame) -> tuple[FrameStatistics, tuple[Prepared, Frame]]:
        statistics, prepared = core.prepare(_demodulate(frame, by))
        return statistics, (prepared, frame)

    def step(
        params: Params, state: State, prepared: tuple[Prepared, Frame], first: jax.Array, statistics: FrameStatistics
    ) -> tuple[State, jax.Array, jax.Array | int]:
        divided, frame = prepared
        state, image, invalid = core.step(params, state, divided, first, statistics)
        return state, _remodulate(image, frame, by), invalid

    samples = None
    if core.samples is not None:
        request = core.samples

        def samples(params: Params, state: State, frame: Frame, first: jax.Array, most: int) -> jax.Array:
            return request(params, state, _demodulate(frame, by), first, most)

    reads = core.reads | ({"albedo", "reflectance"} if by == "brdf" else {"albedo"})
    return recurrent(core._replace(start=start, step=step, reads=reads, samples=samples, prepare=prepare))


def find_texture_left(frame: Frame, by: Demodulation, statistics: FrameStatistics) -> jax.Array | None:
    """The texture [H, W, 3] that the division leaves in a frame inside :func:`demodulated`; None if it leaves none.

    A filter that averages it with the weights of the light can give it back (:func:`jaxdn.brdf.restore`). If the
    reflectance is the albedo everywhere, nothing tells that the albedo is all that is reflected: only its colours are
    to be given back then (:func:`jaxdn.brdf.hue_left`; on frames of metal and gloss without a reflectance, giving
    back brightness too costs svgf 1.4 dB). ``by="albedo"`` leaves the textures of black pixels alone.
    """
    reflectance = _reflectance(frame)
    if by != "brdf" or reflectance is None:
        return None
    return texture_of(reflectance, frame, frame.radiance, statistics)


def texture_of(reflectance: jax.Array, frame: Frame, light: jax.Array, statistics: FrameStatistics) -> jax.Array:
    """The texture [H, W, 3] that a division leaves of a frame's reflectance, or of what of it is not specular.

    As in :func:`find_texture_left`. ``light`` [H, W, 3] is what is divided by it, or was.
    """
    if frame.albedo is None or frame.reflectance is None:
        return brdf.texture_or_hue(reflectance, light, jnp.asarray(frame.albedo is not None))
    return brdf.texture_or_hue(reflectance, light, ~(statistics.reflectance_differs > 0))


def _demodulate(frame: Frame, by: Demodulation) -> Frame:
    """The frame with divided radiance."""
    reflectance = _reflectance(frame)
    if by == "brdf" and reflectance is not None:
        return frame._replace(radiance=brdf.demodulate(frame.radiance, reflectance))
    if by == "albedo" and frame.albedo is not None:
        return frame._replace(radiance=frame.radiance / _albedo_divisor(frame.albedo))
    return frame


def _remodulate(image: jax.Array, frame: Frame, by: Demodulation) -> jax.Array:
    """The image [H, W, 3] multiplied by what the frame's radiance was divided by."""
    reflectance = _reflectance(frame)
    if by == "brdf" and reflectance is not None:
        return brdf.remodulate(image, reflectance)
    return image * _albedo_divisor(frame.albedo) if by == "albedo" and frame.albedo is not None else image


def _albedo_divisor(albedo: jax.Array) -> jax.Array:
    return jnp.where(albedo > SMALLEST_ALBEDO, albedo, 1.0)


def _reflectance(frame: Frame) -> jax.Array | None:
    # The albedo is the reflectance's neutral value: the same function of either.
    return frame.albedo if frame.reflectance is None else frame.reflectance
