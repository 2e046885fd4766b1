"""Shadow vectors: where the shadow that lies on a point was in the previous frame (Zeng, Liu et al. 2021).

A shadow does not move with the surface it lies on. For a sampled point L of a light that a blocker B hides from the
surface point S, all three are moved to the previous frame; the ray from L' through B' meets the plane of the surface
where the same piece of shadow lay. A pixel that the light reaches now, but did not reach then, has been left by a
shadow: it takes over that shadow's motion, as a disoccluded pixel takes over its occluder's (*dual* vectors), and so
finds its history beside the old shadow instead of in it.

Sources: Zheng Zeng, Shiqiu Liu, Jinglei Yang, Lu Wang, Ling-Qi Yan, "Temporally Reliable Motion Vectors for Real-time
Ray Tracing", 2021; the plane and the second case are derived here. NumPy, but for the rays.
"""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.buffers.frame_pair import FramePair, carry, repeat_camera_rays, rotate, to_image, to_lanes
from jaxdn.render.buffers.gbuffer import list_shape_names, look_up_ids, number_shapes
from jaxdn.render.buffers.geometry import SAME_NORMAL, View, compute_relative_poses, project
from jaxdn.render.tracing.light_samples import sample_light

_GRAZING = 1e-4
"""Least cosine between a ray of light and a surface."""
_NEAR_PLANE = 0.01
"""Largest distance of what the target shows from the receiver's plane, as a fraction of its depth."""


class SampledLights(NamedTuple):
    """One point of a light for every pixel, and what hides it; float64."""

    point: np.ndarray
    """[H, W, 4] the point, or, with 0 as its last component, the direction towards the light."""
    motion: np.ndarray
    """[H, W, 4, 4] the light's motion from the current to the previous frame."""
    normal: np.ndarray
    """[H, W, 3] of the surface that is lit, its own, not that of its shading."""
    lit: np.ndarray
    """[H, W] bool, it would light the surface if nothing stood between."""
    blocked: np.ndarray
    """[H, W] bool, something does."""
    blocker: np.ndarray
    """[H, W, 3] a point of it."""
    blocker_ids: np.ndarray
    """[H, W] its id."""


class PreviousBlockers(NamedTuple):
    """What hides the lights in the previous frame."""

    there: np.ndarray
    """[H, W] bool."""
    blocker: np.ndarray
    """[H, W, 3]."""
    ids: np.ndarray
    """[H, W]."""


def compute_shadow_motion(frames: FramePair, motion: np.ndarray) -> np.ndarray:
    """Compute this buffer [H, W, 2], in pixels.

    ``motion`` [H, W, 2], of the surfaces, is taken where no shadow lies.
    """
    lights = sample_lights(frames)
    before = find_previous_blockers(frames, lights)
    return compute_shadow_vectors(lights, before, frames.current.view, frames.previous.view, motion)


def compute_shadow_vectors(
    lights: SampledLights, before: PreviousBlockers, current: View, previous: View, motion: np.ndarray
) -> np.ndarray:
    """[H, W, 2] float32: the vectors of shadows, ``motion`` where there is none or its history is not known.

    It is not known where the ray of light grazes the surface, where the shadow lay off screen, or where the previous
    frame shows something else than the receiver's plane there.
    """
    now = current.gbuffer
    size = now.ids.shape[:2]
    back = _compute_motions(current, previous)
    there = _compute_motions(previous, current)
    ids = now.ids[..., 0]
    receiver = back[ids]
    old_place, old_normal = carry(receiver, now.position), _rotate_normals(receiver, lights.normal)
    old_light = np.einsum("hwij,hwj->hwi", lights.motion, lights.point)

    # Under a shadow: where did it lie?
    carried = carry(back[lights.blocker_ids], lights.blocker)
    lay = intersect_plane(old_light, carried, old_place, old_normal)
    under = project(lay, previous.camera, size)[0] - project(now.position, current.camera, size)[0]
    # Left by a shadow: where has it gone?
    carried = carry(there[before.ids], before.blocker)
    lies = intersect_plane(lights.point, carried, now.position, lights.normal)
    left = project(old_place, previous.camera, size)[0] - project(lies, current.camera, size)[0]

    blocker = np.where(lights.blocked[..., None, None], back[lights.blocker_ids], back[before.ids])
    rigid = _are_equal(receiver, blocker) & _are_equal(receiver, lights.motion)
    shadow = lights.lit & (lights.blocked | before.there) & ~rigid & (ids >= 0)
    vectors = np.where(lights.blocked[..., None], under, left)
    known = shadow & is_on_plane(vectors, previous, old_place, old_normal)
    return np.where(known[..., None], vectors, motion).astype(np.float32)


