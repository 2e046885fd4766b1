"""Emitted, direct and indirect radiance from Mitsuba's own ``path`` integrator, for the scalar variant.

With the same seed and one sample per pixel two ``path`` integrators of different depth follow the same paths, so that
``path(D) - path(2)`` is exactly the indirect light of ``path(D)``: never negative. With more than one sample the
streams of random numbers diverge, hence the loop over passes of one sample each. Samples are distributed over the pixel
(box filter): Mitsuba has no other option here.
"""

from typing import Any

import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import media_of
from jaxdn.render.tracing.seeds import pass_seed, tea
from jaxdn.render.tracing.wavefront import BRIGHTEST, Accumulated, Replayed, camera_rays, no_light

_NO_ROULETTE = 1000


def _integrators(scene: Any, max_depth: int) -> list[Any]:
    """Integrators of all light, of light without the indirect part, and of emission only."""
    # The path tracer for media draws whether light is absorbed: the same mean, with noise.
    kind = "volpath" if media_of(scene) else "path"
    # Three renderings are three times faster than one "aov" integrator around all three.
    return [
        mi.load_dict({"type": kind, "max_depth": depth, "rr_depth": _NO_ROULETTE})
        for depth in (max_depth, min(2, max_depth), 1)
    ]


def accumulate(
    scene: Any, *, seed: int, frame: int, stream: int, first: int, count: int, max_depth: int
) -> Accumulated:
    """The sums of the passes ``first`` to ``first + count`` of one stream; see :func:`wavefront.accumulate`.

    Args:
      scene: the ``mi.Scene``.
      seed: of the clip.
      frame: index of the frame.
      stream: of :mod:`jaxdn.render.tracing.seeds`.
      first: index of the first pass.
      count: number of passes.
      max_depth: path length.
    """
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    integrators = _integrators(scene, max_depth)
    total = no_light((height, width))
    render: Any = mi.render
    for index in range(first, first + count):
        number = pass_seed(seed, frame, stream, index)
        images = [
            np.array(render(scene, integrator=integrator, spp=1, seed=number), np.float64)[..., :3]
            for integrator in integrators
        ]
        finite = np.all(np.stack(images) < BRIGHTEST, axis=(0, -1), keepdims=True)[0]
        whole, two, one = (np.where(finite, image, 0.0) for image in images)
        # The film adds in float32: a last-digit difference of two equal sums must not become negative light.
        direct, indirect = np.maximum(two - one, 0.0), np.maximum(whole - two, 0.0)
        total = total.plus(Accumulated(one, direct, indirect, int(np.sum(~finite))))
    return total


def accumulate_sets(scene: Any, sets: int, *, first: int, count: int, **same: Any) -> list[Accumulated]:
    """The sums of ``sets`` sets of ``count`` passes, one after the other; see :func:`wavefront.accumulate_sets`."""
    return [accumulate(scene, first=first + index * count, count=count, **same) for index in range(sets)]


def replay(
    scene: Any, target: np.ndarray, pixel: np.ndarray, *, key: tuple[int, int], sample: int, max_depth: int
) -> Replayed:
    """Paths through any points of the image with reproducible random numbers; see :func:`wavefront.replay`.

    The numbers depend on the same arguments, but are not those of :func:`accumulate`, whose passes have one stream for
    each block of pixels.
    """
    sensor = scene.sensors()[0]
    deep, two, _ = _integrators(scene, max_depth)
    sampler: Any = mi.load_dict({"type": "independent"})
    light, position = np.zeros((len(pixel), 3)), np.full((len(pixel), 3), np.nan)
    for index, (x, y) in enumerate(target):
        ray = camera_rays(sensor, float(x) - 0.5, float(y) - 0.5)
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
    return Replayed(light, position)
