"""A history that keeps its sharpness: fetched by Catmull-Rom interpolation where all taps show one surface.

Elsewhere, where a tap may belong to another surface, it is the mean of the accepted bilinear taps
(:mod:`jaxdn.filters.reproject`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import Frame
from jaxdn.filters.catmull_rom import warp_cubic
from jaxdn.filters.reproject import reproject
from jaxdn.filters.resampling import find_beyond
from jaxdn.filters.surface_test import Guides

TAPS = 2
"""Radius in pixels of a cubic fetch."""
_WHOLE = 0.999
"""The mean of all accepted taps that are whole, rounded."""


class SharpHistory(NamedTuple):
    """The history where it is now."""

    values: jax.Array
    """[H, W, C], 0 where there is none."""
    valid: jax.Array
    """[H, W] bool, there is one."""
    whole: jax.Array
    """[H, W] bool, all of the nearest taps were whole."""
    cubic: jax.Array
    """[H, W] bool, it was fetched by cubics."""
    invalid: jax.Array
    """How many pixels of the history were not finite or negative."""


def fetch_sharply(history: jax.Array, before: Guides, frame: Frame, first: jax.Array, *, colors: int) -> SharpHistory:
    """Fetch ``history`` [H, W, C] >= 0 of the previous frame, whose last channel says which of its pixels are whole.

    A pixel is whole where all 3x3 pixels show one surface (:func:`jaxdn.filters.resampling.find_whole`): 1, else 0.
    Where the nearest four pixels are whole, all sixteen show one surface, and cubics need no test.

    Args:
      history: its first ``colors`` channels are fetched by cubics, the others by bilinear interpolation.
      before: the guides of the previous frame.
      frame: the current frame; no motion is zero motion.
      first: bool scalar, there is no history.
      colors: see above.
    """
    found = reproject(history, before, frame, first)
    values, valid = found.history, found.valid[..., 0]
    whole, cubic = values[..., -1] > _WHOLE, jnp.zeros_like(valid)
    if frame.motion is not None:
        sharp = warp_cubic(history, frame.motion, channels=colors)
        inside = find_beyond(jnp.where(jnp.isfinite(frame.motion), frame.motion, 0.0)) == 0
        cubic = valid & inside & whole & jnp.all(jnp.isfinite(sharp), axis=-1)
        light = jnp.where(cubic[..., None], sharp, values[..., :colors])
        values = jnp.concatenate([light, values[..., colors:]], axis=-1)
    return SharpHistory(values, valid, whole, cubic, found.invalid)
