"""What is told of the surfaces that camera rays meet first, and its sums over the samples of filtered pixels.

As in other renderers, the guides of a filtered pixel are means over the samples of its radiance, taken at the very same
points: at edges, and wherever the first hit is random (a lens, motion blur, fog), they are as noisy as that.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.tracing.light_samples import evaluate_diffuse_reflectance
from jaxdn.render.tracing.volume_path_tracer import find_first_vertex, find_one_first_vertex, scatters


class AveragesReflectance(Protocol):
    """:class:`jaxdn.render.buffers.reflectance.Reflectances`."""

    def average_pixels(self, hit: Any, bsdf: Any, active: Any, albedo: Any) -> tuple[Any, Any]:
        """The share of uniform light that all hits reflect, and its specular part."""
        ...

    def average_one(self, hit: Any, bsdf: Any, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same of one hit, for the variant without vectorisation."""
        ...


class SurfaceRequest(NamedTuple):
    """The guides that are wanted of samples."""

    reflectances: AveragesReflectance | None = None
    """None: without reflectance and its specular part."""


class SurfaceSums(NamedTuple):
    """Sums over samples, float64, the pixels' axes in front; see :class:`jaxdn.Frame`."""

    albedo: np.ndarray
    """[..., 3]."""
    normal: np.ndarray
    """[..., 3] of unit normals: shorter than 1 for a mean of different ones."""
    roughness: np.ndarray
    """[..., 1]."""
    reflectance: np.ndarray | None = None
    """[..., 3]."""
    specular_reflectance: np.ndarray | None = None
    """[..., 3]."""

    def plus(self, other: "SurfaceSums") -> "SurfaceSums":
        """The sums over both sets of samples."""
        return self.change(lambda mine, theirs: mine + theirs, other)

    def change(self, function: Callable[..., np.ndarray], *others: "SurfaceSums") -> "SurfaceSums":
        """A function of every part, and of the same part of others."""
        parts: Any = (None if part[0] is None else function(*part) for part in zip(self, *others, strict=True))
        return SurfaceSums(*parts)


def make_zero_surfaces(shape: tuple[int, ...], request: SurfaceRequest) -> SurfaceSums:
    """The sums over no samples."""
    light = [np.zeros((*shape, 3)) for _ in range(4)]
    whole = (None, None) if request.reflectances is None else (light[2], light[3])
    return SurfaceSums(light[0], light[1], np.zeros((*shape, 1)), *whole)


def evaluate_roughness(bsdf: Any, hit: Any, active: Any) -> Any:
    """The linear roughness of every hit: 1 diffuse, 0 perfectly specular."""
    roughness = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth), mi.Float(1.0), 0.0)
    there = active & bsdf.has_attribute("alpha", active)
    roughness = dr.select(there, dr.sqrt(dr.maximum(bsdf.eval_attribute_1("alpha", hit, there), 0.0)), roughness)
    there = active & bsdf.has_attribute("roughness", active)
    return dr.select(there, bsdf.eval_attribute_1("roughness", hit, there), roughness)


