"""G-buffers at pixel centres: albedo, normal, depth, roughness, position and shape ids.

They are free of noise, as there is exactly one ray through each pixel centre. Mitsuba's own albedo buffer is no
reflectance for rough conductors and blends (it evaluates the BSDF at normal incidence), and its depth starts at the
near plane, so these are taken from the BSDFs and positions directly.
"""

import functools
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.core.frame import FAR
from jaxdn.render.buffers.primary_surface_replacement import (
    ReplacedPixels,
    ReplacedRays,
    map_to_images,
    replace_primary_surfaces,
)
from jaxdn.render.buffers.reflectance import Reflectances
from jaxdn.render.scenes.media import absorbs, list_media
from jaxdn.render.tracing.camera_rays import draw_lens_points, make_camera_rays, sample_lens
from jaxdn.render.tracing.light_samples import evaluate_diffuse_reflectance
from jaxdn.render.tracing.lobes import make_generator
from jaxdn.render.tracing.seeds import SampleStream, tea
from jaxdn.render.tracing.surfaces import evaluate_roughness, read_surface
from jaxdn.render.tracing.volume_path_tracer import find_first_vertex, find_one_first_vertex, scatters


class GBuffer(NamedTuple):
    """One ray per pixel; every buffer [H, W, C]."""

    albedo: np.ndarray
    """[H, W, 3] float32 diffuse reflectance in [0, 1]: 0 for purely glossy or specular surfaces, white on a miss."""
    normal: np.ndarray
    """[H, W, 3] float32 unit shading normal turned to the viewer, world space, 0 on a miss."""
    depth: np.ndarray
    """[H, W, 1] float32 view-space z, ``FAR`` on a miss."""
    roughness: np.ndarray
    """[H, W, 1] float32 linear roughness: 1 diffuse, 0 perfectly specular, GGX alpha = roughness^2."""
    position: np.ndarray
    """[H, W, 3] float64 world position, 0 on a miss."""
    direction: np.ndarray
    """[H, W, 3] float64 direction of the camera ray."""
    ids: np.ndarray
    """[H, W, 1] int32 position of the shape's name in ``names``, -1 on a miss."""
    names: tuple[str, ...]
    """The names of the scene's shapes, sorted: the same shape has the same id in every frame."""
    reflectance: np.ndarray | None = None
    """[H, W, 3] float32 share of uniform incident light that is reflected to the camera, in [0, 1], 1 on a miss; None
    if it was not requested."""
    specular_reflectance: np.ndarray | None = None
    """[H, W, 3] float32 the part of it that lobes other than diffuse ones reflect, 0 on a miss; None as above."""
    replaced: ReplacedPixels | None = None
    """The pixels whose buffers are those of an image in mirrors or of what is seen through glass, if they were
    requested and there are any. Their ids are of no shape: each pair of shapes, seen and met first, has its own."""


def list_shape_names(scene: Any) -> list[str]:
    """The name of every shape in the scene's order; unnamed shapes are named by their index."""
    names = [shape.id() or f"shape_{index:04d}" for index, shape in enumerate(scene.shapes())]
    if len(set(names)) != len(names):
        raise ValueError("scene: expected every shape to have a unique id; load it with optimize=False.")
    return names


def check_scene(scene: Any, *, filtered: bool = False) -> None:
    """Raise ValueError for effects that the tracers would otherwise silently ignore.

    A lens and fog need ``filtered`` pixels: their first hits are random, and guides through the pixels' centres would
    know nothing of that.
    """
    sensor = scene.sensors()[0]
    scattering = [(name, medium) for name, medium in list_media(scene) if not absorbs(medium)]
    varying = [name for name, medium in scattering if not medium.is_homogeneous()]
    if varying:
        raise ValueError(
            f"scene: media that vary in space are not supported, but {varying[0]!r} has one; make it homogeneous, or "
            "remove it."
        )
    fog = f"fog ({next((name for name, _ in scattering), '')!r} has it)"
    for what, there in (("depth of field", sensor.needs_aperture_sample()), (fog, bool(scattering))):
        if there and not filtered:
            raise ValueError(
                f"scene: {what} needs filtered pixels, as its first hits are random; expected pixel_filter "
                "'blackman-harris', 'gaussian' or 'box' (`jaxdn render --pixel-filter`), got 'centre'."
            )
    if sensor.shutter_open_time() > 0:
        raise ValueError(
            "scene: expected a sensor without a shutter, as Mitsuba moves nothing while it is open; set 'shutter' in "
            "the animation instead."
        )


