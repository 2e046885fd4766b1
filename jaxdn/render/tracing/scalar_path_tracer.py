"""A path tracer for the scalar variant: emitted, direct and indirect radiance from Mitsuba's own ``path`` integrator.

With the same seed and one sample per pixel two ``path`` integrators of different depth follow the same paths, so that
``path(D) - path(2)`` is exactly the indirect light of ``path(D)``: never negative. With more than one sample the
streams of random numbers diverge, hence the loop over passes of one sample each. In such a pass Mitsuba itself
distributes the samples over the pixel (box filter). Where pixels are filtered the paths are traced one by one, through
the points that the filter draws: ten times slower, but every sample is told of.
"""

from typing import Any

import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import list_media
from jaxdn.render.tracing.camera_rays import draw_camera_points, make_camera_rays
from jaxdn.render.tracing.radiance import (
    BRIGHTEST,
    NOTHING_ELSE,
    RadianceSums,
    ReplayedPaths,
    TraceRequest,
    get_film_size,
    make_zero_radiance,
)
from jaxdn.render.tracing.seeds import SampleStream, make_pass_seed, tea
from jaxdn.render.tracing.surfaces import SurfaceSums, make_zero_surfaces, read_guides

_NO_ROULETTE = 1000


def _make_integrators(scene: Any, max_depth: int) -> list[Any]:
    """Make integrators of all light, of light without the indirect part, and of emission only."""
    # The path tracer for media draws whether light is absorbed: the same mean, with noise.
    kind = "volpath" if list_media(scene) else "path"
    # Three renderings are three times faster than one "aov" integrator around all three.
    return [
        mi.load_dict({"type": kind, "max_depth": depth, "rr_depth": _NO_ROULETTE})
        for depth in (max_depth, min(2, max_depth), 1)
    ]


def accumulate(
    scene: Any,
    stream: SampleStream,
    first: int,
    count: int,
    *,
    max_depth: int,
    request: TraceRequest = NOTHING_ELSE,
) -> RadianceSums:
    """Sum the passes ``first`` to ``first + count`` of one stream.

    The arguments are those of :func:`jaxdn.render.tracing.vectorised_path_tracer.accumulate`; ``request`` may ask for
    filtered pixels and their guides, and for nothing else.
    """
    height, width = get_film_size(scene)
    if request.pixel_filter != "centre":
        pixel, sample = (np.ravel(each) for each in np.indices((height * width, count)))
        return accumulate_samples(scene, stream, pixel, sample + first, max_depth=max_depth, request=request)
    integrators = _make_integrators(scene, max_depth)
    total = make_zero_radiance((height, width))
    render: Any = mi.render
    for index in range(first, first + count):
        number = make_pass_seed(*stream, index)
        images = [
            np.array(render(scene, integrator=integrator, spp=1, seed=number), np.float64)[..., :3]
            for integrator in integrators
        ]
        finite = np.all(np.stack(images) < BRIGHTEST, axis=(0, -1), keepdims=True)[0]
        whole, two, one = (np.where(finite, image, 0.0) for image in images)
        # The film adds in float32: a last-digit difference of two equal sums must not become negative light.
        direct, indirect = np.maximum(two - one, 0.0), np.maximum(whole - two, 0.0)
        total = total.plus(RadianceSums(one, direct, indirect, int(np.sum(~finite))))
    return total


def accumulate_sets(
    scene: Any,
    stream: SampleStream,
    first: int,
    count: int,
    sets: int,
    *,
    max_depth: int,
    request: TraceRequest = NOTHING_ELSE,
) -> list[RadianceSums]:
    """Sum ``sets`` sets of ``count`` passes, one after the other."""
    starts = range(first, first + sets * count, count)
    return [accumulate(scene, stream, at, count, max_depth=max_depth, request=request) for at in starts]


def accumulate_samples(
    scene: Any,
    stream: SampleStream,
    pixel: np.ndarray,
    sample: np.ndarray,
    *,
    max_depth: int,
    request: TraceRequest,
) -> RadianceSums:
    """Sum samples [n] of pixels [n], one by one; the rest as in :func:`accumulate`."""
    size, key = get_film_size(scene), stream.key()
    integrators = _make_integrators(scene, max_depth)
    sampler: Any = mi.load_dict({"type": "independent"})
    sums, bad = np.zeros((3, size[0] * size[1], 3)), 0
    surfaces = None if request.surfaces is None else make_zero_surfaces((size[0] * size[1],), request.surfaces)
    film, lens = draw_camera_points(pixel, sample, size, key, request.pixel_filter)
    numbers = tea(pixel.astype(np.int64) ^ key[0], sample.astype(np.int64) ^ key[1])[0]
    for at, place in enumerate(pixel.tolist()):
        ray = mi.Ray3f(scene.sensors()[0].sample_ray(0.0, 0.5, film[at].tolist(), lens[at].tolist())[0])
        images = _trace_one(scene, ray, integrators, sampler, int(numbers[at]))
        if np.all(images < BRIGHTEST):
            whole, two, one = images
            sums[:, place] += one, np.maximum(two - one, 0.0), np.maximum(whole - two, 0.0)
        else:
            bad += 1
        if surfaces is not None and request.surfaces is not None:
            _add_guides(surfaces, place, read_guides(scene, ray, request.surfaces, int(numbers[at])))
    images = sums.reshape(3, *size, 3)
    surfaces = None if surfaces is None else surfaces.change(lambda part: part.reshape(*size, -1))
    return RadianceSums(images[0], images[1], images[2], bad, surfaces=surfaces)


def _trace_one(scene: Any, ray: Any, integrators: list[Any], sampler: Any, number: int) -> np.ndarray:
    """[integrators, 3] the light of one ray, with the same random numbers."""
    found, medium = [], scene.sensors()[0].get_medium()
    for integrator in integrators:
        sampler.seed(number, 1)
        found.append(np.array(integrator.sample(scene, sampler, ray, medium)[0], np.float64))
    return np.stack(found)


def _add_guides(sums: SurfaceSums, place: int, one: SurfaceSums) -> None:
    for total, value in zip(sums, one, strict=True):
        if total is not None:
            total[place] += value


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
    """Trace paths through any points of the image with reproducible random numbers.

    The arguments are those of :func:`jaxdn.render.tracing.vectorised_path_tracer.replay`.
    The numbers depend on the same arguments, but are not those of :func:`accumulate`, whose passes have one stream for
    each block of pixels.
    """
    sensor, key = scene.sensors()[0], stream.key()
    deep, two, one = _make_integrators(scene, max_depth)
    left_out = one if with_direct else two
    sampler: Any = mi.load_dict({"type": "independent"})
    light, position = np.zeros((len(pixel), 3)), np.full((len(pixel), 3), np.nan)
    for index, (x, y) in enumerate(target):
        ray = make_camera_rays(sensor, float(x) - 0.5, float(y) - 0.5)
        number = tea(key[0] ^ int(pixel[index]), key[1] ^ sample)[0]
        parts = _trace_one(scene, ray, [deep, left_out], sampler, number)
        if np.all(parts[0] < BRIGHTEST):
            light[index] = np.maximum(parts[0] - parts[1], 0.0)
        hit = scene.ray_intersect(ray)
        if hit.is_valid():
            position[index] = hit.p
    return ReplayedPaths(light, position)
