"""Light as a network at half resolution sees it: compressed, by blocks of 2x2 pixels."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color
from jaxdn.compiled import strips
from jaxdn.ops.faster import alone
from jaxdn.scales import downsample, fold


def light_of_blocks(light: jax.Array, gain: jax.Array) -> jax.Array:
    """[H/2, W/2, 7] of linear ``light`` [H, W, 3] >= 0 times the scalar ``gain``, compressed (:func:`color.compress`).

    For every block the mean (3) and the luminances of its four pixels, row by row. Raises ValueError for odd sizes.
    """
    if strips.available() and light.dtype == jnp.float32 and not (light.shape[0] % 2 or light.shape[1] % 2):
        return alone(_light_of_blocks, _by_compiled)(light, gain)
    return _light_of_blocks(light, gain)


def _light_of_blocks(light: jax.Array, gain: jax.Array) -> jax.Array:
    seen = color.compress(gain * light)
    return jnp.concatenate([downsample(seen), fold(color.luminance(seen))], axis=-1)


def _by_compiled(light: jax.Array, gain: jax.Array) -> jax.Array:
    from jaxdn.compiled.blocks import seen

    height, width = light.shape[0] // 2, light.shape[1] // 2
    curve = (np.float32(value) for value in color.CURVE)
    numbers = np.asarray(color.LUMINANCE, np.float32), *curve
    arrays = [light, jnp.reshape(gain, (1,)).astype(jnp.float32)]
    return strips.call(seen, [(height, width, 7)], arrays, *numbers, rows=height)[0]
