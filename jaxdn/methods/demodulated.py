"""A denoiser that works on light divided by what the surface reflects, as a wrapper of any other."""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.checks import check_option
from jaxdn.denoiser import Core, Denoiser, Params, Ritual, State, recurrent
from jaxdn.frame import RADIANCE_MAX, Frame

SMALLEST_ALBEDO = 0.01
"""Albedo below this is not divided by (``by="albedo"``)."""

Demodulation = Literal["albedo", "brdf", "none"]
"""What light is divided by, see :func:`demodulated`."""


def demodulated(denoiser: Denoiser, *, by: Demodulation = "albedo") -> Denoiser:
    """The same denoiser fed with radiance divided by what the surface reflects, its image multiplied by the same again.

    Textures then are not in what is filtered, and cannot be blurred. Its state, history included, is demodulated too.

    * ``by="brdf"``: by :func:`jaxdn.brdf.divisor` of the frame's ``reflectance``, of its albedo where there is none;
    * ``by="albedo"``: by the albedo where that is above 0.01 and by 1 elsewhere, as the shipped weights have learned;
    * ``by="none"`` returns the denoiser as it is.

    Where frames have neither buffer, nothing is divided. Parameters are those of the denoiser. Raises ValueError for
    another ``by``, and for a denoiser that :func:`jaxdn.denoiser.recurrent` did not make, as broken values have to be
    repaired before the division.
    """
    check_option(by, "by", ("albedo", "brdf", "none"))
    if by == "none":
        return denoiser
    if not isinstance(denoiser.step, Ritual):
        raise ValueError("demodulated: expected a denoiser made by jaxdn.denoiser.recurrent, got another; make it so.")
    core = denoiser.step.core

    def start(params: Params, frame: Frame) -> State:
        return core.start(params, _divided(frame, by)[0])

    def step(params: Params, state: State, frame: Frame, first: jax.Array) -> tuple[State, jax.Array, jax.Array | int]:
        frame, divisor = _divided(frame, by)
        state, image, lost = core.step(params, state, frame, first)
        return state, image if divisor is None else image * divisor, lost

    def samples(params: Params, state: State, frame: Frame) -> jax.Array:
        assert core.samples is not None
        return core.samples(params, state, _divided(frame, by)[0])

    asks = None if core.samples is None else samples
    reads = {"albedo", "reflectance"} if by == "brdf" else {"albedo"}
    return recurrent(Core(start, step, core.reads | reads, core.init, asks))


def _divided(frame: Frame, by: Demodulation) -> tuple[Frame, jax.Array | None]:
    """The frame with demodulated radiance, and what it was divided by."""
    divisor = _divisor(frame, by)
    if divisor is None:
        return frame, None
    return frame._replace(radiance=jnp.minimum(frame.radiance / divisor, RADIANCE_MAX)), divisor


def _divisor(frame: Frame, by: Demodulation) -> jax.Array | None:
    if by == "brdf":
        # The albedo is the reflectance's neutral value: the same function of either.
        reflectance = frame.albedo if frame.reflectance is None else frame.reflectance
        return None if reflectance is None else brdf.divisor(reflectance)
    return None if frame.albedo is None else jnp.where(frame.albedo > SMALLEST_ALBEDO, frame.albedo, 1.0)