def evaluate_surfaces(scene: Any, ray: Any, request: SurfaceRequest, numbers: Callable[[], Any]) -> list[Any]:
    """The parts of :class:`SurfaceSums` for every ray, three channels each but for the roughness, not evaluated yet.

    Where a ray meets nothing the albedo is white, the normal 0 and the roughness 1, as in a G-buffer. Where a medium
    scatters it first, the albedo is the medium's and the normal points to the camera, as in Cycles. ``numbers`` makes
    the generator that the paths begin with.
    """
    foggy, fog = scatters(scene), mi.Spectrum(0.0)
    scattered: Any = mi.Bool(False)
    if foggy:
        ray, scattered, fog = find_first_vertex(scene, ray, numbers())
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    valid = hit.is_valid() & ~scattered
    bsdf = hit.bsdf(ray)
    albedo = evaluate_diffuse_reflectance(bsdf, hit, valid)
    normal = dr.select(dr.dot(hit.sh_frame.n, ray.d) > 0, -hit.sh_frame.n, hit.sh_frame.n)
    parts = [
        dr.select(valid, _bound(albedo, 0.0), mi.Color3f(1.0)),
        dr.select(valid, normal, mi.Normal3f(0.0)),
        dr.select(valid, _bound(evaluate_roughness(bsdf, hit, valid), 1.0), 1.0),
    ]
    if request.reflectances is not None:
        whole, specular = request.reflectances.average_pixels(hit, bsdf, valid, albedo)
        known = valid & dr.all(dr.isfinite(whole))
        reflected = dr.select(known, dr.clip(whole, 0.0, 1.0), parts[0])
        shine = dr.select(known & dr.all(dr.isfinite(specular)), dr.maximum(specular, 0.0), mi.Color3f(0.0))
        parts += [reflected, dr.minimum(shine, reflected)]
    if foggy:
        own = [mi.Color3f(_bound(fog, 0.0)), mi.Normal3f(-ray.d), mi.Float(1.0), mi.Color3f(_bound(fog, 0.0))]
        own.append(mi.Color3f(0.0))
        parts = [dr.select(scattered, mine, part) for mine, part in zip(own, parts, strict=False)]
    return parts


def _bound(values: Any, unknown: float) -> Any:
    """Values in [0, 1]; ``unknown`` for those that are not a number."""
    return dr.select(dr.isfinite(values), dr.clip(values, 0.0, 1.0), unknown)


def read_surface(hit: Any) -> tuple[np.ndarray, float]:
    """Albedo and roughness of one hit, for the variant without vectorisation; not bounded."""
    bsdf = hit.bsdf()
    if bsdf is None:
        return np.zeros(3), 1.0
    flags = int(bsdf.flags())
    albedo = np.zeros(3)
    if flags & int(mi.BSDFFlags.Diffuse):
        albedo = np.array(bsdf.eval_diffuse_reflectance(hit), np.float64)
        for part in ("metallic", "spec_trans"):
            if bsdf.has_attribute(part):
                albedo = albedo * (1.0 - bsdf.eval_attribute_1(part, hit))
    if bsdf.has_attribute("roughness"):
        return albedo, bsdf.eval_attribute_1("roughness", hit)
    if bsdf.has_attribute("alpha"):
        return albedo, max(bsdf.eval_attribute_1("alpha", hit), 0.0) ** 0.5
    return albedo, 1.0 if flags & int(mi.BSDFFlags.Smooth) else 0.0


def read_guides(scene: Any, ray: Any, request: SurfaceRequest, seed: int) -> SurfaceSums:
    """The guides of one sample, as :func:`evaluate_surfaces` does; ``seed`` decides where media scatter it."""
    fog = None
    if scatters(scene):
        ray, hit, fog = find_one_first_vertex(scene, ray, seed)
    else:
        hit = scene.ray_intersect(ray)
    if fog is not None:
        whole = (None, None) if request.reflectances is None else (np.clip(fog, 0.0, 1.0), np.zeros(3))
        return SurfaceSums(np.clip(fog, 0.0, 1.0), -np.array(ray.d, np.float64), np.ones(1), *whole)
    if not hit.is_valid():
        missed = (None, None) if request.reflectances is None else (np.ones(3), np.zeros(3))
        return SurfaceSums(np.ones(3), np.zeros(3), np.ones(1), *missed)
    albedo, roughness = read_surface(hit)
    bounded = np.clip(np.nan_to_num(albedo), 0.0, 1.0)
    normal = np.array(hit.sh_frame.n, np.float64)
    normal = -normal if normal @ np.array(ray.d, np.float64) > 0 else normal
    rough = np.clip(np.nan_to_num([roughness], nan=1.0), 0.0, 1.0)
    if request.reflectances is None:
        return SurfaceSums(bounded, normal, rough)
    share, specular = request.reflectances.average_one(hit, hit.bsdf(), albedo)
    known = bool(np.all(np.isfinite(share)))
    reflected = np.clip(share, 0.0, 1.0) if known else bounded
    shine = np.maximum(specular, 0.0) if known and np.all(np.isfinite(specular)) else np.zeros(3)
    return SurfaceSums(bounded, normal, rough, reflected, np.minimum(shine, reflected))
