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
from jaxdn.render.wavefront import Light, no_light

_NO_ROULETTE = 1000


def _integrator(max_depth: int) -> Any:
    """One integrator that renders all three depths of every pass with the same random numbers."""
    nested = {
        name: {"type": "path", "max_depth": depth, "rr_depth": _NO_ROULETTE}
        for name, depth in (("all", max_depth), ("direct", min(2, max_depth)), ("emitted", 1))
    }
    # The integrator insists on a buffer of its own; the nested images come first.
    return mi.load_dict({"type": "aov", "aovs": "nothing:shape_index", **nested})


def accumulate(scene: Any, *, seed: int, frame: int, stream: int, first: int, count: int, max_depth: int) -> Light:
    """The sums of the passes ``first`` to ``first + count`` of one stream; see :func:`wavefront.accumulate`."""
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    integrator = _integrator(max_depth)
    total = no_light((height, width))
    render: Any = mi.render
    for index in range(first, first + count):
        seed_of_pass = pass_seed(seed, frame, stream, index)
        image = np.array(render(scene, integrator=integrator, spp=1, seed=seed_of_pass), np.float64)
        whole, two, one = image[..., 0:3], image[..., 3:6], image[..., 6:9]
        finite = np.isfinite(image).all(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            # The film adds in float32: a last-digit difference of two equal sums must not become a negative light.
            direct, indirect = np.maximum(two - one, 0.0), np.maximum(whole - two, 0.0)
        one, direct, indirect = (np.where(finite, part, 0.0) for part in (one, direct, indirect))
        total = total.plus(Light(one, direct, indirect, int(np.sum(~finite))))
    return total
