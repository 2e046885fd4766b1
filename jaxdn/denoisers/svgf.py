"""Spatiotemporal variance-guided filtering (Schied et al. 2017), the reference point of real-time denoising.

Each frame: divide by the albedo, fetch the history with every tap tested, blend colour and the moments of luminance
into it, estimate the variance per pixel (from time, or from a 7x7 neighbourhood while the history is short), then five
a-trous levels whose reach over luminance edges is set by that variance, and multiply by the albedo again.

What is carried on as colour history is the image after the first level (``feedback_level``), demodulated, not the image
shown: feeding the whole cascade back would blur more with every frame. This is the algorithm's own rule and the one
difference from the learned denoisers here, which carry the image they show.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.checks import check_image
from jaxdn.denoisers.atrous import B3_SPLINE, blur_variance, edge_average, edges_of, stencil
from jaxdn.denoisers.reprojection import cosine, depth_slopes, pack_guides, reproject
from jaxdn.frame import RADIANCE_MAX, Denoiser, Frame, only, repair

READS = frozenset({"radiance", "albedo", "normal", "depth", "previous_depth", "motion", "ids"})
_LUMINANCE = (0.2126, 0.7152, 0.0722)


class SvgfState(NamedTuple):
    """What one frame leaves to the next."""

    history: jax.Array
    """[H, W, 6] demodulated colour, first and second moment of its luminance, history length in frames."""
    guides: jax.Array
    """[H, W, 0..5] depth, normal and ids of the previous frame, those that the frames have."""
    age: jax.Array
    """int32, frames seen; at 0 nothing above is used."""
    repaired: jax.Array
    """int32, values replaced so far because they were not usable numbers."""


def svgf(
    *,
    alpha: float = 0.2,
    alpha_moments: float = 0.2,
    sigma_depth: float = 1.0,
    sigma_normal: float = 128.0,
    sigma_luminance: float = 4.0,
    levels: int = 5,
    feedback_level: int = 1,
    history_max: int = 32,
    short_history: int = 4,
    depth_tolerance: float = 0.02,
    normal_threshold: float = 0.9,
    demodulate: bool = True,
) -> Denoiser:
    """SVGF as a :class:`Denoiser` without weights (``params`` is ``{}``).

    ``alpha`` and ``alpha_moments`` are the least shares of the new frame in colour and moments, ``max(alpha, 1/N)`` at
    history length N <= ``history_max``. A tap of the history counts where ids agree, ``|z - z_expected| <=
    depth_tolerance * z_expected + 2 (|dz/dx| + |dz/dy|)`` and the cosine of the normals exceeds ``normal_threshold``.
    Where N < ``short_history`` the variance is that of the 7x7 neighbourhood times short_history / N.
    ``feedback_level`` 0 feeds back what time alone has blended. ``demodulate=False`` filters radiance as it is.

    Reads albedo, normal, depth, previous_depth, motion and ids; a buffer that is ``None`` takes its test or weight with
    it. Pixels without a surface (depth at ``FAR`` or id -1) pass through. Raises ValueError for options out of range
    and radiance that is not [H, W, 3].
    """
    for name, value in (("alpha", alpha), ("alpha_moments", alpha_moments)):
        if not 0 < value <= 1:
            raise ValueError(f"svgf {name}: expected a number in (0, 1], got {value!r}; 0.2 is the usual one.")
    for name, value in (("sigma_depth", sigma_depth), ("sigma_luminance", sigma_luminance)):
        if not value > 0:
            raise ValueError(f"svgf {name}: expected a number > 0, got {value!r}.")
    if not sigma_normal >= 0:
        raise ValueError(f"svgf sigma_normal: expected a number >= 0, got {sigma_normal!r}.")
    if not (isinstance(levels, int) and 0 <= levels <= 10):
        raise ValueError(f"svgf levels: expected a whole number from 0 to 10, got {levels!r}.")
    if not (isinstance(feedback_level, int) and 0 <= feedback_level <= levels):
        raise ValueError(
            f"svgf feedback_level: expected a whole number from 0 to levels ({levels}), got {feedback_level!r}."
        )
    for name, value in (("history_max", history_max), ("short_history", short_history)):
        if not value >= 1:
            raise ValueError(f"svgf {name}: expected at least 1 frame, got {value!r}.")

    taps = stencil(2, kernel=B3_SPLINE)

    def init(key: jax.Array, frame: Frame) -> dict[str, Any]:
        del key, frame
        return {}

    def start(params: Any, frame: Frame) -> SvgfState:
        del params
        check_image(frame.radiance, "radiance", channels=3)
        frame, _ = repair(only(frame, READS))
        guides, _ = pack_guides(frame.depth, frame.normal, frame.ids, frame.radiance)
        height, width, _ = frame.radiance.shape
        zero = jnp.zeros((), jnp.int32)
        return SvgfState(jnp.zeros((height, width, 6), guides.dtype), jnp.zeros_like(guides), zero, zero)

    def step(params: Any, state: SvgfState, frame: Frame) -> tuple[SvgfState, jax.Array]:
        del params
        frame, bad = repair(only(frame, READS))
        albedo = frame.albedo if demodulate else None
        divisor = None if albedo is None else jnp.where(albedo > 0.01, albedo, 1.0)
        incident = frame.radiance if divisor is None else frame.radiance / divisor
        history, guides, broken = _accumulate(state, frame, incident)
        edges = edges_of(frame.depth, frame.normal, frame.ids)

        color, variance = _variance(history, edges)
        feedback = color if feedback_level else history[:3]

        def filter_level(carry, level):
            color, variance, feedback = carry
            scale = sigma_luminance * jnp.sqrt(jnp.maximum(blur_variance(variance), 1e-10)) + 1e-4
            color, variance = edge_average(
                color,
                edges,
                taps,
                step=2**level,
                step_max=2 ** (levels - 1),
                variance=variance,
                luminance=(_luminance(color), 1.0 / scale),
                sigma_depth=sigma_depth,
                sigma_normal=sigma_normal,
            )
            return (color, variance, jnp.where(level + 1 == feedback_level, color, feedback)), None

        if levels:
            carry = (color, variance, feedback)
            (color, _, feedback), _ = lax.scan(filter_level, carry, jnp.arange(levels, dtype=jnp.int32))

        image = color.transpose(1, 2, 0)
        kept = jnp.concatenate([feedback, history[3:]]).transpose(1, 2, 0)
        if divisor is not None:
            image = image * divisor
        if edges.hit is not None:
            image = jnp.where(edges.hit[..., None], image, frame.radiance)
        repaired = state.repaired + bad + broken
        return SvgfState(kept, guides, state.age + 1, repaired), jnp.minimum(image, RADIANCE_MAX)

    def _accumulate(state: SvgfState, frame: Frame, incident: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Planar history [6, H, W] with this frame blended in, this frame's guides, and the count of broken pixels."""
        guides, place = pack_guides(frame.depth, frame.normal, frame.ids, incident)
        if frame.depth is not None:
            expected = (frame.depth if frame.previous_depth is None else frame.previous_depth)[..., 0]
            slope_x, slope_y = depth_slopes(frame.depth, frame.ids)
            tolerance = depth_tolerance * expected + 2 * (jnp.abs(slope_x) + jnp.abs(slope_y))

        def accept(tap: jax.Array) -> jax.Array:
            before = tap[..., 6:]
            accepted = jnp.broadcast_to(state.age > 0, before.shape[:2])
            if place.depth is not None:
                accepted &= jnp.abs(before[..., place.depth] - expected) <= tolerance
            if place.normal is not None:
                accepted &= cosine(before[..., place.normal], guides[..., place.normal]) > normal_threshold
            if place.ids is not None:
                accepted &= before[..., place.ids] == guides[..., place.ids]
            return accepted

        packed = jnp.concatenate([state.history, state.guides], axis=-1)
        past, valid = reproject(packed, frame.motion, accept)
        past = past[..., :6]
        sound = jnp.all(jnp.isfinite(past) & (past >= 0), axis=-1)
        broken = jnp.sum(valid & ~sound, dtype=jnp.int32)
        valid &= sound
        past = jnp.where(valid[..., None], past, 0.0).transpose(2, 0, 1)

        now = incident.transpose(2, 0, 1)
        level = _luminance(now)
        length = jnp.minimum(past[5] + 1.0, history_max)
        share = jnp.maximum(alpha, 1.0 / length)
        share_moments = jnp.maximum(alpha_moments, 1.0 / length)
        color = past[:3] + share[None] * (now - past[:3])
        moments = past[3:5] + share_moments[None] * (jnp.stack([level, level * level]) - past[3:5])
        return jnp.concatenate([color, moments, length[None]]), guides, broken

    def _variance(history: jax.Array, edges: Any) -> tuple[jax.Array, jax.Array]:
        """Colour [3, H, W] and the variance [H, W] of its luminance; spatial where the history is short."""
        color, moments, length = history[:3], history[3:5], history[5]
        variance = jnp.maximum(moments[1] - moments[0] ** 2, 0.0)
        short = length < short_history
        needed = short if edges.hit is None else short & edges.hit
        mean, _ = edge_average(
            history[:5], edges, stencil(3), needed=needed, sigma_depth=sigma_depth, sigma_normal=sigma_normal
        )
        spatial = jnp.maximum(mean[4] - mean[3] ** 2, 0.0) * (short_history / length)
        return jnp.where(needed[None], mean[:3], color), jnp.where(needed, spatial, variance)

    return Denoiser(init, start, step, READS)


def _luminance(planes: jax.Array) -> jax.Array:
    """Rec.709 luminance of planar colour [3, H, W]."""
    red, green, blue = _LUMINANCE
    return red * planes[0] + green * planes[1] + blue * planes[2]
