"""Joint bilateral upsampling: a coarse image at twice the size, its edges taken from guides at full resolution.

Kopf et al. 2007, "Joint Bilateral Upsampling". Bilinear enlarging carries light across silhouettes, and adding only
what the coarse image changed leaves noise of two to four pixels in the fine one.
"""

import math

import jax
import jax.numpy as jnp

from jaxdn.ops.affinity_filter import Guide

_SPREAD = 3.0
"""Twice the variance of the spatial weights, in pixels of the fine image."""


def enlarge(coarse: jax.Array, there: Guide, here: Guide) -> tuple[jax.Array, jax.Array]:
    """The coarse image [C, h, w] as [C, 2h, 2w], and the sum of weights [2h, 2w] in [0, 1].

    Every fine pixel takes the mean of the 3x3 coarse pixels around it, weighted by their distance, confidence and
    affinity as in :mod:`jaxdn.ops.affinity_filter`. ``there`` guides the coarse pixels, ``here`` the fine ones (its
    confidence is not used). The slanted guide of a coarse pixel is that of the upper left of its four pixels, and its
    slopes are those per fine pixel. Where no coarse pixel is alike, the sum of weights is 0 and so is the image.
    """
    channels, height, width = coarse.shape

    def around(planes: jax.Array, mode: str) -> jax.Array:
        pads = ((0, 0), (1, 1), (1, 1))
        return jnp.pad(planes, pads, mode="edge") if mode == "edge" else jnp.pad(planes, pads)

    guides = around(jnp.concatenate([there.features, there.slanted]), "edge")
    mass = around(jnp.concatenate([coarse * there.confidence[None], there.confidence[None]]), "zero")
    count = there.features.shape[0]
    phases = []
    for py in (0, 1):
        for px in (0, 1):
            own, slanted = here.features[:, py::2, px::2], here.slanted[:, py::2, px::2]
            total = jnp.zeros((channels + 1, height, width), coarse.dtype)
            full = 0.0
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):
                    window = guides[:, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
                    # The centre of a coarse pixel lies between its four; its slanted guide is that of the first.
                    away_y, away_x = 2 * dy + 0.5 - py, 2 * dx + 0.5 - px
                    spatial = math.exp(-(away_y**2 + away_x**2) / _SPREAD)
                    sy, sx = 2 * dy - py, 2 * dx - px
                    expected = 0.5 * (sx * (slanted[1] + window[count + 1]) + sy * (slanted[2] + window[count + 2]))
                    distance = jnp.square(window[count] - slanted[0] - expected)
                    distance = distance + jnp.sum(jnp.square(window[:count] - own), axis=0)
                    weight = spatial * jnp.exp(-distance)
                    total = total + weight[None] * mass[:, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
                    full += spatial
            phases.append(total / full)
    blocks = jnp.stack(phases).reshape(2, 2, channels + 1, height, width)
    found = blocks.transpose(2, 3, 0, 4, 1).reshape(channels + 1, 2 * height, 2 * width)
    weight = found[-1]
    some = weight > 1e-6
    return jnp.where(some[None], found[:-1] / jnp.where(some, weight, 1.0)[None], 0.0), jnp.where(some, weight, 0.0)
