"""The light sample of a path's first hit: what it gives, what it would give without a shadow, and what stands between.

A tracer adds up light and forgets where it came from. As with lobes (:mod:`jaxdn.render.tracing.lobes`), the first hit
of every path is repeated with the same random numbers after the light has been traced.
"""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import compute_transmittance, find_medium_behind, list_media
from jaxdn.render.tracing.lobes import draw_bounce_numbers


class LightSample(NamedTuple):
    """One point of one light for every lane, as arrays of Mitsuba."""

    hit: Any
    """The first surface."""
    towards: Any
    """Direction, distance and point of the light."""
    whole: Any
    """Its light, reflected by all lobes without a shadow, weighted as in the tracer."""
    diffuse: Any
    """The part of it that diffuse lobes reflect."""
    blocker: Any
    """What stands between, if ``blocked``."""
    blocked: Any


class Shadows(NamedTuple):
    """Sums over samples, float64, the pixels' axes in front."""

    shadowed: np.ndarray
    """[..., 3] light straight from sampled points of lights, by diffuse reflection."""
    unshadowed: np.ndarray
    """[..., 3] the same if nothing stood between."""

    def plus(self, other: "Shadows") -> "Shadows":
        """The sums over both sets of samples."""
        return Shadows(*(mine + theirs for mine, theirs in zip(self, other, strict=True)))


def make_zero_shadows(shape: tuple[int, ...]) -> Shadows:
    """The sums over no samples."""
    return Shadows(*np.zeros((2, *shape, 3)))


def evaluate_diffuse_reflectance(bsdf: Any, hit: Any, active: Any) -> Any:
    """Evaluate the reflectance of the diffuse lobe of every hit; 0 for surfaces that have none."""
    diffuse = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    albedo = dr.select(diffuse, mi.Color3f(bsdf.eval_diffuse_reflectance(hit, diffuse)), 0.0)
    # "principled" reports its base colour even for pure metal or glass.
    for part in ("metallic", "spec_trans"):
        there = diffuse & bsdf.has_attribute(part, diffuse)
        albedo *= 1.0 - dr.select(there, bsdf.eval_attribute_1(part, hit, there), 0.0)
    return albedo


def sample_light(scene: Any, ray: Any, numbers: Any) -> LightSample:
    """Sample a light as a path does at its first hit; ``numbers`` is the generator that the path began with.

    The diffuse part is that of a Lambertian lobe, ``albedo cos / pi``, at most the whole; all of it where the material
    has no other lobe.
    """
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    bsdf = hit.bsdf(ray)
    active = hit.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    pick, _, _ = draw_bounce_numbers(numbers)
    towards, radiance = scene.sample_emitter_direction(hit, pick, False, active)
    active &= towards.pdf != 0.0
    onward = hit.to_local(towards.d)
    reflected, bsdf_pdf = bsdf.eval_pdf(mi.BSDFContext(), hit, onward, active)
    weight = dr.select(towards.delta, 1.0, towards.pdf / (towards.pdf + bsdf_pdf))
    whole = dr.select(active, reflected * radiance * weight, 0.0)
    if list_media(scene):
        medium = mi.MediumPtr(scene.sensors()[0].get_medium())
        whole *= compute_transmittance(medium, hit.t, active)
        whole *= compute_transmittance(find_medium_behind(hit, medium, towards.d), towards.dist, active)
    lambert = evaluate_diffuse_reflectance(bsdf, hit, active) * dr.abs(onward.z) / dr.pi
    share = dr.select(reflected > lambert, lambert / reflected, 1.0)
    glossy = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
    diffuse = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse), whole, 0.0)
    diffuse = dr.select(glossy, diffuse * share, diffuse)
    lit = active & (dr.max(whole) > 0)
    between = hit.spawn_ray_to(towards.p)
    blocker = scene.ray_intersect(between, ray_flags=mi.RayFlags.Minimal, coherent=False, active=lit)
    return LightSample(hit, towards, whole, diffuse, blocker, lit & blocker.is_valid())


def sum_shadows(sample: LightSample, finite: Any, count: int) -> Shadows:
    """The sums over blocks of ``count`` lanes, flat; samples that are not ``finite`` do not count."""
    light = dr.select(finite & dr.all(sample.diffuse < dr.inf), sample.diffuse, 0.0)
    parts = [dr.select(sample.blocked, 0.0, light), light]
    # Evaluated together and before the sums, as in the tracer.
    dr.eval(parts)
    sums = [[dr.block_sum(part[channel], count) for channel in range(3)] for part in parts]
    dr.eval(sums)
    return Shadows(*(np.stack([np.array(plane, np.float64) for plane in part], axis=-1) for part in sums))
