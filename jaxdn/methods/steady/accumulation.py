"""Temporal accumulation: the running mean of light, its effective number of samples, and the history's update."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.layout.planar import to_planes
from jaxdn.ops.scales import downsample


class History(NamedTuple):
    """What is known of earlier frames."""

    values: jax.Array
    """[H, W, 8] the running mean of light (3) and of its luminance's square, the effective number of samples, the last
    output (3); 0 where nothing is known."""
    valid: jax.Array
    """[H, W] bool, something is."""


class RunningMean(NamedTuple):
    """The mean with the newest frame in it, as planes."""

    light: jax.Array
    """[3, H, W]."""
    square: jax.Array
    """[H, W] the mean of the luminance's square."""
    sample_count: jax.Array
    """[H, W] effective number of samples, in frames."""
    residual: jax.Array
    """[3, H/2, W/2] how much more the newest frame shows than the mean, by blocks; 0 where there is no surface."""


@operation
def update_mean(noisy: jax.Array, history: History, hit: jax.Array, follow: jax.Array, *, most: float) -> RunningMean:
    """The mean of the history and the noisy frame [H, W, 3], whose sides are even.

    In the mean of N frames and a new one, the new one has the weight 1 / (N + 1); ``follow`` [H, W] = 1/2 keeps that,
    and its logit is added to that of the weight. With weights 1 - a and a, the variance is ``(1 - a)^2 / N + a^2`` of a
    frame's: the effective number is its inverse, but at most ``most``. ``hit`` [H, W] bool: there is a surface.
    """
    values, valid = to_planes(history.values), history.valid
    # The odds of 1 / (N + 1) are 1 to N.
    count = jnp.maximum(values[4], 1e-6)
    share = jnp.where(valid, follow / (follow + count * (1.0 - follow)), 1.0)
    now = jnp.concatenate([to_planes(noisy), color.luminance(noisy)[None, ..., 0] ** 2])
    then = jnp.where(valid[None], values[:4], now)
    mixed = then + share[None] * (now - then)
    variance = jnp.square(1.0 - share) / count + share**2
    number = jnp.where(valid, jnp.minimum(1.0 / variance, most), 1.0)
    residual = jnp.where(hit[None], now[:3] - mixed[:3], 0.0)
    return RunningMean(mixed[:3], mixed[3], number, to_planes(downsample(residual.transpose(1, 2, 0))))


@numba_call.implements(update_mean)
def _update_mean_by_numba(
    noisy: jax.Array, history: History, hit: jax.Array, follow: jax.Array, *, most: float
) -> RunningMean:
    from jaxdn.methods.steady.numba_accumulation import update_mean

    height, width = hit.shape
    shapes = [(3, height, width), (height, width), (height, width), (3, height // 2, width // 2)]
    numbers = np.asarray(color.LUMINANCE, np.float32), np.float32(most)
    return RunningMean(
        *numba_call.call(update_mean, shapes, [noisy, *history, hit, follow], *numbers, rows=height // 2)
    )


class FilteredLight(NamedTuple):
    """The mean after the spatial filter, as planes [3, H, W]."""

    fine: jax.Array
    """Of which the mean takes a share."""
    image: jax.Array
    """Of which the last output takes a share."""
    change: jax.Array | None
    """What is added to both, as they were; None for nothing."""


@operation
def update_history(
    mean: RunningMean, shown: FilteredLight, history: History, feedback: jax.Array, blend: jax.Array, *, most: float
) -> jax.Array:
    """The values of the next frame's :class:`History`, [H, W, 8].

    The mean takes the share ``feedback`` [H, W] of the fine image; the last output, between 0 and ``most``, the share
    ``blend`` [H, W] of the image, all of it where there was no history.
    """
    change = jnp.zeros_like(shown.image) if shown.change is None else shown.change
    before = to_planes(history.values)[5:] + change
    newest = jnp.where(history.valid, blend, 1.0)[None]
    output = jnp.clip(before + newest * (shown.image - before), 0.0, most)
    kept = jnp.maximum(mean.light + feedback[None] * (shown.fine - mean.light) + change, 0.0)
    return jnp.concatenate([kept, mean.square[None], mean.sample_count[None], output]).transpose(1, 2, 0)


@numba_call.implements(update_history)
def _update_history_by_numba(
    mean: RunningMean, shown: FilteredLight, history: History, feedback: jax.Array, blend: jax.Array, *, most: float
) -> jax.Array:
    from jaxdn.methods.steady.numba_accumulation import update_history

    arrays = [*mean[:3], *shown, *history, feedback, blend]
    return numba_call.call(update_history, [history.values.shape], arrays, np.float32(most), rows=feedback.shape[0])[0]


def draw_history(rng: np.random.Generator, height: int, width: int) -> History:
    """A history of which a fifth is not known, in NumPy's float64."""
    valid: Any = rng.random((height, width)) > 0.2
    values: Any = rng.random((height, width, 8)) + np.array([0.0, 0, 0, 2, 1, 0, 0, 0])
    return History(values * valid[..., None], valid)


@update_mean.example
def _update_mean_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + height % 2, width + width % 2
    light, hit = rng.random((height, width, 3)), rng.random((height, width)) > 0.1
    history = draw_history(rng, height, width)
    yield Example((light, history, hit, rng.uniform(0.1, 0.9, (height, width))), {"most": 20.0})


@update_history.example
def _update_history_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + height % 2, width + width % 2
    planes = rng.uniform(-0.1, 2, (4, 3, height, width))
    square, number, feedback, blend = rng.random((4, height, width))
    history: Any = draw_history(rng, height, width)
    mean: Any = planes[0], square, number, np.zeros((3, height // 2, width // 2))
    for change in (None, planes[3]):
        shown: Any = planes[1], planes[2], change
        yield Example((RunningMean(*mean), FilteredLight(*shown), history, feedback, blend), {"most": 1.5})
