"""Firefly suppression: what the filter leaves of a firefly is a single bright pixel, which is darkened."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.color import LUMINANCE, luminance_of_planes
from jaxdn.filters.clamping import DARK, firefly_attenuation
from jaxdn.methods.steady.accumulation import RunningMean
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation

_SOME = 1.5
"""Effective number of frames from which on their deviation tells how sure a mean is."""
_DEVIATIONS = 2.0
"""Of the mean's own error that a history is not sure of."""
_FAINTEST = 1e-6
"""Brightness of a mean that is as good as none."""
_LEAST_VARIANCE = 1e-12
"""With a slope of the deviation at 0."""


@operation
def suppress_fireflies(image: jax.Array, hit: jax.Array, mean: RunningMean) -> jax.Array:
    """The image [3, H, W] >= 0 with :func:`jaxdn.filters.clamping.firefly_attenuation` by the mean of its channels.

    Of what the history shows a pixel is sure but for two deviations of the mean; of a single frame, of nothing. ``hit``
    [H, W] bool: a surface is seen.
    """
    level = luminance_of_planes(mean.light)
    variance = jnp.maximum(mean.square - level**2, 0.0) / jnp.maximum(mean.sample_count, 1.0)
    deviation = jnp.sqrt(variance + _LEAST_VARIANCE)
    sure = jnp.where(mean.sample_count > _SOME, 1.0 - _DEVIATIONS * deviation / jnp.maximum(level, _FAINTEST), 0.0)
    return image * firefly_attenuation((image[0] + image[1] + image[2]) / 3.0, hit, sure)[None]


@numba_call.implements(suppress_fireflies)
def _suppress_fireflies_by_numba(image: jax.Array, hit: jax.Array, mean: RunningMean) -> jax.Array:
    from jaxdn.methods.steady.numba_fireflies import suppress_fireflies

    weights = np.asarray(LUMINANCE, np.float32)
    numbers = (np.float32(number) for number in (DARK, _SOME, _DEVIATIONS, _FAINTEST, _LEAST_VARIANCE))
    arrays = [image, hit, mean.light, mean.square, mean.sample_count]
    return numba_call.call(suppress_fireflies, [image.shape], arrays, weights, *numbers, rows=hit.shape[0])[0]


@suppress_fireflies.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    light: Any = rng.random((3, height, width)) ** 8
    square = np.einsum("c,cyx->yx", LUMINANCE, light) ** 2 * rng.uniform(0.9, 1.5, (height, width))
    number: Any = rng.choice([1.0, 2.0, 30.0], (height, width))
    hit = rng.random((height, width)) > 0.2
    yield Example((light * rng.uniform(0.5, 2, light.shape), hit, RunningMean(light, square, number, light)))
