"""Temporal accumulation: what the network sees of the history, the running mean of light, and its fireflies.

In the order of a frame: history and frame become the network's input; the frame is blended into the mean with the
shares that the network predicts; what the filter leaves of a firefly is darkened, as far as the mean is not sure of it;
mean and image become the next frame's history.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.filters import clamping
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.scales import downsample, pad, space_to_depth, to_planes

CHANNELS = 20
"""Of light; those of surfaces come first, four for each."""
DARK = 1e-3
"""Light at the network's brightness that is as good as dark."""
_SOME = 1.5
"""Effective number of frames from which on their deviation tells how sure a mean is."""
_DEVIATIONS = 2.0
"""Of the mean's own error that a history is not sure of."""
_FAINTEST = 1e-6
"""Brightness of a mean that is as good as none."""
_LEAST_VARIANCE = 1e-12
"""With a slope of the deviation at 0."""


class History(NamedTuple):
    """What is known of earlier frames."""

    values: jax.Array
    """[H, W, 8] the running mean of light (3) and of its luminance's square, the effective number of samples, the last
    output (3); 0 where nothing is known."""
    valid: jax.Array
    """[H, W] bool, something is."""


@operation
def assemble_network_input(
    geometry: tuple[jax.Array, ...],
    noisy: jax.Array,
    history: History,
    hit: jax.Array,
    gain: jax.Array,
    *,
    multiple: int,
) -> jax.Array:
    """[h, w, C] by blocks of 2x2 pixels, its sides padded by the edge to multiples of ``multiple``.

    Light, times ``gain`` and compressed (:func:`jaxdn.color.compress`), is that of the noisy frame, of the mean and of
    the last output, the noisy one where there is no history: means of blocks, then the four luminances of the first and
    the last. Between these stand the means of the standard deviation of luminance relative to its mean, of
    1 / (1 + N), and of whether there is a surface.

    Args:
      geometry: [H, W, c] each; all four pixels of a block are seen.
      noisy: [H, W, 3] linear light >= 0; H and W are even.
      history: of earlier frames.
      hit: [H, W] bool, there is a surface.
      gain: scalar.
      multiple: see above.
    """
    mean, square, number, shown = jnp.split(history.values, (3, 4, 5), axis=-1)
    level = color.luminance(mean)
    spread = jnp.sqrt(jnp.maximum(square - level**2, 0.0) + 1e-12) / (level + DARK / gain)
    facts = [jnp.minimum(spread, 8.0) / 8.0, 1.0 / (1.0 + number), hit[..., None].astype(noisy.dtype)]
    recent = (jnp.where(history.valid[..., None], one, noisy) for one in (mean, shown))
    light = [color.compress(gain * one) for one in (noisy, *recent)]
    corners = [space_to_depth(color.luminance(light[index])) for index in (0, 2)]
    # One by one: XLA:CPU does not vectorise what it writes side by side.
    found = [*map(space_to_depth, geometry), *map(downsample, [*light, *facts]), *corners]
    return pad(jnp.concatenate(found, axis=-1), multiple)


