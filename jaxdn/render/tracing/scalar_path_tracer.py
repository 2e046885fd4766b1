"""A path tracer for the scalar variant: emitted, direct and indirect radiance from Mitsuba's own ``path`` integrator.

With the same seed and one sample per pixel two ``path`` integrators of different depth follow the same paths, so that
``path(D) - path(2)`` is exactly the indirect light of ``path(D)``: never negative. With more than one sample the
streams of random numbers diverge, hence the loop over passes of one sample each. Samples are distributed over the pixel
(box filter): Mitsuba has no other option here.
"""

from typing import Any

import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import list_media
from jaxdn.render.tracing.radiance import (
    BRIGHTEST,
    RadianceSums,
    ReplayedPaths,
    get_film_size,
    make_camera_rays,
    make_zero_radiance,
)
from jaxdn.render.tracing.seeds import SampleStream, make_pass_seed, tea

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


def accumulate(scene: Any, stream: SampleStream, first: int, count: int, *, max_depth: int) -> RadianceSums:
    """Sum the passes ``first`` to ``first + count`` of one stream.

    The arguments are those of :func:`jaxdn.render.tracing.vectorised_path_tracer.accumulate`.
    """
    height, width = get_film_size(scene)
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
    scene: Any, stream: SampleStream, first: int, count: int, sets: int, *, max_depth: int
) -> list[RadianceSums]:
    """Sum ``sets`` sets of ``count`` passes, one after the other."""
    return [
        accumulate(scene, stream, at, count, max_depth=max_depth) for at in range(first, first + sets * count, count)
    ]


def replay(
    scene: Any, stream: SampleStream, sample: int, target: np.ndarray, pixel: np.ndarray, *, max_depth: int
) -> ReplayedPaths:
    """Trace paths through any points of the image with reproducible random numbers.

    The arguments are those of :func:`jaxdn.render.tracing.vectorised_path_tracer.replay`.
    The numbers depend on the same arguments, but are not those of :func:`accumulate`, whose passes have one stream for
    each block of pixels.
    """
    sensor, key = scene.sensors()[0], stream.key()
    deep, two, _ = _make_integrators(scene, max_depth)
    sampler: Any = mi.load_dict({"type": "independent"})
    light, position = np.zeros((len(pixel), 3)), np.full((len(pixel), 3), np.nan)
    for index, (x, y) in enumerate(target):
        ray = make_camera_rays(sensor, float(x) - 0.5, float(y) - 0.5)
        number = tea(key[0] ^ int(pixel[index]), key[1] ^ sample)[0]
        parts = []
        for integrator in (deep, two):
            sampler.seed(number, 1)
            parts.append(np.array(integrator.sample(scene, sampler, ray)[0], np.float64))
        if np.all(parts[0] < BRIGHTEST):
            light[index] = np.maximum(parts[0] - parts[1], 0.0)
        hit = scene.ray_intersect(ray)
        if hit.is_valid():
            position[index] = hit.p
    return ReplayedPaths(light, position)
