"""A path tracer for Mitsuba's vectorised variants that separates emitted, direct and indirect light.

One lane is one path through the centre of one pixel. The estimator is that of Mitsuba's ``path`` integrator (next-event
estimation and BSDF sampling, balance heuristic; Veach 1997, sec. 9.2), so sums agree with it, but one pass gives all
three parts, and the random numbers depend only on (pixel, sample, frame, seed). Which lobe a path took at its first hit
is found by a second, short trace with the same numbers (:mod:`jaxdn.render.tracing.lobes`), where that is requested.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import media_of, medium_behind, transmittance
from jaxdn.render.tracing.light_samples import Shadows, light_sample, no_shadows, shadow_sums
from jaxdn.render.tracing.lobes import Lobes, bounce_numbers, first_segment, lobe_sums, no_lobes
from jaxdn.render.tracing.seeds import frame_key

MAX_LANES = 1 << 20
"""Paths traced at once: about 300 bytes of memory each."""

BRIGHTEST = 1e30
"""Samples at least this bright are treated as overflows, as the sum of a few would overflow."""


class Accumulated(NamedTuple):
    """Sums over samples of the three parts of radiance, each [H, W, 3] float64."""

    emitted: np.ndarray
    direct: np.ndarray
    indirect: np.ndarray
    bad: int
    """Number of samples that were not finite (or beyond ``BRIGHTEST``); they count as black."""
    lobes: Lobes | None = None
    """The same samples by the lobe of their first reflection; None if it was not requested."""
    shadows: Shadows | None = None
    """Their light straight from lights, with and without its shadows; None if it was not requested."""

    def plus(self, other: "Accumulated") -> "Accumulated":
        """The sums over both sets of samples."""
        return Accumulated(
            self.emitted + other.emitted,
            self.direct + other.direct,
            self.indirect + other.indirect,
            self.bad + other.bad,
            None if self.lobes is None or other.lobes is None else self.lobes.plus(other.lobes),
            None if self.shadows is None or other.shadows is None else self.shadows.plus(other.shadows),
        )


class Request(NamedTuple):
    """What else is to be told of samples."""

    lobes: bool = False
    """Diffuse and specular samples apart (``Accumulated.lobes``)."""
    shadows: bool = False
    """Light with and without shadows (``Accumulated.shadows``)."""
    direct: bool = False
    """The lobes' light is all that is reflected, not the indirect light alone."""


class Replayed(NamedTuple):
    """Paths that were traced with the random numbers of others."""

    light: np.ndarray
    """[n, 3] float64 indirect radiance; 0 where it was not finite."""
    position: np.ndarray
    """[n, 3] float64 what the camera ray hit; NaN where it hit nothing."""


_NOTHING_ELSE = Request()


def no_light(shape: tuple[int, ...], request: Request = _NOTHING_ELSE) -> Accumulated:
    """The sums over no samples."""
    emitted, direct, indirect = np.zeros((3, *shape, 3))
    lobes = no_lobes(shape) if request.lobes else None
    return Accumulated(emitted, direct, indirect, 0, lobes, no_shadows(shape) if request.shadows else None)


def generator(pixel: Any, sample: Any, key: tuple[int, int]) -> Any:
    """A PCG32 generator for every lane, a bijection of (pixel, sample) mixed once more with the frame's key."""
    # Literals would be compiled into the kernel, a new one for every frame; opaque values are data.
    mix: Any = mi.sample_tea_32
    first, second = mix(pixel, sample)
    first, second = mix(first ^ dr.opaque(mi.UInt32, key[0]), second ^ dr.opaque(mi.UInt32, key[1]))
    pcg: Any = mi.PCG32
    wide: Any = mi.UInt64
    numbers = pcg()
    numbers.seed(wide(first), wide(second))
    return numbers


def camera_rays(sensor: Any, column: Any, row: Any) -> Any:
    """Rays through the centres of pixels of the sensor's film."""
    width, height = sensor.film().crop_size()
    position = mi.Point2f((mi.Float(column) + 0.5) / float(width), (mi.Float(row) + 0.5) / float(height))
    ray: Any = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))[0]
    return mi.Ray3f(ray)