def intersect_plane(light: np.ndarray, blocker: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """[..., 3] where rays of light behind their blockers meet planes; NaN where they do not.

    Args:
      light: [..., 4] a point, or the direction towards the light with 0 as its last component.
      blocker: [..., 3] a point of each ray.
      place: [..., 3] a point of each plane.
      normal: [..., 3] of the planes.
    """
    near = light[..., 3:] != 0
    onward = np.where(near, blocker - light[..., :3], -light[..., :3])
    slope = np.sum(normal * onward, axis=-1, keepdims=True)
    steep = np.abs(slope) > _GRAZING * np.linalg.norm(onward, axis=-1, keepdims=True)
    # From the blocker on, as a light may be far away.
    ahead = np.sum(normal * (place - blocker), axis=-1, keepdims=True) / np.where(steep, slope, 1.0)
    return np.where(steep & (ahead >= 0), blocker + ahead * onward, np.nan)


def is_on_plane(vectors: np.ndarray, previous: View, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """[H, W] bool: the nearest pixel of the previous frame to ``p + vector(p)`` shows the plane of the surface."""
    height, width = vectors.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
    target = np.floor(pixels + vectors)
    with np.errstate(invalid="ignore"):
        inside = np.all((target >= 0) & (target < [width, height]), axis=-1)
    column, row = np.moveaxis(np.where(inside[..., None], target, 0).astype(int), -1, 0)
    then = previous.gbuffer
    distance = np.abs(np.sum(normal * (then.position[row, column] - place), axis=-1))
    alike = np.abs(np.sum(normal * then.normal[row, column], axis=-1)) > SAME_NORMAL
    return inside & (then.ids[row, column, 0] >= 0) & alike & (distance < _NEAR_PLANE * then.depth[row, column, 0])


def sample_lights(frames: FramePair) -> SampledLights:
    """Sample the points of lights that one sample of each pixel's noisy radiance takes at its first hit."""
    scene, current = frames.current
    size = current.gbuffer.ids.shape[:2]
    found = sample_light(scene, *repeat_camera_rays(scene, frames.noise, frames.sample))
    far = mi.has_flag(found.towards.emitter.flags(), mi.EmitterFlags.Infinite)
    point = dr.select(far, mi.Point3f(found.towards.d), found.towards.p)
    number = dr.reinterpret_array(mi.UInt32, found.towards.emitter)
    lit, blocked, shape = dr.max(found.whole) > 0, found.blocked, number_shapes(found.blocker)
    dr.eval(point, far, number, found.hit.n, lit, blocked, found.blocker.p, shape)

    def image(lanes: Any, dtype: Any) -> np.ndarray:
        return to_image(lanes, size, dtype)

    motions, lookup = _compute_light_motions(scene, current, frames.previous.view)
    different, inverse = np.unique(image(number, np.int64), return_inverse=True)
    rank = np.array([lookup.get(int(one), -1) for one in different])[inverse.reshape(size)]
    hidden, near = image(blocked, bool), ~image(far, bool)
    return SampledLights(
        point=np.concatenate([image(point, np.float64), near[..., None]], axis=-1),
        motion=motions[rank],
        normal=image(found.hit.n, np.float64),
        lit=image(lit, bool),
        blocked=hidden,
        blocker=np.where(hidden[..., None], image(found.blocker.p, np.float64), 0.0),
        blocker_ids=np.where(hidden, look_up_ids(scene, np.array(shape)).reshape(size), -1),
    )


def find_previous_blockers(frames: FramePair, lights: SampledLights) -> PreviousBlockers:
    """Find what hides the same points of the lights, in the previous frame, from the same points of surfaces."""
    (scene, previous), current = frames.previous, frames.current.view
    shape = lights.lit.shape
    back = _compute_motions(current, previous)[current.gbuffer.ids[..., 0]]
    place = carry(back, current.gbuffer.position)
    light = np.einsum("hwij,hwj->hwi", lights.motion, lights.point)
    # A light that is infinitely far away is behind everything.
    reach = 4 * float(scene.bbox().bounding_sphere().radius) + 1.0
    goal = np.where(light[..., 3:] != 0, light[..., :3], place + reach * light[..., :3])
    start = dr.zeros(mi.SurfaceInteraction3f, shape[0] * shape[1])
    start.p, start.n = mi.Point3f(to_lanes(place)), mi.Normal3f(to_lanes(_rotate_normals(back, lights.normal)))
    asked = mi.Bool((lights.lit & ~lights.blocked).ravel())
    ray = start.spawn_ray_to(mi.Point3f(to_lanes(goal)))
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=False, active=asked)
    there, point, number = asked & hit.is_valid(), hit.p, number_shapes(hit)
    dr.eval(there, point, number)
    hidden = np.array(there).astype(bool).reshape(shape)
    ids = look_up_ids(scene, np.array(number)).reshape(shape)
    blocker = np.array(point, np.float64).T.reshape(*shape, 3)
    return PreviousBlockers(hidden, np.where(hidden[..., None], blocker, 0.0), np.where(hidden, ids, -1))


def _compute_light_motions(scene: Any, current: View, previous: View) -> tuple[np.ndarray, dict[int, int]]:
    """The motions [N + 1, 4, 4] of lights from the current to the previous frame, and Mitsuba's number of each one."""
    names = dict(zip((shape.id() for shape in scene.shapes()), list_shape_names(scene), strict=True))
    owners: list[str] = []
    lookup: dict[int, int] = {}
    reinterpret: Any = dr.reinterpret_array
    for emitter in scene.emitters():
        owner = emitter.get_shape()
        lookup[int(reinterpret(mi.UInt32, mi.EmitterPtr(emitter))[0])] = len(owners)
        owners.append(emitter.id() if owner is None else names[owner.id()])
    return compute_relative_poses(tuple(owners), current.pose, previous.pose), lookup


def _compute_motions(start: View, end: View) -> np.ndarray:
    return compute_relative_poses(start.gbuffer.names, start.pose, end.pose)


def _rotate_normals(motions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    turned = rotate(motions, normals)
    length = np.linalg.norm(turned, axis=-1, keepdims=True)
    return turned / np.where(length > 0, length, 1.0)


def _are_equal(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.all(first == second, axis=(-2, -1))
