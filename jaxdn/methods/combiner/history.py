"""Running means along motion: of noisy light, of the prior's images and of the guides.

The mean of noisy light has no bias and much noise, the mean of the prior's images the reverse; albedo and normals of
thin focus, fog and hair, as noisy as the light, become clean. All follow the new frame with one share a pixel. The last
result is carried beside them, as it is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import Frame
from jaxdn.filters.resampling import find_whole
from jaxdn.filters.sharp_history import SharpHistory, fetch_sharply
from jaxdn.filters.surface_test import Guides, guides_of
from jaxdn.ops.scales import join_pixels, to_planes

COLORS = 15
"""Channels that are fetched by cubics."""
CHANNELS = COLORS + 3
_LEAST_COUNT = 1e-6


class CombinerState(NamedTuple):
    """What is carried from one frame to the next."""

    history: jax.Array
    """[H, W, 18] :class:`Means` as far as light, prior, albedo and normal (as (n + 1) / 2); the result; the mean's
    square, its effective number of samples; 1 where all 3x3 pixels showed one surface, else 0."""
    guides: Guides
    """Of the previous frame, as far as they test which surface it showed."""


class Means(NamedTuple):
    """Planes [C, H, W]."""

    light: jax.Array
    """[3, H, W] of noisy light."""
    prior: jax.Array
    """[3, H, W] of the prior's images."""
    albedo: jax.Array
    """[3, H, W]."""
    normal: jax.Array
    """[3, H, W]; its length is below 1 where normals differ."""
    square: jax.Array
    """[H, W] of the noisy luminance's square."""
    number: jax.Array
    """[H, W] effective number of samples, in frames."""


class Past(NamedTuple):
    """Of earlier frames, where it is now; the new frame's own where there is none."""

    means: Means
    result: jax.Array
    """[3, H, W] the last image; the new prior where there is no history."""
    valid: jax.Array
    """[H, W] bool, there is a history."""
    invalid: jax.Array
    """How many pixels of it were not finite or negative."""


def tested_guides(frame: Frame) -> Guides:
    """The guides of a frame that tell surfaces apart. Normals do not: bumps and hair have other ones in every pixel."""
    return guides_of(frame._replace(normal=None))


def start_history(frame: Frame) -> CombinerState:
    """The state before the first frame."""
    nothing = jnp.zeros((*frame.radiance.shape[:2], CHANNELS), frame.radiance.dtype)
    return CombinerState(nothing, jax.tree.map(jnp.zeros_like, tested_guides(frame)))


def measure_now(frame: Frame, prior: jax.Array) -> Means:
    """The means of the new frame alone; ``prior`` [3, H, W]."""
    light = to_planes(frame.radiance)
    albedo = jnp.ones_like(light) if frame.albedo is None else to_planes(frame.albedo)
    normal = jnp.zeros_like(light) if frame.normal is None else to_planes(frame.normal)
    level = color.luminance_of_planes(light)
    return Means(light, prior, albedo, normal, level * level, jnp.ones_like(level))


def fetch_past(state: CombinerState, frame: Frame, now: Means, first: jax.Array) -> Past:
    """The history of every pixel, where it is now."""
    plain = frame._replace(normal=None)
    found: SharpHistory = fetch_sharply(state.history, state.guides, plain, first, colors=COLORS)
    values, valid = to_planes(found.values), found.valid
    light, prior, albedo, normal, result = jnp.split(values[:COLORS], 5)
    means = Means(light, prior, albedo, 2.0 * normal - 1.0, *values[COLORS:-1])
    means = jax.tree.map(lambda then, new: jnp.where(jnp.broadcast_to(valid, new.shape), then, new), means, now)
    return Past(means, jnp.where(valid, jnp.maximum(result, 0.0), now.prior), valid, found.invalid)


def update_means(now: Means, past: Past, follow: jax.Array, *, most: float) -> Means:
    """The means with the new frame in them.

    In the mean of N frames and a new one, the new one has the weight 1 / (N + 1); ``follow`` [H, W] = 1/2 keeps that,
    and its logit is added to that of the weight. With weights 1 - a and a, the variance is ``(1 - a)^2 / N + a^2`` of a
    frame's: the effective number is its inverse, but at most ``most``.
    """
    count = jnp.maximum(past.means.number, _LEAST_COUNT)
    share = jnp.where(past.valid, follow / (follow + count * (1.0 - follow)), 1.0)

    def mix(then: jax.Array, new: jax.Array) -> jax.Array:
        return then + jnp.broadcast_to(share, new.shape) * (new - then)

    mixed = jax.tree.map(mix, past.means, now)
    variance = jnp.square(1.0 - share) / count + share**2
    return mixed._replace(number=jnp.where(past.valid, jnp.minimum(1.0 / variance, most), 1.0))


def keep_history(frame: Frame, means: Means, result: jax.Array) -> CombinerState:
    """The next frame's state; ``result`` [3, H, W] >= 0 is this frame's image."""
    normal = jnp.clip(0.5 * (means.normal + 1.0), 0.0, 1.0)
    colors = [jnp.maximum(each, 0.0) for each in (means.light, means.prior, means.albedo)]
    whole = find_whole(frame._replace(normal=None)).astype(normal.dtype)
    rest = [plane[None] for plane in (jnp.maximum(means.square, 0.0), means.number, whole)]
    history = join_pixels([("planes", planes) for planes in (*colors, normal, result, *rest)])
    return CombinerState(history, tested_guides(frame))