@dr.syntax
def trace(scene: Any, ray: Any, numbers: Any, max_depth: Any) -> tuple[Any, Any, Any]:
    """Follow one path per lane; returns (emitted, direct, indirect) radiance.

    ``max_depth`` counts as Mitsuba does: 1 is emission, 2 adds direct light, 3 one indirect bounce. No Russian
    roulette: it does not help at these depths.
    """
    absorbing = bool(media_of(scene))  # without media nothing of them is compiled
    medium = mi.MediumPtr(scene.sensors()[0].get_medium())
    context = mi.BSDFContext()
    emitted, direct, indirect = mi.Spectrum(0.0), mi.Spectrum(0.0), mi.Spectrum(0.0)
    throughput = mi.Spectrum(1.0)
    depth: Any = mi.UInt32(0)
    ray = mi.Ray3f(ray)
    last = dr.zeros(mi.SurfaceInteraction3f)
    last_pdf = mi.Float(1.0)
    last_delta: Any = mi.Bool(True)
    active: Any = mi.Bool(True)
    while active:
        hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=depth == 0, active=active)
        if absorbing:
            throughput *= transmittance(medium, hit.t, active)

        # The BSDF sample found an emitter: weigh it against having sampled that emitter directly.
        found: Any = mi.DirectionSample3f(scene, hit, last)
        shines = active & (found.emitter != None)  # noqa: E711  (an array of pointers compares elementwise)
        emitter_pdf = scene.pdf_emitter_direction(last, found, shines & ~last_delta)
        weight = dr.select(last_pdf > 0, last_pdf / (last_pdf + emitter_pdf), 0.0)
        light = dr.select(shines, throughput * weight * found.emitter.eval(hit, shines), 0.0)
        emitted += dr.select(depth == 0, light, 0.0)
        direct += dr.select(depth == 1, light, 0.0)
        indirect += dr.select(depth >= 2, light, 0.0)

        active &= hit.is_valid() & (depth + 1 < max_depth)
        bsdf = hit.bsdf(ray)

        # Sample an emitter, and draw the numbers of this bounce whether or not they are used.
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        pick, lobe, point = bounce_numbers(numbers)
        towards, radiance = scene.sample_emitter_direction(hit, pick, True, smooth)
        smooth &= towards.pdf != 0.0
        reflected, bsdf_pdf, sampled, bsdf_weight = bsdf.eval_pdf_sample(
            context, hit, hit.to_local(towards.d), lobe, point, active
        )
        weight = dr.select(towards.delta, 1.0, towards.pdf / (towards.pdf + bsdf_pdf))
        light = dr.select(smooth, throughput * reflected * radiance * weight, 0.0)
        if absorbing:  # surfaces between two media block this ray: it stays in one
            light *= transmittance(medium_behind(hit, medium, towards.d), towards.dist, smooth)
        direct += dr.select(depth == 0, light, 0.0)
        indirect += dr.select(depth >= 1, light, 0.0)

        throughput *= bsdf_weight
        ray = hit.spawn_ray(hit.to_world(sampled.wo))
        if absorbing:
            medium = medium_behind(hit, medium, ray.d)
        last = hit
        last_pdf = sampled.pdf
        last_delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        active &= dr.max(throughput) != 0
        depth += 1
    return emitted, direct, indirect


def _chunk(
    scene: Any,
    first_pixel: int,
    pixels: int,
    first: int,
    count: int,
    key: tuple[int, int],
    depth: int,
    request: Request,
) -> Accumulated:
    """The sums of ``count`` samples of consecutive pixels, flat [pixels, 3].

    Args:
      scene: the ``mi.Scene``.
      first_pixel: index of the first pixel.
      pixels: number of pixels.
      first: index of the first sample.
      count: samples per pixel.
      key: of the stream (:func:`jaxdn.render.tracing.seeds.frame_key`).
      depth: path length.
      request: what else is told of the samples.
    """
    pixel, sample = _lanes(first_pixel, pixels, first, count)
    ray, parts, finite, bad = _traced(scene, pixel, sample, key, depth)
    images = _sums(parts, count)
    found = _apart(scene, ray, lambda: generator(pixel, sample, key), parts, finite, count, request)
    return Accumulated(images[0], images[1], images[2], int(dr.sum(bad)[0]), *found)


def _lanes(first_pixel: int, pixels: int, first: int, count: int) -> tuple[Any, Any]:
    """The pixel and the sample of every lane: ``count`` samples of a pixel, then those of the next."""
    lane = dr.arange(mi.UInt32, pixels * count)
    block = dr.opaque(mi.UInt32, count)
    offset = lane // block
    sample = lane - offset * block + dr.opaque(mi.UInt32, first)
    return offset + dr.opaque(mi.UInt32, first_pixel), sample


