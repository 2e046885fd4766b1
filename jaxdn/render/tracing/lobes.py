"""Which lobe a path took at its first hit, and how far it went from there.

A path's light arrives by the lobe that was sampled at its first hit: all indirect light of a sample is either diffuse
or specular. Both are found by repeating the path's first two segments with the same random numbers, after the light
has been traced: the tracer stays as it is, and costs nothing more where nobody asks.
"""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.core.frame import FAR


class Lobes(NamedTuple):
    """Sums over samples, float64, the pixels' axes in front."""

    specular: np.ndarray
    """[..., 3] light of the samples whose first reflection was specular."""
    length: np.ndarray
    """[..., 2] length of the segment after the first hit, of diffuse and of specular samples; ``FAR`` where it left
    the scene."""
    number: np.ndarray
    """[..., 2] number of diffuse and of specular samples that have such a segment."""

    def plus(self, other: "Lobes") -> "Lobes":
        """The sums over both sets of samples."""
        return Lobes(*(mine + theirs for mine, theirs in zip(self, other, strict=True)))

    def hit_distances(self) -> tuple[np.ndarray, np.ndarray]:
        """The mean length [..., 1] of diffuse and of specular samples; 0 where there was none."""
        mean = self.length / np.maximum(self.number, 1.0)
        return mean[..., :1], mean[..., 1:]


def make_zero_lobes(shape: tuple[int, ...]) -> Lobes:
    """The sums over no samples."""
    return Lobes(np.zeros((*shape, 3)), np.zeros((*shape, 2)), np.zeros((*shape, 2)))


def make_generator(pixel: Any, sample: Any, key: tuple[int, int]) -> Any:
    """Make a PCG32 generator for every lane, a bijection of (pixel, sample) mixed once more with the frame's key."""
    # Literals would be compiled into the kernel, a new one for every frame; opaque values are data.
    mix: Any = mi.sample_tea_32
    first, second = mix(pixel, sample)
    first, second = mix(first ^ dr.opaque(mi.UInt32, key[0]), second ^ dr.opaque(mi.UInt32, key[1]))
    pcg: Any = mi.PCG32
    wide: Any = mi.UInt64
    numbers = pcg()
    numbers.seed(wide(first), wide(second))
    return numbers


def draw_bounce_numbers(numbers: Any) -> tuple[Any, Any, Any]:
    """Draw the random numbers of one bounce: to choose an emitter's point, a lobe, and a direction in it."""
    pick = mi.Point2f(numbers.next_float32(), numbers.next_float32())
    lobe = numbers.next_float32()
    return pick, lobe, mi.Point2f(numbers.next_float32(), numbers.next_float32())


def trace_first_segment(scene: Any, ray: Any, numbers: Any) -> tuple[Any, Any, Any]:
    """Trace (diffuse, specular, length) of every path: two flags, and the length of its segment after the first hit.

    Every lobe that is not diffuse is specular: glossy, mirrors, transmission, and what passes through a mask. Both
    flags are false where nothing is hit or the path ends there. ``numbers`` is the generator that the path began with.
    """
    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    there = hit.is_valid()
    _, lobe, point = draw_bounce_numbers(numbers)
    sampled, weight = hit.bsdf(ray).sample(mi.BSDFContext(), hit, lobe, point, there)
    goes = there & (dr.max(weight) != 0)
    is_diffuse = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Diffuse)
    onward = hit.spawn_ray(hit.to_world(sampled.wo))
    end = scene.ray_intersect(onward, ray_flags=mi.RayFlags.Minimal, coherent=False, active=goes)
    length = dr.select(goes & end.is_valid(), dr.minimum(dr.norm(end.p - hit.p), FAR), FAR)
    return goes & is_diffuse, goes & ~is_diffuse, length


def sum_lobes(first: tuple[Any, Any, Any], specular: Any, finite: Any, count: int) -> Lobes:
    """The sums over blocks of ``count`` lanes, flat; samples that are not ``finite`` do not count.

    Args:
      first: what :func:`trace_first_segment` gave.
      specular: specular light of the same lanes.
      finite: the lanes that count.
      count: samples per pixel.
    """
    *kinds, length = first
    kinds = [finite & kind for kind in kinds]
    light = [dr.select(finite, specular[channel], 0.0) for channel in range(3)]
    lengths = [dr.select(kind, length, 0.0) for kind in kinds]
    counts = [dr.select(kind, mi.Float(1.0), 0.0) for kind in kinds]
    # Evaluated together and before the sums, as in the tracer.
    dr.eval(light, lengths, counts)
    sums = [[dr.block_sum(plane, count) for plane in part] for part in (light, lengths, counts)]
    dr.eval(sums)
    return Lobes(*(np.stack([np.array(plane, np.float64) for plane in part], axis=-1) for part in sums))
