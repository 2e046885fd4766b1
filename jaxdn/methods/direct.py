"""Direct prediction: networks whose output is the image itself.

The network sees compressed light at one brightness and predicts compressed light, so that its errors count as an eye
counts them, and no light is too bright for it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Params
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.filters.surface_test import surface_mask
from jaxdn.ops.scales import crop, fill_holes, pad


class PreparedFrame(NamedTuple):
    """A frame, and what a network sees of its light."""

    frame: Frame
    light: jax.Array
    """[h, w, 3] padded, bounded."""
    hit: jax.Array | None
    """[H, W] bool, the pixels whose image is predicted; None: all."""


def prepare(frame: Frame, *, background: str, multiple: int) -> tuple[FrameStatistics, PreparedFrame]:
    """The light of a frame, its sides multiples of ``multiple``, which is a multiple of 4, and the frame's statistics.

    With ``background="pass"`` pixels without a surface hold the light of surfaces next to them, and are not predicted.
    """
    # Divided by a small albedo it may be beyond what the network has ever seen.
    noisy = pad(jnp.minimum(frame.radiance, RADIANCE_MAX), multiple)
    hit = surface_mask(frame.depth, None) if background == "pass" else None
    if hit is not None:
        noisy = fill_holes(noisy, pad(hit[..., None], multiple))
    return measure_frame(noisy, frame.depth, frame), PreparedFrame(frame, noisy, hit)


def choose_gain(exposure: str, statistics: FrameStatistics) -> jax.Array | float:
    """The factor of light before it is compressed: with ``"measured"`` light has the same brightness in each frame."""
    return statistics.exposure if exposure == "measured" else 1.0


def expand_output(output: jax.Array, prepared: PreparedFrame, gain: jax.Array | float) -> jax.Array:
    """The image [H, W, 3] of a network's output [h, w, 3], which is compressed light times ``gain``."""
    radiance, hit = prepared.frame.radiance, prepared.hit
    image = jnp.clip(crop(color.expand(output) / gain, radiance.shape[:2]), 0.0, RADIANCE_MAX)
    return image if hit is None else jnp.where(hit[..., None], image, radiance)


def init_grey(params: Params, head: str) -> Params:
    """The params with a middle grey as the bias of the head: below 0 the image is black and nothing is learnt."""
    return {**params, head: {**params[head], "bias": color.compress(jnp.full((3,), 0.18, jnp.float32))}}
