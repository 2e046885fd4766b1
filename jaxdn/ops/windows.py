"""Means over windows, and smoothing with few taps that may lie far apart: what separable filters of whole images need.

XLA:CPU computes what goes into such a sum again for each of its taps where it fuses them. A compiled loop adds up each
row once, and along the row by doubling: sums of 1, 2, 4 ... neighbours.
"""

import functools
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.separable import correlate
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation


def window_means(image: jax.Array, radius: int, *, implementation: str | None = None) -> jax.Array:
    """Means over windows of 2 radius + 1 pixels a side, of what of them is in the planes [C, H, W]."""
    return _window_means(jnp.asarray(image), radius=radius, implementation=implementation)


@operation(name="window_means")
def _window_means(image: jax.Array, *, radius: int) -> jax.Array:
    """:func:`window_means` of planes [C, H, W]."""
    around = ((0, 0), (radius, radius), (radius, radius), (0, 0))
    sums, number = (jnp.pad(one[..., None], around) for one in (image, jnp.ones_like(image[:1])))
    for axis in (-3, -2):
        sums, number = (correlate(one, np.ones((2 * radius + 1, 1)), axis=axis) for one in (sums, number))
    return (sums / number)[..., 0]


@numba_call.implements(_window_means)
def _window_means_by_numba(image: jax.Array, *, radius: int) -> jax.Array:
    from jaxdn.ops.numba_windows import mean_rows

    return numba_call.call(mean_rows, [image.shape], [image], radius, rows=image.shape[1])[0]


def smooth(image: jax.Array, taps: Sequence[float], step: int, *, implementation: str | None = None) -> jax.Array:
    """Planes [C, H, W] filtered along both axes with 5 taps that are ``step`` pixels apart.

    The image is mirrored at its border, the last pixel included.

    Args:
      image: [C, H, W].
      taps: 3, from the centre outwards; the other two are the same.
      step: at least 1.
      implementation: see :mod:`jaxdn.ops.dispatch.operation`.
    """
    return _smooth(jnp.asarray(image), taps=tuple(map(float, taps)), step=step, implementation=implementation)


@operation(name="smooth")
def _smooth(image: jax.Array, *, taps: tuple[float, ...], step: int) -> jax.Array:
    """:func:`smooth` of an array."""
    for axis in (1, 2):
        widths = [(0, 0)] * 3
        widths[axis] = (2 * step, 2 * step)
        wide, length = jnp.pad(image, widths, mode="symmetric"), image.shape[axis]
        parts = [jax.lax.slice_in_dim(wide, k * step, k * step + length, axis=axis) for k in range(5)]
        image = functools.reduce(jnp.add, (taps[abs(k - 2)] * part for k, part in enumerate(parts)))
    return image


@numba_call.implements(_smooth)
def _smooth_by_numba(image: jax.Array, *, taps: tuple[float, ...], step: int) -> jax.Array:
    from jaxdn.ops.numba_windows import smooth_rows

    constants = tuple(map(np.float32, taps)), step
    return numba_call.call(smooth_rows, [image.shape], [image], *constants, rows=image.shape[1])[0]


@_window_means.example
def _window_means_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for planes, radius in ((1, 2), (3, 7)):
        yield Example((rng.random((planes, height, width)),), {"radius": radius})


@_smooth.example
def _smooth_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for planes, step in ((1, 8), (3, 2)):
        yield Example((rng.standard_normal((planes, height, width)),), {"taps": (0.375, 0.25, 0.0625), "step": step})
