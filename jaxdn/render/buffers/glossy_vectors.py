"""Glossy vectors: where the reflection seen at a point was in the previous frame (Zeng, Liu et al. 2021).

A reflection does not move with its mirror. For a sampled microfacet of normal h at the surface point S, the ray that it
reflects hits H, and H mirrored at the microfacet's plane is its virtual image, which lies on the camera ray. In the
previous frame the image is that of H' in the plane of S' and h', and a camera ray towards it passes the same reflector
where the same thing was seen: exactly so for a flat mirror. On a curved one, that ray meets the reflector at another
point, with another plane. The vector leads to the pixel whose own plane puts the image of H' onto the pixel itself,
which Newton's method finds in the previous G-buffer.

Sources: Zheng Zeng, Shiqiu Liu, Jinglei Yang, Lu Wang, Ling-Qi Yan, "Temporally Reliable Motion Vectors for Real-time
Ray Tracing", 2021, for flat reflectors; the search is derived here. NumPy, but for the rays.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.buffers.frame_pair import FramePair, carry, repeat_camera_rays, rotate, to_image, to_lanes
from jaxdn.render.buffers.gbuffer import look_up_ids, number_shapes
from jaxdn.render.buffers.geometry import View, compute_relative_poses, is_same_camera, is_unmoved, project
from jaxdn.render.tracing.lobes import draw_bounce_numbers

ROUGHEST = 0.6
"""Rougher surfaces show no reflection that could be followed."""
_ROUNDS = 4
_CLOSE = 1.0
"""The last step of a search that has arrived, in pixels."""
_SHORT = 1e-3
"""Share of a ray's length that does not count at its ends."""
_ALIKE = 0.1
"""Largest difference of roughness between a reflector's two places."""

FindOccluders = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""As :func:`find_occluders`, for the scene of the previous frame."""


class SampledReflections(NamedTuple):
    """What one microfacet of every pixel's surface reflects; float64."""

    reflects: np.ndarray
    """[H, W] bool, the surface has such microfacets."""
    normal: np.ndarray
    """[H, W, 3] of the microfacet."""
    point: np.ndarray
    """[H, W, 4] what the reflected ray hits, or its direction with 0 as its last component."""
    ids: np.ndarray
    """[H, W] the id of what it hits."""


def compute_glossy_motion(frames: FramePair, motion: np.ndarray) -> np.ndarray:
    """Compute this buffer [H, W, 2], in pixels.

    ``motion`` [H, W, 2], of the surfaces, is taken where no reflection can be followed.
    """
    previous, current = frames.previous, frames.current
    reflected = sample_reflections(frames)
    return compute_glossy_vectors(
        reflected, current.view, previous.view, motion, lambda start, end: find_occluders(previous.scene, start, end)
    )


def compute_glossy_vectors(
    reflected: SampledReflections, current: View, previous: View, motion: np.ndarray, find_occluders: FindOccluders
) -> np.ndarray:
    """[H, W, 2] float32: the vectors of reflections, ``motion`` where there is none or it cannot be followed.

    It cannot where the surface is rougher than ``ROUGHEST``, where the search leaves the reflector or the image, or
    where it does not arrive. Where something else hid H' from the reflector, as ``find_occluders`` tells, the image of
    that was seen instead: the vector is that image's own, as a *dual* vector, and NaN if that leads off the reflector.
    """
    now, size = current.gbuffer, current.gbuffer.ids.shape[:2]
    motions = compute_relative_poses(now.names, current.pose, previous.pose)
    still = is_unmoved(motions)[now.ids[..., 0]] & is_unmoved(motions)[reflected.ids]
    still &= is_same_camera(current.camera, previous.camera)
    asked = reflected.reflects & (now.ids[..., 0] >= 0) & (now.roughness[..., 0] <= ROUGHEST)
    row, column = np.nonzero(asked)
    vectors = np.array(motion, np.float32)
    if not len(row) or (np.all(is_unmoved(motions)) and is_same_camera(current.camera, previous.camera)):
        return vectors
    surface = motions[now.ids[row, column, 0]]
    image = _Image(
        point=np.einsum("nij,nj->ni", motions[reflected.ids[row, column]], reflected.point[row, column]),
        normal=rotate(surface, now.normal[row, column]),
        tilt=rotate(surface, reflected.normal[row, column] - now.normal[row, column]),
        ids=now.ids[row, column, 0],
        roughness=now.roughness[row, column, 0],
        previous=previous,
    )
    start = np.stack([column, row], axis=-1) + 0.5
    # On the pixel's own plane first: the answer for a flat mirror, and wherever the surface itself was hidden.
    place = carry(surface, now.position[row, column])
    target, arrived = image.search(start + motion[row, column])
    other, found = image.search(image.project(place, image.normal))
    target = np.where(arrived[:, None], target, other)
    here = project(now.position[row, column], current.camera, size)[0]
    # Where neither the reflector nor what it reflects has moved, rounding must not move the image.
    rests = still[row, column]
    target = np.where(rests[:, None], here + motion[row, column], target)
    arrived |= found | rests
    row, column, here, target = (each[arrived] for each in (row, column, here, target))
    vectors[row, column] = target - here

    pixel = np.floor(target).astype(int)
    hidden, other, ids = find_occluders(previous.gbuffer.position[pixel[:, 1], pixel[:, 0]], image.point[arrived])
    if not np.any(hidden):
        return vectors
    there = compute_relative_poses(now.names, previous.pose, current.pose)[ids[hidden]]
    moved = carry(there, other[hidden])
    row, column, here, target = (each[hidden] for each in (row, column, here, target))
    facet = reflected.normal[row, column]
    depth = np.sum((moved - now.position[row, column]) * facet, axis=-1, keepdims=True)
    left = target - project(moved - 2 * depth * facet, current.camera, size)[0]
    beside = np.floor(here + left)
    with np.errstate(invalid="ignore"):
        inside = np.all((beside >= 0) & (beside < [size[1], size[0]]), axis=-1)
    x, y = np.where(inside[:, None], beside, 0).astype(int).T
    inside &= previous.gbuffer.ids[y, x, 0] == now.ids[row, column, 0]
    vectors[row, column] = np.where(inside[:, None], left, np.nan)
    return vectors


