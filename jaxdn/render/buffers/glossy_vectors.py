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

from jaxdn.render.buffers.gbuffer import ids_of, shape_of
from jaxdn.render.buffers.geometry import View, project, relative_poses, same_camera, unmoved
from jaxdn.render.tracing.lobes import bounce_numbers
from jaxdn.render.tracing.seeds import NOISY, frame_key
from jaxdn.render.tracing.wavefront import camera_rays, generator

ROUGHEST = 0.6
"""Rougher surfaces show no reflection that could be followed."""
_ROUNDS = 4
_CLOSE = 1.0
"""The last step of a search that has arrived, in pixels."""
_SHORT = 1e-3
"""Share of a ray's length that does not count at its ends."""
_ALIKE = 0.1
"""Largest difference of roughness between a reflector's two places."""

Between = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""As :func:`between`, for the scene of the previous frame."""


class Reflected(NamedTuple):
    """What one microfacet of every pixel's surface reflects; float64."""

    there: np.ndarray
    """[H, W] bool, the surface has such microfacets."""
    normal: np.ndarray
    """[H, W, 3] of the microfacet."""
    point: np.ndarray
    """[H, W, 4] what the reflected ray hits, or its direction with 0 as its last component."""
    ids: np.ndarray
    """[H, W] the id of what it hits."""


def glossy_motion(
    previous: tuple[Any, View], current: tuple[Any, View], motion: np.ndarray, *, seed: int, frame: int, sample: int
) -> np.ndarray:
    """The buffer of this name [H, W, 2], in pixels.

    Args:
      previous: the ``mi.Scene`` and the geometry of the previous frame.
      current: those of the current frame.
      motion: [H, W, 2] that of the surfaces, taken where no reflection can be followed.
      seed: of the clip.
      frame: index of the current frame.
      sample: index of the sample of the noisy image whose microfacets are taken.
    """
    found = sampled_reflections(current[0], current[1], key=frame_key(seed, frame, NOISY), sample=sample)
    return glossy_vectors(found, current[1], previous[1], motion, lambda start, end: between(previous[0], start, end))


def glossy_vectors(
    reflected: Reflected, current: View, previous: View, motion: np.ndarray, between: Between
) -> np.ndarray:
    """[H, W, 2] float32: the vectors of reflections, ``motion`` where there is none or it cannot be followed.

    It cannot where the surface is rougher than ``ROUGHEST``, where the search leaves the reflector or the image, or
    where it does not arrive. Where something else hid H' from the reflector, as ``between`` tells, the image of that
    was seen instead: the vector is that image's own, as a *dual* vector, and NaN if that leads off the reflector.
    """
    now, size = current.gbuffer, current.gbuffer.ids.shape[:2]
    motions = relative_poses(now.names, current.pose, previous.pose)
    still = unmoved(motions)[now.ids[..., 0]] & unmoved(motions)[reflected.ids]
    still &= same_camera(current.camera, previous.camera)
    asked = reflected.there & (now.ids[..., 0] >= 0) & (now.roughness[..., 0] <= ROUGHEST)
    row, column = np.nonzero(asked)
    vectors = np.array(motion, np.float32)
    if not len(row) or (np.all(unmoved(motions)) and same_camera(current.camera, previous.camera)):
        return vectors
    surface = motions[now.ids[row, column, 0]]
    image = _Image(
        point=np.einsum("nij,nj->ni", motions[reflected.ids[row, column]], reflected.point[row, column]),
        normal=_turned(surface, now.normal[row, column]),
        tilt=_turned(surface, reflected.normal[row, column] - now.normal[row, column]),
        ids=now.ids[row, column, 0],
        roughness=now.roughness[row, column, 0],
        previous=previous,
    )
    start = np.stack([column, row], axis=-1) + 0.5
    # On the pixel's own plane first: the answer for a flat mirror, and wherever the surface itself was hidden.
    place = np.einsum("nij,nj->ni", surface[:, :3, :3], now.position[row, column]) + surface[:, :3, 3]
    target, arrived = image.searched(start + motion[row, column])
    other, found = image.searched(image.projected(place, image.normal))
    target = np.where(arrived[:, None], target, other)
    here = project(now.position[row, column], current.camera, size)[0]
    # Where neither the reflector nor what it reflects has moved, rounding must not move the image.
    rests = still[row, column]
    target = np.where(rests[:, None], here + motion[row, column], target)
    arrived |= found | rests
    row, column, here, target = (each[arrived] for each in (row, column, here, target))
    vectors[row, column] = target - here

    pixel = np.floor(target).astype(int)
    hidden, other, ids = between(previous.gbuffer.position[pixel[:, 1], pixel[:, 0]], image.point[arrived])
    if not np.any(hidden):
        return vectors
    there = relative_poses(now.names, previous.pose, current.pose)[ids[hidden]]
    moved = np.einsum("nij,nj->ni", there[:, :3, :3], other[hidden]) + there[:, :3, 3]
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


