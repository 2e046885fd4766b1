"""Additive parts of an image (diffuse and specular light, light groups), denoised so that they still add up to it.

Whatever a denoiser made of the beauty, each part gets its share of it:

    part_i' = E(part_i) * beauty' / E(beauty),

per pixel and colour, where ``E`` is a filter whose weights do not depend on the parts: surfaces seen in the frame,
their motion, and edges of the denoised beauty'. ``E`` is therefore linear in the light: parts that add up to the beauty
before do so afterwards, to rounding, for every set of parts at once, without knowing which of them belong together.
It is not the denoiser's own kernel: where the denoiser divides by albedos, clamps and predicts weights from the light,
there is no one kernel to apply to a part.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.frame import Frame
from jaxdn.denoiser.sanitize import sanitize
from jaxdn.filters.atrous import B3_SPLINE, edge_average, stencil
from jaxdn.filters.edge_stopping import Planes, TapOffset, Weight, depth_weight, normal_weight
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, guides_of, surface_mask

_TAPS = stencil(2, kernel=B3_SPLINE)
_LEVELS = 4
_ALPHA = 0.1
"""Smallest weight of a new frame in the history."""
_DEPTH_TOLERANCE, _SIGMA_DEPTH = 0.02, 1.0
_NORMAL_THRESHOLD, _SIGMA_NORMAL = 0.9, 64.0
_EDGE = 0.2
"""Relative difference of the denoised beauty's colours that counts as an edge."""
_DARK = 1e-6
"""Where the filtered beauty is below this, a part keeps the share that it has of all colours together."""


class DecompositionState(NamedTuple):
    """What is carried from one frame to the next."""

    history: jax.Array
    """[H, W, 3 n + 4] the light of n parts and of the beauty, and the number of frames in it."""
    guides: Guides


def init_decomposition(frame: Frame, count: int) -> DecompositionState:
    """No history, for ``count`` layers."""
    nothing = jnp.zeros((*frame.radiance.shape[:2], 3 * count + 4), jnp.float32)
    return DecompositionState(nothing, jax.tree.map(jnp.zeros_like, guides_of(sanitize(frame)[0])))


def add_layers(state: DecompositionState, count: int) -> DecompositionState:
    """The state for ``count`` layers, of which those that are new have been black so far."""
    old = state.history.shape[-1] - 4
    black = jnp.zeros((*state.history.shape[:2], 3 * count - old), state.history.dtype)
    if not black.size:
        return state
    history = jnp.concatenate([state.history[..., :old], black, state.history[..., old:]], axis=-1)
    return state._replace(history=history)


@jax.jit
def decompose(
    state: DecompositionState, frame: Frame, beauty: jax.Array, layers: jax.Array
) -> tuple[DecompositionState, jax.Array]:
    """The additive layers [n, H, W, 3] of a denoised beauty [H, W, 3].

    Args:
      state: after the frame before; :func:`init_decomposition` before the first.
      frame: the noisy frame; its radiance is what the layers are parts of, of about the brightness of a photograph
        (:mod:`jaxdn.sequence.light_range`). Values that are not finite count as 0.
      beauty: the denoised radiance.
      layers: [n, H, W, 3] noisy.
    """
    light, layers = (_finite(image) for image in (frame.radiance, layers))
    frame = sanitize(frame)[0]
    noisy = jnp.concatenate([*layers, light], axis=-1)
    blended = blend_history(state.history, state.guides, frame, noisy)
    hit = surface_mask(frame.depth, frame.ids)
    filtered = filter_edges(frame, beauty, blended[..., :-1], hit)
    if hit is not None:  # what has no surface is not filtered
        filtered = jnp.where(hit[..., None], filtered, noisy)
    total = filtered[..., -3:]
    dark = jnp.abs(total) <= _DARK
    grey_total = jnp.sum(total, axis=-1, keepdims=True)

    def share(layer: jax.Array) -> jax.Array:
        grey = jnp.sum(layer, axis=-1, keepdims=True) / jnp.where(grey_total != 0, grey_total, 1.0)
        return beauty * jnp.where(dark, grey, layer / jnp.where(dark, 1.0, total))

    images = jnp.stack([share(filtered[..., 3 * i : 3 * i + 3]) for i in range(layers.shape[0])])
    return DecompositionState(blended, guides_of(frame)), images


def _finite(light: jax.Array) -> jax.Array:
    """Without limits, and negative where it is: clamped parts would not add up to the clamped whole."""
    return jnp.where(jnp.isfinite(light), light, 0.0).astype(jnp.float32)


def blend_history(history: jax.Array, guides: Guides, frame: Frame, noisy: jax.Array) -> jax.Array:
    """The history [H, W, C + 1] with a frame's light [H, W, C] blended in: a mean over the frames that saw a point.

    Its last channel is the number of those frames; ``guides`` are those of the frame before.
    """
    past = reproject(
        history,
        guides,
        frame,
        jnp.asarray(False),
        depth_tolerance=_DEPTH_TOLERANCE,
        normal_threshold=_NORMAL_THRESHOLD,
        search_neighbours=True,
    ).history
    length = past[..., -1:] + 1
    weight = jnp.maximum(_ALPHA, 1 / length)
    return jnp.concatenate([past[..., :-1] + weight * (noisy - past[..., :-1]), length], axis=-1)


def filter_edges(
    frame: Frame, beauty: jax.Array, light: jax.Array, hit: jax.Array | None, more: Sequence[Weight] = ()
) -> jax.Array:
    """An a-trous cascade over [H, W, C], whose weights stop at surfaces and at edges of the denoised beauty.

    ``hit`` [H, W] bool: which pixels are filtered and taken; None: all. ``more`` are further weights.
    """
    weights = [_color_weight(beauty), *more]
    if frame.depth is not None:
        weights.append(depth_weight(frame.depth, frame.ids, sigma=_SIGMA_DEPTH, height=frame.depth.shape[0]))
    if frame.normal is not None:
        weights.append(normal_weight(frame.normal, sigma=_SIGMA_NORMAL))

    def level(planes: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
        return edge_average(planes, hit, weights, _TAPS, step=2**index, step_max=2 ** (_LEVELS - 1))[0], None

    planes, _ = lax.scan(level, light.transpose(2, 0, 1), jnp.arange(_LEVELS, dtype=jnp.int32))
    return planes.transpose(1, 2, 0)


def _color_weight(image: jax.Array) -> Weight:
    """``exp(-sum_c |i_c(p) - i_c(q)| / (_EDGE i_c(p) + 1e-4))`` of a noise-free image [H, W, 3]."""
    planes = jnp.maximum(image, 0.0).transpose(2, 0, 1)  # the ringing of a pixel filter is below 0
    here = jnp.concatenate([planes, 1.0 / (_EDGE * planes + 1e-4)])

    def exponent(there: Planes, here: Planes, offset: TapOffset) -> jax.Array:
        return sum((jnp.abs(there[c] - here[c]) * here[c + 3] for c in range(3)), start=jnp.zeros((), image.dtype))

    return Weight(planes, here, exponent)
