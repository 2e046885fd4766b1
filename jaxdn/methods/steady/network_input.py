"""The input of a network at half resolution: surfaces, all four pixels of a block; light, mostly their mean."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.methods.steady.accumulation import History, draw_history
from jaxdn.networks import pad
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.scales import downsample, space_to_depth

CHANNELS = 20
"""Of light; those of surfaces come first, four for each."""
DARK = 1e-3
"""Light at the network's brightness that is as good as dark."""


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
    from jaxdn.methods.steady.numba_network_input import assemble_network_input

    height, width = (side // 2 + -(side // 2) % multiple for side in noisy.shape[:2])
    channels = 4 * sum(each.shape[-1] for each in geometry) + CHANNELS
    numbers = (np.float32(value) for value in (DARK, *color.CURVE))
    arrays: list[numba_call.Given] = [geometry, noisy, *history, hit, jnp.reshape(gain, (1,))]
    weights = np.asarray(color.LUMINANCE, np.float32)
    return numba_call.call(assemble_network_input, [(height, width, channels)], arrays, weights, *numbers, rows=height)[
        0
    ]


@assemble_network_input.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    height, width = height + height % 2, width + width % 2
    geometry = rng.normal(size=(height, width, 3)), rng.random((height, width, 1))
    light, hit = 10.0 ** rng.uniform(-4, 4, (height, width, 3)), rng.random((height, width)) > 0.1
    history = draw_history(rng, height, width)
    yield Example((geometry, light, history, hit, np.array(0.5)), {"multiple": 16})