def trace_gbuffer(
    scene: Any,
    *,
    reflectance: bool = False,
    specular: bool = False,
    see_through: bool = False,
    first: SampleStream | None = None,
) -> GBuffer:
    """Trace one ray through the centre of every pixel of the scene's first sensor, with the current variant.

    The rays go through the middle of its lens and see through fog; with ``first`` they do as the first sample of that
    stream: they go through a random point of the lens, and where fog scatters them they meet nothing.

    With ``reflectance`` (:mod:`jaxdn.render.buffers.reflectance`) a material that cannot be averaged gives one warning
    with the name of its shape, and its albedo is used; with ``specular`` there is its specular part as well. With
    ``see_through`` the buffers of flat mirrors and of glass are those of what they show
    (:mod:`jaxdn.render.buffers.primary_surface_replacement`), for which the variant has to be a vectorised one.
    """
    names = sorted(list_shape_names(scene))
    trace = _trace_one_by_one if str(mi.variant()).startswith("scalar") else _trace_all
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    reflectances = Reflectances(scene) if reflectance or specular else None
    key = None if first is None else first.key()
    traced, replaced = trace(scene, reflectances, specular, see_through, key)
    if replaced is not None:
        traced = map_to_images(traced, replaced)
    found = {name: buffer.reshape(height, width, -1) for name, buffer in traced.items()}

    surface = found["ids"] >= 0
    direction, normal, position = found["direction"], found["normal"], found["position"]
    to_world = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    forward = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
    # Distances along the ray begin at the near plane; the position is independent of it.
    depth = (position - to_world[:3, 3]) @ forward[:, None]
    away = np.sum(normal * direction, axis=-1, keepdims=True) > 0
    albedo = np.where(surface, np.clip(np.nan_to_num(found["albedo"]), 0.0, 1.0), 1.0).astype(np.float32)
    reflected = None if reflectances is None else _bound_reflectance(found, albedo, names)
    pixels = None if replaced is None else _find_replaced_pixels(scene, replaced, traced["ids"])
    ids = found["ids"].astype(np.int32)
    if pixels is not None:
        ids.reshape(-1)[pixels.pixels] = _number_pairs(pixels, len(names))
    return GBuffer(
        albedo=albedo,
        normal=np.where(surface, np.where(away, -normal, normal), 0.0).astype(np.float32),
        depth=np.where(surface, depth, FAR).astype(np.float32),
        roughness=np.where(surface, np.clip(np.nan_to_num(found["roughness"], nan=1.0), 0.0, 1.0), 1.0).astype(
            np.float32
        ),
        position=np.where(surface, position, 0.0),
        direction=direction,
        ids=ids,
        names=tuple(names),
        reflectance=reflected,
        specular_reflectance=_bound_specular(found, reflected) if specular and reflected is not None else None,
        replaced=pixels,
    )


def _find_replaced_pixels(scene: Any, replaced: ReplacedRays, shapes: np.ndarray) -> ReplacedPixels | None:
    """The replaced pixels with ids of shapes, from those of all pixels' surfaces; None if there are none."""
    pixels = np.flatnonzero(replaced.replaced)
    if not len(pixels):
        return None
    mirrors = look_up_ids(scene, replaced.mirrors[pixels].ravel()).reshape(len(pixels), -1)
    first = look_up_ids(scene, replaced.first[pixels])
    return ReplacedPixels(pixels, shapes.reshape(-1)[pixels].astype(int), first, mirrors, replaced.planes[pixels])


def _number_pairs(pixels: ReplacedPixels, count: int) -> np.ndarray:
    """Ids, the same in every frame, beyond those of the ``count`` shapes: one for each pair of shapes seen and met."""
    return ((1 + pixels.first) * count + pixels.shapes).astype(np.int32)


