"""A path tracer for Mitsuba's vectorised variants that separates emitted, direct and indirect light.

One lane is one path through one pixel: through its centre, or a point that a filter draws. The estimator is that of
Mitsuba's ``path`` integrator (next-event estimation and BSDF sampling, balance heuristic; Veach 1997, sec. 9.2), so
sums agree with it, but one pass gives all three parts, and the random numbers depend only on (pixel, sample, frame,
seed). Which lobe a path took at its first hit is found by a second, short trace with the same numbers
(:mod:`jaxdn.render.tracing.lobes`), where that is requested.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import compute_transmittance, find_medium_behind, list_media
from jaxdn.render.tracing.camera_rays import make_camera_rays, sample_camera_rays
from jaxdn.render.tracing.light_samples import Shadows, sample_light, sum_shadows
from jaxdn.render.tracing.lobes import Lobes, draw_bounce_numbers, make_generator, sum_lobes, trace_first_segment
from jaxdn.render.tracing.pixel_filters import PixelFilter
from jaxdn.render.tracing.radiance import (
    BRIGHTEST,
    NOTHING_ELSE,
    RadianceSums,
    ReplayedPaths,
    TraceRequest,
    get_film_size,
    make_zero_radiance,
)
from jaxdn.render.tracing.seeds import SampleStream
from jaxdn.render.tracing.surfaces import SurfaceSums, evaluate_surfaces
from jaxdn.render.tracing.volume_path_tracer import scatters, trace_in_media

_TOLD = ("lobes", "shadows", "surfaces")
"""What else than light :class:`jaxdn.render.tracing.radiance.RadianceSums` may hold."""
MAX_LANES = 1 << 20
"""Paths traced at once: about 300 bytes of memory each."""


@dr.syntax
def trace(scene: Any, ray: Any, numbers: Any, max_depth: Any) -> tuple[Any, Any, Any]:
    """Follow one path per lane; returns (emitted, direct, indirect) radiance.

    ``max_depth`` counts as Mitsuba does: 1 is emission, 2 adds direct light, 3 one indirect bounce. No Russian
    roulette: it does not help at these depths.
    """
    absorbing = bool(list_media(scene))  # without media nothing of them is compiled
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
            throughput *= compute_transmittance(medium, hit.t, active)

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
        pick, lobe, point = draw_bounce_numbers(numbers)
        towards, radiance = scene.sample_emitter_direction(hit, pick, True, smooth)
        smooth &= towards.pdf != 0.0
        reflected, bsdf_pdf, sampled, bsdf_weight = bsdf.eval_pdf_sample(
            context, hit, hit.to_local(towards.d), lobe, point, active
        )
        weight = dr.select(towards.delta, 1.0, towards.pdf / (towards.pdf + bsdf_pdf))
        light = dr.select(smooth, throughput * reflected * radiance * weight, 0.0)
        if absorbing:  # surfaces between two media block this ray: it stays in one
            light *= compute_transmittance(find_medium_behind(hit, medium, towards.d), towards.dist, smooth)
        direct += dr.select(depth == 0, light, 0.0)
        indirect += dr.select(depth >= 1, light, 0.0)

        throughput *= bsdf_weight
        ray = hit.spawn_ray(hit.to_world(sampled.wo))
        if absorbing:
            medium = find_medium_behind(hit, medium, ray.d)
        last = hit
        last_pdf = sampled.pdf
        last_delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        active &= dr.max(throughput) != 0
        depth += 1
    return emitted, direct, indirect


def _accumulate_chunk(
    scene: Any,
    first_pixel: int,
    pixels: int,
    first: int,
    count: int,
    key: tuple[int, int],
    depth: int,
    request: TraceRequest,
) -> RadianceSums:
    """Sum ``count`` samples of consecutive pixels, flat [pixels, 3].

    Args:
      scene: the ``mi.Scene``.
      first_pixel: index of the first pixel.
      pixels: number of pixels.
      first: index of the first sample.
      count: samples per pixel.
      key: of the stream (:func:`jaxdn.render.tracing.seeds.make_frame_key`).
      depth: path length.
      request: what else is told of the samples.
    """
    pixel, sample = _number_lanes(first_pixel, pixels, first, count)
    ray, parts, finite, bad = _trace_lanes(scene, pixel, sample, key, depth, request.pixel_filter)
    images = _sum_blocks(parts, count)

    numbers = partial(make_generator, pixel, sample, key)
    found = _split_light(scene, ray, numbers, parts, finite, count, request)
    surfaces = None
    if request.surfaces is not None:
        guides = evaluate_surfaces(scene, ray, request.surfaces, numbers)
        parts = [[part] if dr.depth_v(part) == 1 else list(part) for part in guides]
        dr.eval(parts)
        surfaces = SurfaceSums(*_sum_blocks(parts, count))
    return RadianceSums(images[0], images[1], images[2], int(dr.sum(bad)[0]), *found, surfaces)


def _number_lanes(first_pixel: int, pixels: int, first: int, count: int) -> tuple[Any, Any]:
    """Number the pixel and the sample of every lane: ``count`` samples of a pixel, then those of the next."""
    lane = dr.arange(mi.UInt32, pixels * count)
    block = dr.opaque(mi.UInt32, count)
    offset = lane // block
    sample = lane - offset * block + dr.opaque(mi.UInt32, first)
    return offset + dr.opaque(mi.UInt32, first_pixel), sample


def _sum_blocks(parts: list[Any], count: int) -> list[np.ndarray]:
    """Sum each part over every ``count`` lanes, [lanes / count, channels]."""
    sums = [[dr.block_sum(channel, count) for channel in part] for part in parts]
    dr.eval(sums)
    return [np.stack([np.array(channel, np.float64) for channel in part], axis=-1) for part in sums]


def _trace_lanes(
    scene: Any, pixel: Any, sample: Any, key: tuple[int, int], depth: int, pixel_filter: PixelFilter = "centre"
) -> tuple[Any, list[Any], Any, Any]:
    """Trace one path a lane: its ray, its light (emitted, direct, indirect), and whether that is finite.

    Light that is not finite is 0, and the last result is 1 for it. Everything is evaluated.
    """
    ray = sample_camera_rays(scene, pixel, sample, key, pixel_filter)
    follow: Any = trace_in_media if scatters(scene) else trace
    traced: Any = follow(scene, ray, make_generator(pixel, sample, key), dr.opaque(mi.UInt32, depth))
    # As light is not negative, NaN, infinities and values that could overflow a sum all fail this comparison.
    finite = dr.all(traced[0] + traced[1] + traced[2] < BRIGHTEST)
    parts = [dr.select(finite, part, 0.0) for part in traced]
    bad = dr.select(finite, mi.UInt32(0), mi.UInt32(1))
    # One kernel: a block sum of unevaluated values would trace everything again for each sum.
    dr.eval(parts, bad)
    return ray, parts, finite, bad


def _split_light(
    scene: Any, ray: Any, numbers: Callable[[], Any], parts: list[Any], finite: Any, count: int, request: TraceRequest
) -> tuple[Lobes | None, Shadows | None]:
    """Split ``parts``, the light of lanes (emitted, direct, indirect), as requested; ``numbers`` begins anew."""
    lobes = shadows = None
    lamp = sample_light(scene, ray, numbers()) if request.shadows or (request.lobes and request.direct) else None
    if request.lobes:
        segment = trace_first_segment(scene, ray, numbers())
        arriving, glossy = parts[2], mi.Spectrum(0.0)
        if request.direct and lamp is not None:
            # Straight from a light's sampled point by both kinds of lobes; the rest by the lobe that was sampled.
            found = dr.select(lamp.blocked, 0.0, lamp.whole)
            arriving = arriving + dr.maximum(parts[1] - found, 0.0)
            glossy = dr.select(lamp.blocked, 0.0, lamp.whole - lamp.diffuse)
        lobes = sum_lobes(segment, dr.select(segment[1], arriving, 0.0) + glossy, finite, count)
    if request.shadows and lamp is not None:
        shadows = sum_shadows(lamp, finite, count)
    return lobes, shadows


def accumulate(
    scene: Any,
    stream: SampleStream,
    first: int,
    count: int,
    *,
    max_depth: int,
    max_lanes: int = MAX_LANES,
    request: TraceRequest = NOTHING_ELSE,
) -> RadianceSums:
    """Sum the samples ``first`` to ``first + count`` of one stream over the scene's film.

    Args:
      scene: the ``mi.Scene``.
      stream: of random numbers.
      first: index of the first sample.
      count: samples per pixel.
      max_depth: path length.
      max_lanes: paths traced at a time.
      request: what else is told of the samples.
    """
    height, width = get_film_size(scene)
    pixels = min(width * height, max_lanes)
    batch = max(1, max_lanes // pixels)
    runs = []
    for start in range(0, width * height, pixels):
        size = min(pixels, width * height - start)
        total = make_zero_radiance((size,), request)
        for done in range(0, count, batch):
            samples = (first + done, min(batch, count - done))
            total = total.plus(_accumulate_chunk(scene, start, size, *samples, stream.key(), max_depth, request))
        runs.append(total)
    parts = zip(*((run.emitted, run.direct, run.indirect) for run in runs), strict=True)
    images = [_to_image(part, height, width) for part in parts]
    joined = [_join_images([getattr(run, name) for run in runs], height, width) for name in _TOLD]
    return RadianceSums(images[0], images[1], images[2], sum(run.bad for run in runs), *joined)


def accumulate_sets(
    scene: Any,
    stream: SampleStream,
    first: int,
    count: int,
    sets: int,
    *,
    max_depth: int,
    max_lanes: int = MAX_LANES,
    request: TraceRequest = NOTHING_ELSE,
) -> list[RadianceSums]:
    """Sum ``sets`` sets of ``count`` samples, one after the other, each as :func:`accumulate` does.

    All at once where they fit into ``max_lanes``: for small images, to record the program takes longer than to run it.
    """
    height, width = get_film_size(scene)
    if sets * count * width * height > max_lanes or request != NOTHING_ELSE:
        starts = range(first, first + sets * count, count)
        options: dict[str, Any] = {"max_depth": max_depth, "max_lanes": max_lanes, "request": request}
        return [accumulate(scene, stream, at, count, **options) for at in starts]
    pixel, sample = _number_lanes(0, width * height, first, sets * count)
    _, parts, _, bad = _trace_lanes(scene, pixel, sample, stream.key(), max_depth)
    images = np.moveaxis(np.reshape(_sum_blocks(parts, count), (3, height, width, sets, 3)), 3, 0)
    wrong = np.array(dr.block_sum(bad, count)).reshape(-1, sets).sum(axis=0)
    return [RadianceSums(part[0], part[1], part[2], int(number)) for part, number in zip(images, wrong, strict=True)]


def accumulate_per_pixel(
    scene: Any,
    stream: SampleStream,
    first: int,
    counts: np.ndarray,
    *,
    max_depth: int,
    max_lanes: int = MAX_LANES,
) -> RadianceSums:
    """Sum another number of samples in each pixel: those from ``first`` to ``first + counts``.

    ``counts`` [H, W] are whole numbers >= 0; pixels without samples are 0. The other arguments are those of
    :func:`accumulate`, whose samples these are: a pixel's do not depend on how many others have.
    """
    number = np.asarray(counts, np.int64).reshape(-1)
    ends = np.cumsum(number)
    total = make_zero_radiance(counts.shape)
    for start in range(0, int(ends[-1]), max_lanes):
        lane = np.arange(start, min(start + max_lanes, int(ends[-1])))
        pixel = np.searchsorted(ends, lane, side="right")
        sample = lane - (ends - number)[pixel] + first
        total = total.plus(accumulate_samples(scene, stream, pixel, sample, max_depth=max_depth))
    return total


def accumulate_samples(
    scene: Any,
    stream: SampleStream,
    pixel: np.ndarray,
    sample: np.ndarray,
    *,
    max_depth: int,
    max_lanes: int = MAX_LANES,
    request: TraceRequest = NOTHING_ELSE,
) -> RadianceSums:
    """Sum any samples [n] of pixels [n]: a pixel may have none. Lobes and shadows are not told.

    The other arguments are those of :func:`accumulate`, whose samples these are.
    """
    size = get_film_size(scene)
    total = make_zero_radiance((size[0] * size[1],), request)
    for start in range(0, len(pixel), max_lanes):
        part = slice(start, start + max_lanes)
        of_lane, number = (mi.UInt32(each[part].astype(np.uint32)) for each in (pixel, sample))
        ray, light, _, wrong = _trace_lanes(scene, of_lane, number, stream.key(), max_depth, request.pixel_filter)
        images = [_sum_by_pixel(each, pixel[part], len(total.direct)) for each in light]
        surfaces = None
        if request.surfaces is not None:
            numbers = partial(make_generator, of_lane, number, stream.key())
            guides = evaluate_surfaces(scene, ray, request.surfaces, numbers)
            dr.eval(guides)
            surfaces = SurfaceSums(*(_sum_by_pixel(each, pixel[part], len(total.direct)) for each in guides))
        found = RadianceSums(images[0], images[1], images[2], int(dr.sum(wrong)[0]), surfaces=surfaces)
        total = total.plus(found)
    images = [part.reshape(*size, 3) for part in (total.emitted, total.direct, total.indirect)]
    surfaces = None if total.surfaces is None else total.surfaces.change(lambda part: part.reshape(*size, -1))
    return RadianceSums(images[0], images[1], images[2], total.bad, surfaces=surfaces)


def _sum_by_pixel(values: Any, pixel: np.ndarray, pixels: int) -> np.ndarray:
    """[pixels, channels] float64 the sums of values, one or several channels a lane, over the lanes of each pixel."""
    channels = np.array(values, np.float64).reshape(-1, len(pixel))
    return np.stack([np.bincount(pixel, channel, pixels) for channel in channels], axis=-1)


def _join_images(sums: list[Any], height: int, width: int) -> Any:
    """Join flat sums, such as those of lobes, to sums over an image; None where there are none."""
    if sums[0] is None:
        return None
    parts = zip(*sums, strict=True)
    return type(sums[0])(*(None if part[0] is None else _to_image(part, height, width) for part in parts))


def _to_image(parts: Iterable[np.ndarray], height: int, width: int) -> np.ndarray:
    """Join flat parts of an image."""
    return np.concatenate(list(parts)).reshape(height, width, -1)


def replay(
    scene: Any,
    stream: SampleStream,
    sample: int,
    target: np.ndarray,
    pixel: np.ndarray,
    *,
    max_depth: int,
    with_direct: bool,
) -> ReplayedPaths:
    """Trace paths through any points of the image, each with the random numbers of one sample of one pixel.

    Args:
      scene: the ``mi.Scene``.
      stream: of random numbers.
      sample: index of the sample.
      target: [n, 2] (x, y) on the film; pixel centres are at 0.5.
      pixel: [n] index of the pixel whose numbers are used.
      max_depth: path length.
      with_direct: their light is all that is reflected, not the indirect light alone.
    """
    column, row = (mi.Float((target[:, axis] - 0.5).astype(np.float32)) for axis in range(2))
    ray = make_camera_rays(scene.sensors()[0], column, row)
    numbers = make_generator(mi.UInt32(pixel.astype(np.uint32)), dr.opaque(mi.UInt32, sample), stream.key())
    emitted, direct, indirect = trace(scene, ray, numbers, dr.opaque(mi.UInt32, max_depth))
    wanted = direct + indirect if with_direct else indirect
    light = dr.select(dr.all(emitted + direct + indirect < BRIGHTEST), wanted, 0.0)
    hit = scene.ray_intersect(ray)
    position = dr.select(hit.is_valid(), hit.p, dr.nan)
    dr.eval(light, position)
    return ReplayedPaths(*(np.array(values, np.float64).T for values in (light, position)))
