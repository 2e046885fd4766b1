"""Primary surface replacement: the surfaces seen in flat mirrors and through glass, in place of mirror and glass.

The guides of a mirror say nothing of what it shows: everything in it is blurred. But a camera ray can be followed: at
a surface with no lobes but perfectly specular ones it goes on along the stronger of reflection and transmission, until
it meets another surface. The surface there, mirrored back, is what the pixel shows.

For mirrors with the reflections M_1 ... M_k [4, 4] at their planes, in the order of the ray's hits, the image of a
point x is ``M_1 ... M_k x``: position, normal and depth of the guides are those of the image, which lies on the camera
ray and moves as the image does (:func:`jaxdn.render.buffers.geometry.compute_motion`). Albedo and reflectance are
multiplied by what the way there leaves of light.

Only images that lie where they are seen are taken: the last direction, mirrored back, has to be that of the camera ray.
A pane of glass and a flat mirror pass; a lens, a glass ball and a curved mirror keep their own guides, as do pixels
whose ray leaves the scene. What glass reflects besides, and what media absorb, is not in the guides.

Source: the idea is in the documentation of several denoisers, among them Open Image Denoise (albedo and normal of
perfectly specular surfaces); the images' motion follows from the mirrors'.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.plugins import list_materials

EVENTS = 8
"""Specular surfaces that a ray is followed through; a pane of glass has two."""
MIRRORS = 2
"""Mirrors among them."""
_SAME = float(np.cos(np.radians(0.5)))
"""Least cosine between the camera ray and the direction in which the image lies."""
_BENT = 0.02
"""How much the normal of a mirror may turn, in radians, over the length of the way."""
_LEAST = 0.05
"""Share of the light that is at least left on the way: of a black mirror, nothing is worth to be replaced."""


class ReplacedPixels(NamedTuple):
    """The pixels whose surface is seen in mirrors or through glass; flat arrays of n such pixels."""

    pixels: np.ndarray
    """[n] their positions in the flat image."""
    shapes: np.ndarray
    """[n] ids of the shapes that are seen."""
    first: np.ndarray
    """[n] ids of the shapes that were met first."""
    mirrors: np.ndarray
    """[n, k] ids of the mirrors in the order of the ray's hits, -1 for none."""
    planes: np.ndarray
    """[n, k, 4, 4] float64 the reflections at them, the identity for none."""


class ReplacedRays(NamedTuple):
    """Where the camera rays of all pixels end; flat arrays of n pixels."""

    ray: Any
    """Mitsuba's rays: their next hit is the surface that is seen; where nothing was passed, the camera rays."""
    replaced: np.ndarray
    """[n] bool, something was passed."""
    weight: np.ndarray
    """[n, 3] what is left of light."""
    first: np.ndarray
    """[n] uint32 number of the shape that was met first (:func:`jaxdn.render.buffers.gbuffer.number_shapes`)."""
    mirrors: np.ndarray
    """[n, MIRRORS] uint32 numbers of the mirrors' shapes, 0 for none."""
    planes: np.ndarray
    """[n, MIRRORS, 4, 4] float64 the reflections at them, the identity for none."""