def find_occluders(scene: Any, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find what lies between points [n, 3] and points [n, 4] (or in a direction, with 0 at the end).

    Returns [n] bool, whether there is something, its first point [n, 3], and its id [n].
    """
    onward = end[:, :3] - end[:, 3:] * start
    length = np.linalg.norm(onward, axis=-1, keepdims=True)
    onward = onward / np.maximum(length, 1e-12)
    # Neither the reflector nor what it reflects is between.
    skipped = _SHORT * np.minimum(length, 1.0)
    far = np.where(end[:, 3] > 0, (length * (1 - _SHORT) - skipped)[:, 0], np.inf)
    near = start + skipped * onward
    ray = mi.Ray3f(mi.Point3f(to_lanes(near)), mi.Vector3f(to_lanes(onward)))
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=False, active=mi.Bool(True))
    distance, point, shape = hit.t, hit.p, number_shapes(hit)
    dr.eval(distance, point, shape)
    there = np.array(distance, np.float64) < far
    return there, np.array(point, np.float64).T, np.where(there, look_up_ids(scene, np.array(shape)), -1)


class _Image(NamedTuple):
    """Points [n] of the previous frame's world that are seen in reflectors."""

    point: np.ndarray
    """[n, 4]."""
    normal: np.ndarray
    """[n, 3] of the surface."""
    tilt: np.ndarray
    """[n, 3] of the microfacet against it."""
    ids: np.ndarray
    """[n] of the reflector."""
    roughness: np.ndarray
    """[n] of the reflector."""
    previous: View

    def project(self, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """[n, 2] the pixels of the virtual images in planes through ``place`` [n, 3], NaN for what is behind one."""
        facet = normal + self.tilt
        facet = facet / np.maximum(np.linalg.norm(facet, axis=-1, keepdims=True), 1e-12)
        solid = self.point[:, 3:]
        height = np.sum((self.point[:, :3] - solid * place) * facet, axis=-1, keepdims=True)
        image = np.concatenate([self.point[:, :3] - 2 * height * facet, solid], axis=-1)
        eye = np.asarray(self.previous.camera.to_world, np.float64)[:3, 3]
        seen = (height > 0) & (np.sum((eye - place) * facet, axis=-1, keepdims=True) > 0)
        return np.where(seen, project(image, self.previous.camera, self._size)[0], np.nan)

    def search(self, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the previous frame showed the points, and [n] bool, whether that was found, from a first guess [n, 2].

        With F(q) the pixel of the image in the plane that pixel q shows, it solves q = F(q) by Newton's method, whose
        derivative is the difference over neighbouring pixels.
        """
        arrived = np.zeros(len(target), bool)
        for _ in range(_ROUNDS):
            pixel, there = self._find_pixel(target)
            found, _ = self._evaluate(pixel)
            across, below = (self._differentiate(pixel, step, found) for step in ((1, 0), (0, 1)))
            change = found - (pixel + 0.5)
            # (1 - dF/dq) step = F(q) - q, by Cramer's rule.
            a, b, c, d = 1 - across[:, 0], -below[:, 0], -across[:, 1], 1 - below[:, 1]
            size = a * d - b * c
            size = np.where(np.abs(size) > 1e-6, size, np.nan)
            step = (
                np.stack([d * change[:, 0] - b * change[:, 1], a * change[:, 1] - c * change[:, 0]], -1) / size[:, None]
            )
            with np.errstate(invalid="ignore"):
                arrived = there & np.all(np.abs(step) <= _CLOSE, axis=-1)
            target = pixel + 0.5 + step
        _, there = self._find_pixel(target)
        return target, arrived & there

    @property
    def _size(self) -> tuple[int, int]:
        height, width = self.previous.gbuffer.ids.shape[:2]
        return height, width

    def _find_pixel(self, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pixels [n, 2] (x, y) of targets, and whether they show the same reflector."""
        height, width = self._size
        pixel = np.floor(target)
        with np.errstate(invalid="ignore"):
            inside = np.all((pixel >= 0) & (pixel < [width, height]), axis=-1)
        pixel = np.where(inside[:, None], pixel, 0).astype(int)
        then = self.previous.gbuffer
        column, row = pixel.T
        same = then.ids[row, column, 0] == self.ids
        return pixel, inside & same & (np.abs(then.roughness[row, column, 0] - self.roughness) < _ALIKE)

    def _evaluate(self, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F at pixels, and whether they show the same reflector."""
        height, width = self._size
        inside = np.all((pixel >= 0) & (pixel < [width, height]), axis=-1)
        column, row = np.where(inside[:, None], pixel, 0).T
        then = self.previous.gbuffer
        same = inside & (then.ids[row, column, 0] == self.ids)
        return self.project(then.position[row, column], then.normal[row, column].astype(np.float64)), same

    def _differentiate(self, pixel: np.ndarray, step: tuple[int, int], middle: np.ndarray) -> np.ndarray:
        """[n, 2] the change of F over one pixel: central, on one side where that alone is the reflector, else 0."""
        (after, has_after), (before, has_before) = (self._evaluate(pixel + sign * np.array(step)) for sign in (1, -1))
        forward = np.where(has_after[:, None], after - middle, 0.0)
        backward = np.where(has_before[:, None], middle - before, 0.0)
        slope = (forward + backward) / np.maximum(has_after.astype(int) + has_before, 1)[:, None]
        return np.where(np.isfinite(slope), slope, 0.0)


def sample_reflections(frames: FramePair) -> SampledReflections:
    """Sample the reflections that one sample of each pixel's noisy radiance takes at its first hit.

    A sample that took a diffuse lobe has no microfacet: that of the surface's own normal stands in. What a surface lets
    through is not followed.
    """
    scene, current = frames.current
    size = current.gbuffer.ids.shape[:2]
    ray, numbers = repeat_camera_rays(scene, frames.noise, frames.sample)
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    bsdf, valid = hit.bsdf(ray), hit.is_valid()
    _, lobe, point = draw_bounce_numbers(numbers)
    sampled, weight = bsdf.sample(mi.BSDFContext(), hit, lobe, point, valid)
    goes = dr.max(weight) != 0
    mirrors, taken = valid & _is_glossy(bsdf.flags()), goes & _is_glossy(sampled.sampled_type)
    through = goes & mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Transmission)
    plain = mi.Vector3f(-hit.wi.x, -hit.wi.y, hit.wi.z)
    onward = dr.select(taken, sampled.wo, plain)
    there = mirrors & ~through & (hit.wi.z * onward.z > 0)
    facet = dr.normalize(hit.to_world(hit.wi + onward))
    away = hit.spawn_ray(hit.to_world(onward))
    end = scene.ray_intersect(away, ray_flags=mi.RayFlags.Minimal, coherent=False, active=there)
    goal = dr.select(end.is_valid(), end.p, mi.Point3f(away.d))
    shape = number_shapes(end)
    dr.eval(there, facet, goal, shape)
    ids = look_up_ids(scene, np.array(shape)).reshape(size)
    points, facets = (to_image(each, size, np.float64) for each in (goal, facet))
    return SampledReflections(
        to_image(there, size, bool),
        np.where(np.isfinite(facets), facets, 0.0),
        np.concatenate([points, (ids >= 0)[..., None]], axis=-1),
        ids,
    )


def _is_glossy(flags: Any) -> Any:
    """Whether flags of lobes are of one that reflects and is not diffuse."""
    return mi.has_flag(flags, mi.BSDFFlags.GlossyReflection) | mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