def _sums(parts: list[Any], count: int) -> list[np.ndarray]:
    """Each part summed up over every ``count`` lanes, [lanes / count, 3]."""
    sums = [[dr.block_sum(part[channel], count) for channel in range(3)] for part in parts]
    dr.eval(sums)
    return [np.stack([np.array(channel, np.float64) for channel in part], axis=-1) for part in sums]


def _traced(scene: Any, pixel: Any, sample: Any, key: tuple[int, int], depth: int) -> tuple[Any, list[Any], Any, Any]:
    """One path for each lane's pixel and sample: its ray, its light (emitted, direct, indirect), whether it is finite.

    Light that is not finite is 0, and the last result is 1 for it. Everything is evaluated.
    """
    sensor = scene.sensors()[0]
    width = dr.opaque(mi.UInt32, int(sensor.film().crop_size()[0]))
    row = pixel // width
    ray = camera_rays(sensor, pixel - row * width, row)
    traced: Any = trace(scene, ray, generator(pixel, sample, key), dr.opaque(mi.UInt32, depth))
    # As light is not negative, NaN, infinities and values that could overflow a sum all fail this comparison.
    finite = dr.all(traced[0] + traced[1] + traced[2] < BRIGHTEST)
    parts = [dr.select(finite, part, 0.0) for part in traced]
    bad = dr.select(finite, mi.UInt32(0), mi.UInt32(1))
    # One kernel: a block sum of unevaluated values would trace everything again for each sum.
    dr.eval(parts, bad)
    return ray, parts, finite, bad


def _apart(
    scene: Any, ray: Any, numbers: Callable[[], Any], parts: list[Any], finite: Any, count: int, request: Request
) -> tuple[Lobes | None, Shadows | None]:
    """What is requested of the lanes whose light is ``parts``: emitted, direct, indirect; ``numbers`` begins anew."""
    lobes = shadows = None
    lamp = light_sample(scene, ray, numbers()) if request.shadows or (request.lobes and request.direct) else None
    if request.lobes:
        segment = first_segment(scene, ray, numbers())
        arriving, glossy = parts[2], mi.Spectrum(0.0)
        if request.direct and lamp is not None:
            # Straight from a light's sampled point by both kinds of lobes; the rest by the lobe that was sampled.
            found = dr.select(lamp.blocked, 0.0, lamp.whole)
            arriving = arriving + dr.maximum(parts[1] - found, 0.0)
            glossy = dr.select(lamp.blocked, 0.0, lamp.whole - lamp.diffuse)
        lobes = lobe_sums(segment, dr.select(segment[1], arriving, 0.0) + glossy, finite, count)
    if request.shadows and lamp is not None:
        shadows = shadow_sums(lamp, finite, count)
    return lobes, shadows