def between(scene: Any, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether something lies between points [n, 3] and points [n, 4] (or in a direction, with 0 at the end).

    Returns [n] bool, the first points [n, 3] of these things, and their ids [n].
    """
    onward = end[:, :3] - end[:, 3:] * start
    length = np.linalg.norm(onward, axis=-1, keepdims=True)
    onward = onward / np.maximum(length, 1e-12)
    # Neither the reflector nor what it reflects is between.
    skipped = _SHORT * np.minimum(length, 1.0)
    far = np.where(end[:, 3] > 0, (length * (1 - _SHORT) - skipped)[:, 0], np.inf)
    near = start + skipped * onward
    ray = mi.Ray3f(mi.Point3f(_lanes(near)), mi.Vector3f(_lanes(onward)))
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=False, active=mi.Bool(True))
    distance, point, shape = hit.t, hit.p, shape_of(hit)
    dr.eval(distance, point, shape)
    there = np.array(distance, np.float64) < far
    return there, np.array(point, np.float64).T, np.where(there, ids_of(scene, np.array(shape)), -1)


def _lanes(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values.T.astype(np.float32))


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

    def projected(self, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """[n, 2] the pixels of the virtual images in planes through ``place`` [n, 3], NaN for what is behind one."""
        facet = normal + self.tilt
        facet = facet / np.maximum(np.linalg.norm(facet, axis=-1, keepdims=True), 1e-12)
        solid = self.point[:, 3:]
        height = np.sum((self.point[:, :3] - solid * place) * facet, axis=-1, keepdims=True)
        image = np.concatenate([self.point[:, :3] - 2 * height * facet, solid], axis=-1)
        eye = np.asarray(self.previous.camera.to_world, np.float64)[:3, 3]
        seen = (height > 0) & (np.sum((eye - place) * facet, axis=-1, keepdims=True) > 0)
        return np.where(seen, project(image, self.previous.camera, self._size)[0], np.nan)

    def searched(self, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the previous frame showed the points, and [n] bool, whether that was found, from a first guess [n, 2].

        With F(q) the pixel of the image in the plane that pixel q shows, it solves q = F(q) by Newton's method, whose
        derivative is the difference over neighbouring pixels.
        """
        arrived = np.zeros(len(target), bool)
        for _ in range(_ROUNDS):
            pixel, there = self._pixel(target)
            found, _ = self._at(pixel)
            across, below = (self._slope(pixel, step, found) for step in ((1, 0), (0, 1)))
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
        _, there = self._pixel(target)
        return target, arrived & there

    @property
    def _size(self) -> tuple[int, int]:
        height, width = self.previous.gbuffer.ids.shape[:2]
        return height, width

    def _pixel(self, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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

    def _at(self, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F at pixels, and whether they show the same reflector."""
        height, width = self._size
        inside = np.all((pixel >= 0) & (pixel < [width, height]), axis=-1)
        column, row = np.where(inside[:, None], pixel, 0).T
        then = self.previous.gbuffer
        same = inside & (then.ids[row, column, 0] == self.ids)
        return self.projected(then.position[row, column], then.normal[row, column].astype(np.float64)), same

    def _slope(self, pixel: np.ndarray, step: tuple[int, int], middle: np.ndarray) -> np.ndarray:
        """[n, 2] the change of F over one pixel: central, on one side where that alone is the reflector, else 0."""
        (after, has_after), (before, has_before) = (self._at(pixel + sign * np.array(step)) for sign in (1, -1))
        forward = np.where(has_after[:, None], after - middle, 0.0)
        backward = np.where(has_before[:, None], middle - before, 0.0)
        slope = (forward + backward) / np.maximum(has_after.astype(int) + has_before, 1)[:, None]
        return np.where(np.isfinite(slope), slope, 0.0)


def sampled_reflections(scene: Any, current: View, *, key: tuple[int, int], sample: int) -> Reflected:
    """The reflections that one sample of each pixel's noisy radiance takes at its first hit.

    A sample that took a diffuse lobe has no microfacet: that of the surface's own normal stands in. What a surface lets
    through is not followed.
    """
    height, width = current.gbuffer.ids.shape[:2]
    pixel = dr.arange(mi.UInt32, width * height)
    across = dr.opaque(mi.UInt32, width)
    ray = camera_rays(scene.sensors()[0], pixel % across, pixel // across)
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    bsdf, valid = hit.bsdf(ray), hit.is_valid()
    _, lobe, point = bounce_numbers(generator(pixel, dr.opaque(mi.UInt32, sample), key))
    sampled, weight = bsdf.sample(mi.BSDFContext(), hit, lobe, point, valid)
    goes = dr.max(weight) != 0
    mirrors, taken = valid & _reflects(bsdf.flags()), goes & _reflects(sampled.sampled_type)
    through = goes & mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Transmission)
    plain = mi.Vector3f(-hit.wi.x, -hit.wi.y, hit.wi.z)
    onward = dr.select(taken, sampled.wo, plain)
    there = mirrors & ~through & (hit.wi.z * onward.z > 0)
    facet = dr.normalize(hit.to_world(hit.wi + onward))
    away = hit.spawn_ray(hit.to_world(onward))
    end = scene.ray_intersect(away, ray_flags=mi.RayFlags.Minimal, coherent=False, active=there)
    goal = dr.select(end.is_valid(), end.p, mi.Point3f(away.d))
    shape = shape_of(end)
    dr.eval(there, facet, goal, shape)
    ids = ids_of(scene, np.array(shape)).reshape(height, width)
    points, facets = (np.array(each, np.float64).T.reshape(height, width, 3) for each in (goal, facet))
    return Reflected(
        np.array(there).astype(bool).reshape(height, width),
        np.where(np.isfinite(facets), facets, 0.0),
        np.concatenate([points, (ids >= 0)[..., None]], axis=-1),
        ids,
    )


def _reflects(flags: Any) -> Any:
    """Whether flags of lobes are of one that reflects and is not diffuse."""
    return mi.has_flag(flags, mi.BSDFFlags.GlossyReflection) | mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)


def _turned(motions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", motions[:, :3, :3], directions)
