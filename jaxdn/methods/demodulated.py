"""Demodulation: a wrapper that makes any denoiser filter radiance divided by the albedo."""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn.checks import check_option
from jaxdn.denoiser import Core, Denoiser, Params, Ritual, State, recurrent
from jaxdn.frame import RADIANCE_MAX, Frame

SMALLEST_ALBEDO = 0.01
"""Radiance is not divided by an albedo below this."""

Demodulation = Literal["albedo", "none"]


def demodulated(denoiser: Denoiser, *, by: Demodulation = "albedo") -> Denoiser:
    """The denoiser applied to radiance divided by the albedo, with its image multiplied by the same albedo.

    Textures are thus removed before filtering and cannot be blurred. The state, including the history, is demodulated
    too. ``by="none"`` returns the denoiser unchanged; frames without albedo are not divided. The parameters are those
    of the denoiser. Raises ValueError for another ``by``, and for a denoiser that :func:`jaxdn.denoiser.recurrent` did
    not make, because invalid values have to be repaired before the division.
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

    requests = None if core.samples is None else samples
    return recurrent(Core(start, step, core.reads | {"albedo"}, core.init, requests))


def _divided(frame: Frame) -> tuple[Frame, jax.Array | None]:
    """The frame with demodulated radiance, and the divisor."""
    if frame.albedo is None:
        return frame, None
    divisor = jnp.where(frame.albedo > SMALLEST_ALBEDO, frame.albedo, 1.0)
    return frame._replace(radiance=jnp.minimum(frame.radiance / divisor, RADIANCE_MAX)), divisor
