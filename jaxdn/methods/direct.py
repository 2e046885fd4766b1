"""Networks that predict the image itself: the light they see, and the image that they say.

The network sees compressed light at one brightness and predicts compressed light, so that its errors count as an eye
counts them, and no light is too bright for it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Params
from jaxdn.filters.surface_test import surface_mask
from jaxdn.networks import crop, pad
from jaxdn.ops.scales import fill_holes


class Light(NamedTuple):
    """What a network sees of a frame's light."""

    compressed: jax.Array
    """[H, W, 3] padded."""
    gain: jax.Array | float
    """The factor of radiance before it was compressed."""
    hit: jax.Array | None
    """[H, W] bool, the pixels whose image is predicted; None: all."""


def seen(frame: Frame, *, background: str, exposure: str, multiple: int) -> Light:
    """The light of a frame, its sides multiples of ``multiple``, which is a multiple of 4.

    With ``background="pass"`` pixels without a surface hold the light of surfaces next to them, and are not predicted;
    with ``exposure="measured"`` light has the same brightness in each frame (:func:`jaxdn.color.exposure`).
    """
    # Divided by a small albedo it may be beyond what the network has ever seen.
    noisy = pad(jnp.minimum(frame.radiance, RADIANCE_MAX), multiple)
    hit = surface_mask(frame.depth, None) if background == "pass" else None
    if hit is not None:
        noisy = fill_holes(noisy, pad(hit[..., None], multiple))
    gain = color.exposure(noisy) if exposure == "measured" else 1.0
    return Light(color.compress(gain * noisy), gain, hit)


def image_of(output: jax.Array, light: Light, frame: Frame) -> jax.Array:
    """The image [H, W, 3] that a network's output [h, w, 3] says."""
    image = crop(color.expand(output) / light.gain, frame.radiance.shape[:2])
    image = jnp.clip(image, 0.0, RADIANCE_MAX)
    return image if light.hit is None else jnp.where(light.hit[..., None], image, frame.radiance)


def beginning_grey(params: Params, head: str) -> Params:
    """The params with a middle grey as the bias of the head: below 0 the image is black and nothing is learnt."""
    return {**params, head: {**params[head], "bias": color.compress(jnp.full((3,), 0.18, jnp.float32))}}