def replace_primary_surfaces(scene: Any, camera: Any, number: Any) -> ReplacedRays | None:
    """Follow the camera rays of all pixels past specular surfaces; None in a scene without any.

    Args:
      scene: Mitsuba's.
      camera: rays, one lane for each pixel.
      number: function of a hit that numbers its shape.
    """
    if not any(bool(_is_specular(int(bsdf.flags()))) for bsdf in list_materials(scene)):
        return None
    lanes = dr.width(camera.d)
    ray, active = mi.Ray3f(camera), dr.full(mi.Bool, True, lanes)
    weight, length = dr.full(mi.Color3f, 1.0, lanes), dr.zeros(mi.Float, lanes)
    mirrors = np.zeros((lanes, MIRRORS), np.uint32)
    planes = np.tile(np.eye(4), (lanes, MIRRORS, 1, 1))
    count, passed = np.zeros(lanes, int), np.zeros(lanes, int)
    first, broken = np.zeros(lanes, np.uint32), np.zeros(lanes, bool)
    for event in range(EVENTS + 1):
        hit = scene.ray_intersect(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, coherent=event == 0, active=active)
        goes, onward, share, mirrored = _pass_surface(hit, hit.bsdf(ray), active)
        length = length + dr.select(goes, hit.t, 0.0)
        bent = length * dr.maximum(_compute_curvature(hit.dn_du, hit.dp_du), _compute_curvature(hit.dn_dv, hit.dp_dv))
        shape, missed, turns = number(hit), active & ~hit.is_valid(), mirrored & (bent > _BENT)
        weight = dr.select(goes, weight * share, weight)
        ray = dr.select(goes, hit.spawn_ray(hit.to_world(onward)), ray)
        dr.eval(ray, weight, length, goes, mirrored, shape, missed, turns, hit.p, hit.n)
        went, at_mirror = np.array(goes), np.array(mirrored)
        broken |= np.array(missed | turns) | (at_mirror & (count >= MIRRORS))
        at_mirror &= ~broken
        shapes = np.array(shape)
        first = np.where(passed == 0, shapes, first)
        lane = np.flatnonzero(at_mirror)
        mirrors[lane, count[lane]] = shapes[lane]
        planes[lane, count[lane]] = make_reflections(_to_numpy(hit.p)[lane], _to_numpy(hit.n)[lane])
        count += at_mirror
        passed += went
        if not went.any():
            break
        active = goes
    else:
        broken |= went
    direction = _to_numpy(ray.d)
    for index in reversed(range(MIRRORS)):
        direction = np.einsum("nij,nj->ni", planes[:, index, :3, :3], direction)
    left = np.array(weight).T.astype(np.float64)
    there = np.sum(direction * _to_numpy(camera.d), axis=-1) > _SAME
    replaced = (passed > 0) & ~broken & there & (left.mean(axis=-1) > _LEAST)
    ends = dr.select(mi.Bool(replaced), ray, camera)
    return ReplacedRays(
        mi.Ray3f(ends),
        replaced,
        np.where(replaced[:, None], np.clip(left, 0.0, 1.0), 1.0),
        first,
        np.where(replaced[:, None], mirrors, 0),
        np.where(replaced[:, None, None, None], planes, np.eye(4)),
    )


def map_to_images(traced: Mapping[str, np.ndarray], replaced: ReplacedRays) -> dict[str, np.ndarray]:
    """The flat buffers of the surfaces where rays ended, as those of their images: moved, turned and darkened."""
    to_image = replaced.planes[:, 0]
    for index in range(1, MIRRORS):
        to_image = to_image @ replaced.planes[:, index]
    found = dict(traced)
    found["position"] = np.einsum("nij,nj->ni", to_image[:, :3, :3], traced["position"]) + to_image[:, :3, 3]
    found["normal"] = np.einsum("nij,nj->ni", to_image[:, :3, :3], traced["normal"])
    for name in {"albedo", "reflectance", "specular_reflectance"} & traced.keys():
        found[name] = replaced.weight * traced[name]
    return found


def make_reflections(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[n, 4, 4] the reflections at the planes through points [n, 3] with unit normals [n, 3]."""
    found = np.tile(np.eye(4), (len(points), 1, 1))
    found[:, :3, :3] -= 2 * normals[:, :, None] * normals[:, None, :]
    found[:, :3, 3] = 2 * np.sum(points * normals, axis=-1, keepdims=True) * normals
    return found


def _is_specular(flags: Any) -> Any:
    """Whether flags of a material are of specular lobes alone."""
    known: Any = mi.BSDFFlags
    return (flags & int(known.Smooth) == 0) & (flags & int(known.Delta) != 0)


def _pass_surface(hit: Any, bsdf: Any, active: Any) -> tuple[Any, Any, Any, Any]:
    """Which rays go on, where to (in the frame of the hit), what is left of light, and which of them are mirrored."""
    known: Any = mi.BSDFFlags
    flags = bsdf.flags()
    sharp = active & hit.is_valid() & ~mi.has_flag(flags, known.Smooth) & mi.has_flag(flags, known.Delta)
    ways = []
    for lobes in (int(known.Transmission), int(known.Reflection)):
        context = mi.BSDFContext()
        context.type_mask = lobes
        sampled, weight = bsdf.sample(context, hit, 0.5, mi.Point2f(0.5), sharp)
        ways.append((sampled.wo, dr.select(sharp, mi.Color3f(weight * dr.square(sampled.eta)), 0.0)))
    (through, passed), (back, returned) = ways
    mirrored = sharp & (dr.sum(returned) > dr.sum(passed))
    share = dr.select(mirrored, returned, passed)
    goes = sharp & (dr.sum(share) > 0)
    return goes, dr.select(mirrored, back, through), share, goes & mirrored


def _compute_curvature(turn: Any, way: Any) -> Any:
    """Radians by which a normal turns over a unit of length."""
    return dr.select(dr.norm(way) > 0, dr.norm(turn) / dr.norm(way), 0.0)


def _to_numpy(vectors: Any) -> np.ndarray:
    return np.array(vectors, np.float64).T