@numba_call.implements(assemble_network_input)
def _assemble_network_input_by_numba(
    geometry: tuple[jax.Array, ...],
    noisy: jax.Array,
    history: History,
    hit: jax.Array,
    gain: jax.Array,
    *,
    multiple: int,
) -> jax.Array:
    from jaxdn.methods.steady.numba_kernels import assemble_network_input

    height, width = (side // 2 + -(side // 2) % multiple for side in noisy.shape[:2])
    channels = 4 * sum(each.shape[-1] for each in geometry) + CHANNELS
    numbers = (np.float32(value) for value in (DARK, *color.CURVE))
    arrays: list[numba_call.Given] = [geometry, noisy, *history, hit, jnp.reshape(gain, (1,))]
    weights = np.asarray(color.LUMINANCE, np.float32)
    return numba_call.call(assemble_network_input, [(height, width, channels)], arrays, weights, *numbers, rows=height)[
        0
    ]


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
    from jaxdn.methods.steady.numba_kernels import update_mean

    height, width = hit.shape
    shapes = [(3, height, width), (height, width), (height, width), (3, height // 2, width // 2)]
    numbers = np.asarray(color.LUMINANCE, np.float32), np.float32(most)
    return RunningMean(
        *numba_call.call(update_mean, shapes, [noisy, *history, hit, follow], *numbers, rows=height // 2)
    )


@operation
def suppress_fireflies(image: jax.Array, hit: jax.Array, mean: RunningMean) -> jax.Array:
    """The image [3, H, W] >= 0 with :func:`jaxdn.filters.clamping.firefly_attenuation` by the mean of its channels.

    Of what the history shows a pixel is sure but for two deviations of the mean; of a single frame, of nothing. ``hit``
    [H, W] bool: a surface is seen.
    """
    level = color.luminance_of_planes(mean.light)
    variance = jnp.maximum(mean.square - level**2, 0.0) / jnp.maximum(mean.sample_count, 1.0)
    deviation = jnp.sqrt(variance + _LEAST_VARIANCE)
    sure = jnp.where(mean.sample_count > _SOME, 1.0 - _DEVIATIONS * deviation / jnp.maximum(level, _FAINTEST), 0.0)
    return image * clamping.firefly_attenuation((image[0] + image[1] + image[2]) / 3.0, hit, sure)[None]


@numba_call.implements(suppress_fireflies)
def _suppress_fireflies_by_numba(image: jax.Array, hit: jax.Array, mean: RunningMean) -> jax.Array:
    from jaxdn.methods.steady.numba_kernels import suppress_fireflies

    weights = np.asarray(color.LUMINANCE, np.float32)
    numbers = (np.float32(number) for number in (clamping.DARK, _SOME, _DEVIATIONS, _FAINTEST, _LEAST_VARIANCE))
    arrays = [image, hit, mean.light, mean.square, mean.sample_count]
    return numba_call.call(suppress_fireflies, [image.shape], arrays, weights, *numbers, rows=hit.shape[0])[0]


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
    from jaxdn.methods.steady.numba_kernels import update_history

    arrays = [*mean[:3], *shown, *history, feedback, blend]
    return numba_call.call(update_history, [history.values.shape], arrays, np.float32(most), rows=feedback.shape[0])[0]


def draw_history(rng: np.random.Generator, height: int, width: int) -> History:
    """A history of which a fifth is not known, in NumPy's float64."""
    valid: Any = rng.random((height, width)) > 0.2
    values: Any = rng.random((height, width, 8)) + np.array([0.0, 0, 0, 2, 1, 0, 0, 0])
    return History(values * valid[..., None], valid)


@assemble_network_input.example
def _assemble_network_input_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + height % 2, width + width % 2
    geometry = rng.normal(size=(height, width, 3)), rng.random((height, width, 1))
    light, hit = 10.0 ** rng.uniform(-4, 4, (height, width, 3)), rng.random((height, width)) > 0.1
    history = draw_history(rng, height, width)
    yield Example((geometry, light, history, hit, np.array(0.5)), {"multiple": 16})


@update_mean.example
def _update_mean_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + height % 2, width + width % 2
    light, hit = rng.random((height, width, 3)), rng.random((height, width)) > 0.1
    history = draw_history(rng, height, width)
    yield Example((light, history, hit, rng.uniform(0.1, 0.9, (height, width))), {"most": 20.0})


@suppress_fireflies.example
def _suppress_fireflies_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    light: Any = rng.random((3, height, width)) ** 8
    square = np.einsum("c,cyx->yx", color.LUMINANCE, light) ** 2 * rng.uniform(0.9, 1.5, (height, width))
    number: Any = rng.choice([1.0, 2.0, 30.0], (height, width))
    hit = rng.random((height, width)) > 0.2
    yield Example((light * rng.uniform(0.5, 2, light.shape), hit, RunningMean(light, square, number, light)))


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