def accumulate(
    scene: Any,
    *,
    seed: int,
    frame: int,
    stream: int,
    first: int,
    count: int,
    max_depth: int,
    max_lanes: int = MAX_LANES,
    request: Request = _NOTHING_ELSE,
) -> Accumulated:
    """The sums of the samples ``first`` to ``first + count`` of one stream over the scene's film.

    Args:
      scene: the ``mi.Scene``.
      seed: of the clip.
      frame: index of the frame.
      stream: of :mod:`jaxdn.render.tracing.seeds`.
      first: index of the first sample.
      count: samples per pixel.
      max_depth: path length.
      max_lanes: paths traced at a time.
      request: what else is told of the samples.
    """
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    key = frame_key(seed, frame, stream)
    pixels = min(width * height, max_lanes)
    batch = max(1, max_lanes // pixels)
    runs = []
    for start in range(0, width * height, pixels):
        size = min(pixels, width * height - start)
        total = no_light((size,), request)
        for done in range(0, count, batch):
            samples = (first + done, min(batch, count - done))
            total = total.plus(_chunk(scene, start, size, *samples, key, max_depth, request))
        runs.append(total)
    parts = zip(*((run.emitted, run.direct, run.indirect) for run in runs), strict=True)
    images = [_whole(part, height, width) for part in parts]
    found = [run.lobes for run in runs if run.lobes is not None]
    lobes = Lobes(*(_whole(part, height, width) for part in zip(*found, strict=True))) if found else None
    lamps = [run.shadows for run in runs if run.shadows is not None]
    shadows = Shadows(*(_whole(part, height, width) for part in zip(*lamps, strict=True))) if lamps else None
    return Accumulated(images[0], images[1], images[2], sum(run.bad for run in runs), lobes, shadows)


def accumulate_sets(
    scene: Any,
    sets: int,
    *,
    seed: int,
    frame: int,
    stream: int,
    first: int,
    count: int,
    max_depth: int,
    max_lanes: int = MAX_LANES,
) -> list[Accumulated]:
    """The sums of ``sets`` sets of ``count`` samples, one after the other, each as :func:`accumulate` gives it.

    All at once where they fit into ``max_lanes``: for small images, to record the program takes longer than to run it.
    """
    same: dict[str, Any] = {"seed": seed, "frame": frame, "stream": stream, "count": count, "max_depth": max_depth}
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    if sets * count * width * height > max_lanes:
        each = (accumulate(scene, first=first + index * count, **same, max_lanes=max_lanes) for index in range(sets))
        return list(each)
    pixel, sample = _lanes(0, width * height, first, sets * count)
    _, parts, _, bad = _traced(scene, pixel, sample, frame_key(seed, frame, stream), max_depth)
    images = np.moveaxis(np.reshape(_sums(parts, count), (3, height, width, sets, 3)), 3, 0)
    wrong = np.array(dr.block_sum(bad, count)).reshape(-1, sets).sum(axis=0)
    return [Accumulated(part[0], part[1], part[2], int(number)) for part, number in zip(images, wrong, strict=True)]


def accumulate_each(
    scene: Any,
    counts: np.ndarray,
    *,
    seed: int,
    frame: int,
    stream: int,
    first: int,
    max_depth: int,
    max_lanes: int = MAX_LANES,
) -> Accumulated:
    """The same sums with another number of samples in each pixel: those from ``first`` to ``first + counts``.

    ``counts`` [H, W] are whole numbers >= 0; pixels without samples are 0. The other arguments are those of
    :func:`accumulate`, whose samples these are: a pixel's do not depend on how many others have.
    """
    key = frame_key(seed, frame, stream)
    number = np.asarray(counts, np.int64).reshape(-1)
    sums = np.zeros((3, number.size, 3))
    ends = np.cumsum(number)
    bad = 0
    for start in range(0, int(ends[-1]), max_lanes):
        lane = np.arange(start, min(start + max_lanes, int(ends[-1])))
        pixel = np.searchsorted(ends, lane, side="right")
        sample = lane - (ends - number)[pixel] + first
        of_lane, number_of_lane = (mi.UInt32(each.astype(np.uint32)) for each in (pixel, sample))
        _, parts, _, wrong = _traced(scene, of_lane, number_of_lane, key, max_depth)
        for total, part in zip(sums, parts, strict=True):
            light = np.array(part, np.float64).T
            for channel in range(3):
                total[:, channel] += np.bincount(pixel, light[:, channel], number.size)
        bad += int(dr.sum(wrong)[0])
    images = sums.reshape(3, *counts.shape, 3)
    return Accumulated(images[0], images[1], images[2], bad)


def _whole(parts: Iterable[np.ndarray], height: int, width: int) -> np.ndarray:
    """Flat parts of an image as one image."""
    return np.concatenate(list(parts)).reshape(height, width, -1)


def replay(
    scene: Any, target: np.ndarray, pixel: np.ndarray, *, key: tuple[int, int], sample: int, max_depth: int
) -> Replayed:
    """Paths through any points of the image, each with the random numbers of one sample of one pixel.

    Args:
      scene: the ``mi.Scene``.
      target: [n, 2] (x, y) on the film; pixel centres are at 0.5.
      pixel: [n] index of the pixel whose numbers are used.
      key: of the stream (:func:`jaxdn.render.tracing.seeds.frame_key`).
      sample: index of the sample.
      max_depth: path length.
    """
    column, row = (mi.Float((target[:, axis] - 0.5).astype(np.float32)) for axis in range(2))
    ray = camera_rays(scene.sensors()[0], column, row)
    numbers = generator(mi.UInt32(pixel.astype(np.uint32)), dr.opaque(mi.UInt32, sample), key)
    emitted, direct, indirect = trace(scene, ray, numbers, dr.opaque(mi.UInt32, max_depth))
    light = dr.select(dr.all(emitted + direct + indirect < BRIGHTEST), indirect, 0.0)
    hit = scene.ray_intersect(ray)
    position = dr.select(hit.is_valid(), hit.p, dr.nan)
    dr.eval(light, position)
    return Replayed(*(np.array(values, np.float64).T for values in (light, position)))