def _bound_reflectance(found: dict[str, np.ndarray], albedo: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """The averaged reflectance in [0, 1], and the albedo where that is NaN."""
    broken = (found["ids"] >= 0) & ~np.all(np.isfinite(found["reflectance"]), axis=-1, keepdims=True)
    for number in np.unique(found["ids"][broken]):
        _warn_of_albedo(names[int(number)])
    known = (found["ids"] >= 0) & ~broken
    return np.where(known, np.clip(found["reflectance"], 0.0, 1.0), albedo).astype(np.float32)


def _bound_specular(found: dict[str, np.ndarray], whole: np.ndarray) -> np.ndarray:
    """The specular part of the averaged reflectance, at most ``whole``; 0 where it is not known."""
    known = (found["ids"] >= 0) & np.all(np.isfinite(found["specular_reflectance"]), axis=-1, keepdims=True)
    return np.minimum(np.where(known, np.maximum(found["specular_reflectance"], 0.0), 0.0), whole).astype(np.float32)


@functools.cache
def _warn_of_albedo(shape: str) -> None:
    """Warn once for each shape, not for each frame."""
    warnings.warn(f"{shape}: the reflectance of its material cannot be averaged; its albedo is used.", stacklevel=2)


def _trace_all(
    scene: Any, reflectances: Reflectances | None, specular: bool, see_through: bool, first: tuple[int, int] | None
) -> tuple[dict[str, np.ndarray], ReplacedRays | None]:
    """All pixels at once; flat buffers of the hits of all rays, and how these were replaced."""
    sensor = scene.sensors()[0]
    width, height = (int(size) for size in sensor.film().crop_size())
    pixel = dr.arange(mi.UInt32, width * height)
    across = dr.opaque(mi.UInt32, width)
    point = None if first is None else sample_lens(pixel, mi.UInt32(0), first)
    ray = make_camera_rays(sensor, pixel % across, pixel // across, point)
    direction = ray.d
    replaced = replace_primary_surfaces(scene, ray, number_shapes) if see_through else None
    if replaced is not None:
        ray = replaced.ray
    scattered: Any = mi.Bool(False)
    if first is not None and scatters(scene):
        ray, scattered, _ = find_first_vertex(scene, ray, make_generator(pixel, mi.UInt32(0), first))
    hit = scene.ray_intersect(ray)
    valid = hit.is_valid() & ~scattered
    bsdf = hit.bsdf(ray)

    albedo = evaluate_diffuse_reflectance(bsdf, hit, valid)
    buffers: dict[str, Any] = {
        "albedo": albedo,
        "normal": hit.sh_frame.n,
        "position": hit.p,
        "direction": direction,
        "roughness": evaluate_roughness(bsdf, hit, valid),
        "shape": dr.select(scattered, 0, number_shapes(hit)),
    }
    if reflectances is not None:
        whole, part = reflectances.average_pixels(hit, bsdf, valid, albedo)
        # Not evaluated unless it is named here.
        buffers |= {"reflectance": whole} | ({"specular_reflectance": part} if specular else {})
    dr.eval(buffers)
    arrays = {name: np.array(buffer).T for name, buffer in buffers.items()}
    arrays |= {name: arrays[name].astype(np.float64) for name in ("position", "direction")}
    arrays["ids"] = look_up_ids(scene, arrays.pop("shape"))
    return arrays, replaced


def number_shapes(hit: Any) -> Any:
    """Mitsuba's number of the shape, or instance, of every hit; 0 where there is none."""
    instance = dr.reinterpret_array(mi.UInt32, hit.instance)
    shape = dr.select(instance != 0, instance, dr.reinterpret_array(mi.UInt32, hit.shape))
    return dr.select(hit.is_valid(), shape, 0)


def look_up_ids(scene: Any, numbers: np.ndarray) -> np.ndarray:
    """The ids of shapes by their numbers of :func:`number_shapes`: the positions of their sorted names, -1 for none."""
    # Registry numbers depend on the other existing objects; names do not. They count objects: a table holds them all.
    reinterpret: Any = dr.reinterpret_array
    own = [int(reinterpret(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes()]
    table = np.full(max([0, *own, int(numbers.max(initial=0))]) + 1, -1)
    table[own] = _rank_shapes(scene)
    return table[numbers]


def _rank_shapes(scene: Any) -> list[int]:
    """The id of every shape, in the scene's order."""
    names = list_shape_names(scene)
    ranks = {name: rank for rank, name in enumerate(sorted(names))}
    return [ranks[name] for name in names]


def _trace_one_by_one(
    scene: Any, reflectances: Reflectances | None, specular: bool, see_through: bool, first: tuple[int, int] | None
) -> tuple[dict[str, np.ndarray], None]:
    """The same buffers, a pixel at a time, for the variant without vectorisation, which follows no rays."""
    if see_through:
        raise ValueError(f"see_through: {mi.variant()} cannot follow rays past mirrors and glass; leave it out.")
    sensor = scene.sensors()[0]
    width, height = (int(size) for size in sensor.film().crop_size())
    by_shape = {_get_id(own): rank for own, rank in zip(scene.shapes(), _rank_shapes(scene), strict=True)}
    sizes = {"albedo": 3, "normal": 3, "position": 3, "direction": 3, "roughness": 1}
    arrays: dict[str, np.ndarray] = {name: np.zeros((width * height, size)) for name, size in sizes.items()}
    if reflectances is not None:
        arrays |= {name: np.zeros((width * height, 3)) for name in ("reflectance", "specular_reflectance")}
    arrays["ids"] = np.full(width * height, -1)
    points = np.full((width * height, 2), 0.5)
    if first is not None:
        points = draw_lens_points(np.arange(width * height), np.zeros(width * height, int), first)
    foggy = first is not None and scatters(scene)
    for pixel, point in enumerate(points.tolist()):
        row, column = divmod(pixel, width)
        ray, _ = sensor.sample_ray(0.0, 0.5, [(column + 0.5) / width, (row + 0.5) / height], point)
        arrays["direction"][pixel] = ray.d
        if foggy and first is not None:
            _, hit, fog = find_one_first_vertex(scene, mi.Ray3f(ray), tea(pixel ^ first[0], first[1])[0])
        else:
            hit, fog = scene.ray_intersect(ray), None
        if not hit.is_valid() or fog is not None:
            continue
        owner = hit.instance if hit.instance is not None else hit.shape
        arrays["ids"][pixel] = by_shape.get(_get_id(owner), -1)
        arrays["position"][pixel] = hit.p
        arrays["normal"][pixel] = hit.sh_frame.n
        albedo, arrays["roughness"][pixel] = read_surface(hit)
        arrays["albedo"][pixel] = albedo
        if reflectances is not None:
            found = reflectances.average_one(hit, hit.bsdf(), albedo)
            arrays["reflectance"][pixel], arrays["specular_reflectance"][pixel] = found
    return arrays, None


def _get_id(shape: Any) -> str:
    """Python wrappers of a shape are temporary; its id is not."""
    return str(shape.id())
