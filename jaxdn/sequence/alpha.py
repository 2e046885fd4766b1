"""Alpha, denoised as the beauty is (``jaxdn denoise --alpha``), so that premultiplied light stays consistent.

Alpha is an average over the same samples as the beauty, and as noisy where it is neither 0 nor 1: in smoke, hair,
motion blur and depth of field. It is a linear part of the image as a light layer is, so it takes the filter ``E`` of
:mod:`jaxdn.sequence.aov_decomposition`, whose weights come from the denoised beauty, surfaces and motion:

    a' = E(a).

One weight is added. Of n samples, alpha has the variance ``m (1 - m) / n`` around its mean m: none at 0 and 1. Pixels
whose means over the frames and 3x3 pixels differ by more than a part of ``sqrt(m (1 - m))`` do not count, so that what
is opaque has no holes beside a soft edge. What is no noise comes back as it was, as for the beauty
(:mod:`jaxdn.sequence.james_stein`): the smooth edge of a sharp object is none.

Light is premultiplied: ``c = a s`` with the colour s of what is seen. A denoiser that draws light beyond an edge needs
alpha there, or s would be too bright. So with ``S``, the brightest ``E(c) / E(a)`` of the window around, per colour,

    a' >= max_c c'_c / S_c,    at most 1.

Where ``E(a)`` is 0 all around, light is additive (glows, flares) and alpha stays 0.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.denoiser.sanitize import sanitize
from jaxdn.filters.edge_stopping import Weight
from jaxdn.filters.surface_test import Guides, guides_of
from jaxdn.sequence.aov_decomposition import blend_history, filter_edges
from jaxdn.sequence.james_stein import keep_detail
from jaxdn.sequence.light_range import choose_exponent

_AROUND = 7
"""Pixels on each side in which the brightest colour is sought."""
_DEVIATIONS = 0.3
"""Difference of two means that counts as an edge, as a part of ``sqrt(m (1 - m))``."""
_LEAST = 0.005
"""The least such difference."""
_SOME = 1e-3
"""Alpha below this tells nothing of a colour."""

_keep_detail = jax.jit(keep_detail)


class AlphaState(NamedTuple):
    """What is carried from one frame to the next."""

    history: jax.Array
    """[H, W, 2] alpha, and the number of frames in it."""
    guides: Guides


class AlphaDenoiser:
    """Denoises the alpha of consecutive frames."""

    def __init__(self, *, safe: bool) -> None:
        """``safe``: what is no noise comes back as it was."""
        self._safe = safe
        self._state: AlphaState | None = None

    def denoise(self, alpha: np.ndarray, frame: Frame, image: np.ndarray) -> np.ndarray:
        """The alpha [H, W] of the next frame in [0, 1]; ``image`` [H, W, 3] is its denoised beauty."""
        exponent = choose_exponent(np.asarray(frame.radiance), None) or 0
        light, beauty = (np.ldexp(np.asarray(one, np.float32), exponent) for one in (frame.radiance, image))
        # Without what is not read, a step is compiled once for all denoisers.
        guides = Frame(light, depth=frame.depth, normal=frame.normal, ids=frame.ids, motion=frame.motion)
        noisy = np.asarray(alpha, np.float32)[..., None]
        state = init_alpha(guides) if self._state is None else self._state
        self._state, filtered, brightest = filter_alpha(state, guides, beauty, noisy)
        kept = _keep_detail(noisy, filtered) if self._safe else filtered
        return np.asarray(cover_light(kept, beauty, brightest))[..., 0]


def init_alpha(frame: Frame) -> AlphaState:
    """No history."""
    nothing = jnp.zeros((*frame.radiance.shape[:2], 2), jnp.float32)
    return AlphaState(nothing, jax.tree.map(jnp.zeros_like, guides_of(sanitize(frame)[0])))


@jax.jit
def filter_alpha(
    state: AlphaState, frame: Frame, beauty: jax.Array, alpha: jax.Array
) -> tuple[AlphaState, jax.Array, jax.Array]:
    """``E(a)`` [H, W, 1] over space and time, and the brightest colour [H, W, 3] around each pixel.

    The colour is 0 where there is no alpha around.

    Args:
      state: after the frame before; :func:`init_alpha` before the first.
      frame: its radiance is the noisy beauty.
      beauty: [H, W, 3] denoised, about as bright as a photograph.
      alpha: [H, W, 1] noisy; what is not finite counts as 0.
    """
    light = jnp.where(jnp.isfinite(frame.radiance), frame.radiance, 0.0)
    alpha = jnp.where(jnp.isfinite(alpha), alpha, 0.0)
    frame = sanitize(frame)[0]
    history = blend_history(state.history, state.guides, frame, alpha)
    # Smoke has no surface, so every pixel is filtered; the beauty of today has only the alpha of today.
    given = jnp.concatenate([history[..., :1], alpha, light], axis=-1)
    planes = filter_edges(frame, beauty, given, None, [_cover_weight(history[..., 0])])
    filtered, today, colored = planes[..., :1], planes[..., 1:2], planes[..., 2:]
    colour = jnp.where(today > _SOME, jnp.maximum(colored, 0.0) / jnp.maximum(today, _SOME), 0.0)
    side = 2 * _AROUND + 1
    brightest = jax.lax.reduce_window(colour, 0.0, jax.lax.max, (side, side, 1), (1, 1, 1), "SAME")
    return AlphaState(history, guides_of(frame)), filtered, brightest


def _cover_weight(alpha: jax.Array) -> Weight:
    """``exp(-|m(p) - m(q)| / (_DEVIATIONS sqrt(m(p) (1 - m(p))) + _LEAST))`` for means m of 3x3 pixels of [H, W]."""
    padded = jnp.pad(alpha, 1, mode="edge")
    height, width = alpha.shape
    shifted = [padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)]
    mean = jnp.clip(sum(shifted, start=jnp.zeros_like(alpha)) / 9, 0.0, 1.0)
    here = jnp.stack([mean, 1.0 / (_DEVIATIONS * jnp.sqrt(mean * (1 - mean)) + _LEAST)])
    return Weight(mean[None], here, lambda there, here, offset: jnp.abs(there[0] - here[0]) * here[1])


@jax.jit
def cover_light(alpha: jax.Array, beauty: jax.Array, brightest: jax.Array) -> jax.Array:
    """Alpha [H, W, 1] in [0, 1] under which no colour is brighter than the brightest [H, W, 3] around."""
    needed = jnp.where(brightest > 0, beauty / jnp.where(brightest > 0, brightest, 1.0), 0.0)
    return jnp.clip(jnp.maximum(alpha, jnp.max(needed, axis=-1, keepdims=True)), 0.0, 1.0)
