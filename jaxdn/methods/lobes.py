"""Signals: diffuse and specular light, each divided by what its own lobes reflect, and their reprojected histories."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn import brdf
from jaxdn.core.frame import Frame
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, guides_of
from jaxdn.filters.virtual_motion import closeness_of, diffuseness, virtual_motion
from jaxdn.methods.demodulation import SMALLEST_ALBEDO, Demodulation, texture_of

READS = frozenset({
    *("albedo", "normal", "depth", "roughness", "motion", "previous_depth", "ids", "reflectance"),
    *("specular", "specular_reflectance", "specular_hit_distance", "ray_length", "far_motion"),
})  # fmt: skip
"""What light by lobes and its histories need."""
SAME_MIRROR = 0.98
"""Least cosine between the normals of one mirror at the two places of a virtual image."""
_ALIKE_ROUGHNESS, _ALIKE_CLOSENESS = 0.1, 0.2
"""Largest differences between a reflection and its history."""
_ENOUGH = 0.01
"""Least weight that counts as history."""


class DemodulatedLight(NamedTuple):
    """A signal's light, divided by what its lobes reflect."""

    light: jax.Array
    """[3, H, W]."""
    divisor: jax.Array | None
    """[3, H, W] what it was divided by; None: nothing."""
    texture: jax.Array | None = None
    """[3, H, W] what of its texture the division left (:func:`jaxdn.brdf.restore`); None: nothing."""

    def known_texture(self) -> jax.Array:
        """The texture [3, H, W]; 1 where the division left nothing."""
        return jnp.ones_like(self.light) if self.texture is None else self.texture

    def remodulate(self, filtered: jax.Array) -> jax.Array:
        """Filtered light as an image [H, W, 3]."""
        return (filtered if self.divisor is None else filtered * self.divisor).transpose(1, 2, 0)


def split_signals(
    frame: Frame, by: Demodulation, statistics: FrameStatistics
) -> tuple[DemodulatedLight, DemodulatedLight | None]:
    """Diffuse and specular light of a frame; without ``specular`` all light is diffuse.

    ``by`` is as in :func:`jaxdn.methods.demodulation.demodulated`: ``"brdf"`` divides specular light by
    ``specular_reflectance`` and the rest by the rest of the reflectance (by all of it where that buffer is absent),
    ``"albedo"`` diffuse light alone by the albedo.
    """
    rest, part = reflectances(frame)
    specular = None if frame.specular is None else jnp.minimum(frame.specular, frame.radiance)
    diffuse = frame.radiance if specular is None else frame.radiance - specular
    below: tuple[jax.Array | None, ...] = (None, None)
    left: tuple[jax.Array | None, ...] = (None, None)
    if by == "brdf":
        known = jnp.zeros_like(frame.radiance) if part is None else part
        below = None if rest is None else brdf.divisor(rest), brdf.divisor(known)
        left = (
            None if rest is None else texture_of(rest, frame, diffuse, statistics),
            None if part is None else brdf.texture_left(part, brdf.divisor(part)),
        )
    elif by == "albedo" and frame.albedo is not None:
        below = jnp.where(frame.albedo > SMALLEST_ALBEDO, frame.albedo, 1.0), None
    return _light(diffuse, below[0], left[0]), None if specular is None else _light(specular, below[1], left[1])


def reflectances(frame: Frame) -> tuple[jax.Array | None, jax.Array | None]:
    """What diffuse and what other lobes reflect, [H, W, 3]; None where that is not known."""
    whole, part = frame.albedo if frame.reflectance is None else frame.reflectance, frame.specular_reflectance
    rest = whole if part is None else jnp.maximum((1.0 if whole is None else whole) - part, 0.0)
    return rest, part


def _light(image: jax.Array, *of_surface: jax.Array | None) -> DemodulatedLight:
    divisor = of_surface[0]
    planar = (None if each is None else each.transpose(2, 0, 1) for each in of_surface)
    return DemodulatedLight((image if divisor is None else image / divisor).transpose(2, 0, 1), *planar)


class ReprojectedSignals(NamedTuple):
    """The histories of both signals, planar; 0 where there is none."""

    diffuse: jax.Array
    """[C, H, W]."""
    specular: jax.Array | None
    """[D, H, W]; its planes of history length are shortened where little of it fits."""
    closeness: jax.Array | None
    """[H, W] of the reflected thing, to be kept; 0 where it is unknown; None without hit distances."""
    invalid: jax.Array
    """How many pixels of the histories were not valid."""


