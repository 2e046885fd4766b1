"""The same three parts of radiance from Mitsuba's own ``path`` integrator, for the variant without vectorisation.

With the same seed and one sample per pixel two ``path`` integrators of different depth follow the same paths, so that
``path(D) - path(2)`` is exactly the indirect light of ``path(D)``: never negative. With more than one sample the
streams of random numbers drift apart, hence the loop over passes of one sample each. Samples are spread over the
pixel (box filter): Mitsuba offers nothing else here.
"""

from typing import Any

import mitsuba as mi
import numpy as np

from jaxdn.render.seeds import pass_seed
from jaxdn.render.wavefront import BRIGHTEST, Accumulated, no_light

_NO_ROULETTE = 1000


def _integrators(max_depth: int) -> list[Any]:
    """The whole of the light, without indirect light, and emission alone."""
    # Three renderings are three times faster than one "aov" integrator around all three.
    return [
        mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": _NO_ROULETTE})
        for depth in (max_depth, min(2, max_depth), 1)
    ]


def accumulate(
    scene: Any, *, seed: int, frame: int, stream: int, first: int, count: int, max_depth: int
) -> Accumulated:
    """The sums of the passes ``first`` to ``first + count`` of one stream; see :func:`wavefront.accumulate`."""
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    integrators = _integrators(max_depth)
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
        # The film adds in float32: a last-digit difference of two equal sums must not become a negative light.
        direct, indirect = np.maximum(two - one, 0.0), np.maximum(whole - two, 0.0)
        total = total.plus(Accumulated(one, direct, indirect, int(np.sum(~finite))))
    return total
