"""The networks: each is an ``init`` and an ``apply`` on plain nested dicts.

Only modules of this package import Flax; what a denoiser needs before it builds a network is defined here.
"""

import jax
import jax.numpy as jnp

LEVELS = 5
MULTIPLE = 2 ** (LEVELS - 1)
"""Height and width of the network's input are multiples of this."""

Widths = tuple[tuple[int, ...], ...]

LARGE: Widths = ((32, 32), (64, 64), (64, 64), (80, 80), (96, 96))
"""Channels of each convolution, level by level from full resolution down; the decoder mirrors the first four."""

SMALL: Widths = ((16,), (32, 32), (48, 48), (64, 64), (64, 64))
"""About a third of LARGE's time. LARGE spends most time at full resolution, so SMALL is reduced there."""


def pad(image: jax.Array, multiple: int = MULTIPLE) -> jax.Array:
    """[H, W, C] with height and width made multiples of ``multiple`` by repeating the last row and column."""
    height, width = image.shape[:2]
    below, right = -height % multiple, -width % multiple
    return jnp.pad(image, ((0, below), (0, right), (0, 0)), mode="edge") if below or right else image


def crop(image: jax.Array, size: tuple[int, int]) -> jax.Array:
    """The first rows and columns, ``size`` of them: the inverse of :func:`pad`."""
    return image[: size[0], : size[1]]