def reproject_signals(
    diffuse: jax.Array,
    specular: jax.Array | None,
    before: Guides,
    frame: Frame,
    first: jax.Array,
    *,
    length_plane: int,
    depth_tolerance: float,
    normal_threshold: float,
) -> ReprojectedSignals:
    """The histories [H, W, C] of diffuse and of specular light, which follows its virtual image.

    The last two planes of ``specular`` are its closeness and the roughness of its surface. It is fetched along the
    surface's motion and along that of the virtual image (:func:`jaxdn.filters.virtual_motion.virtual_motion`). With the
    diffuseness d of the surface and the distance m of both targets in pixels, the first has the weight
    ``d + (1 - d) exp(-m^2)`` and the second ``(1 - d) (1 - exp(-m^2))``, each where it is valid; the second one is
    valid where roughness and closeness there are the same. The sum of both multiplies the history length, plane
    ``length_plane``.
    """
    packed = diffuse if specular is None else jnp.concatenate([diffuse, specular], axis=-1)
    surface = reproject(
        packed, before, frame, first, depth_tolerance=depth_tolerance, normal_threshold=normal_threshold
    )
    planes = surface.history.transpose(2, 0, 1)
    if specular is None:
        return ReprojectedSignals(planes, None, None, surface.invalid)
    channels = diffuse.shape[-1]
    past, valid = planes[channels:], surface.valid[..., 0]
    now = closeness_of(frame.specular_hit_distance, frame)
    near = None if now is None else _track_closeness(now, past, frame, length_plane)
    if near is None or frame.roughness is None or frame.far_motion is None or frame.motion is None:
        return ReprojectedSignals(planes[:channels], past, near, surface.invalid)

    # A constant, as motion is: where it is not finite, its gradient would not be either.
    target = lax.stop_gradient(virtual_motion(frame.motion, frame.far_motion, _stretch(frame), near))
    # A mirror's depth at the virtual image is that of another of its points.
    flat = Guides(None, before.normal, before.ids)
    found = reproject(specular, flat, frame._replace(motion=target), first, normal_threshold=SAME_MIRROR)
    virtual = found.history.transpose(2, 0, 1)
    alike = jnp.abs(virtual[-1] - frame.roughness[..., 0]) < _ALIKE_ROUGHNESS
    alike = alike & (jnp.abs(virtual[-2] - near) < _ALIKE_CLOSENESS) & found.valid[..., 0]
    distance = jnp.sum((target - frame.motion) ** 2, axis=-1)
    together = jnp.exp(-jnp.where(jnp.isfinite(distance), distance, 0.0))
    stays = diffuseness(frame.roughness[..., 0])
    shares = jnp.where(valid, stays + (1 - stays) * together, 0.0), jnp.where(alike, (1 - stays) * (1 - together), 0.0)
    total = shares[0] + shares[1]
    some = total > _ENOUGH
    mixed = (shares[0][None] * past + shares[1][None] * virtual) / jnp.where(some, total, 1.0)[None]
    mixed = jnp.where(some[None], mixed, 0.0)
    mixed = mixed.at[length_plane].multiply(jnp.minimum(total, 1.0))
    return ReprojectedSignals(planes[:channels], mixed, near, surface.invalid)


def _track_closeness(now: jax.Array, past: jax.Array, frame: Frame, length_plane: int) -> jax.Array:
    """[H, W] closeness with less noise: blended into its history, the less so the smoother the surface is."""
    rough = 1.0 if frame.roughness is None else diffuseness(frame.roughness[..., 0])
    share = jnp.maximum(1.0 / (1.0 + past[length_plane]), 1.0 - rough)
    before = past[-2]
    blended = jnp.where(before > 0, before + share * (now - before), now)
    return jnp.where(now > 0, blended, before)


def _stretch(frame: Frame) -> jax.Array | None:
    """[H, W] previous depth over depth."""
    if frame.depth is None or frame.previous_depth is None:
        return None
    depth = frame.depth[..., 0]
    return jnp.where(depth > 0, frame.previous_depth[..., 0] / jnp.where(depth > 0, depth, 1.0), 1.0)


def kept_closeness(closeness: jax.Array | None, frame: Frame) -> list[jax.Array]:
    """The last two planes of a specular history: closeness and roughness [H, W]."""
    shape, dtype = frame.radiance.shape[:2], frame.radiance.dtype
    near = jnp.zeros(shape, dtype) if closeness is None else closeness
    return [near, jnp.ones(shape, dtype) if frame.roughness is None else frame.roughness[..., 0]]


def previous_guides(frame: Frame) -> Guides:
    """Guides before the first frame."""
    return jax.tree.map(jnp.zeros_like, guides_of(frame))
