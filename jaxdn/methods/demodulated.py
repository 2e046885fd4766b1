"""A denoiser that works on light divided by what the surface reflects, as a wrapper of any other."""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn.checks import check_option
from jaxdn.denoiser import Core, Denoiser, Params, Ritual, State, recurrent
from jaxdn.frame import RADIANCE_MAX, Frame

SMALLEST_ALBEDO = 0.01
"""Albedo below this is not divided by."""

Demodulation = Literal["albedo", "none"]


def demodulated(denoiser: Denoiser, *, by: Demodulation = "albedo") -> Denoiser:
    """The same denoiser fed with radiance divided by the albedo, its image multiplied by the same again.

    Textures then are not in what is filtered, and cannot be blurred. Its state, history included, is demodulated too.
    ``by="none"`` returns the denoiser as it is; where frames have no albedo, nothing is divided. Parameters are those
    of the denoiser. Raises ValueError for another ``by``, and for a denoiser that :func:`jaxdn.denoiser.recurrent` did
    not make, as broken values have to be repaired before the division.
    """
    check_option(by, "by", ("albedo", "none"))
    if by == "none":
        return denoiser
    if not isinstance(denoiser.step, Ritual):
        raise ValueError("demodulated: expected a denoiser made by jaxdn.denoiser.recurrent, got another; make it so.")
    core = denoiser.step.core

    def start(params: Params, frame: Frame) -> State:
        return core.start(params, _divided(frame)[0])

    def step(params: Params, state: State, frame: Frame, first: jax.Array) -> tuple[State, jax.Array, jax.Array | int]:
        frame, divisor = _divided(frame)
        state, image, lost = core.step(params, state, frame, first)
        return state, image if divisor is None else image * divisor, lost

    def samples(params: Params, state: State, frame: Frame) -> jax.Array:
        assert core.samples is not None
        return core.samples(params, state, _divided(frame)[0])

    asks = None if core.samples is None else samples
    return recurrent(Core(start, step, core.reads | {"albedo"}, core.init, asks))


def _divided(frame: Frame) -> tuple[Frame, jax.Array | None]:
    """The frame with demodulated radiance, and what it was divided by."""
    if frame.albedo is None:
        return frame, None
    divisor = jnp.where(frame.albedo > SMALLEST_ALBEDO, frame.albedo, 1.0)
    return frame._replace(radiance=jnp.minimum(frame.radiance / divisor, RADIANCE_MAX)), divisor
