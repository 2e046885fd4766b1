"""What a denoiser changed: its outliers bounded, and how it is curved, from which noise is measured.

Colours are planes, [C, H, W]. XLA:CPU computes these again in every sum that they go into, so that compiled loops
compute them once.
"""

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.medians import median_3x3

_MOST = 1e8
"""A size of which the fourth power is finite."""
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))


def winsorize(change: jax.Array, bound: float, *, implementation: str | None = None) -> tuple[jax.Array, jax.Array]:
    """A change [3, H, W] within ``bound``, or the median size of the 3x3 around if that is more; and where it was.

    The latter is [1, H, W], 1 where all colours were within that and 0 elsewhere.
    """
    return _winsorize(change, bound=bound, implementation=implementation)


@operation(name="winsorize")
def _winsorize(change: jax.Array, *, bound: float) -> tuple[jax.Array, jax.Array]:
    """:func:`winsorize` of planes."""
    limit = jnp.maximum(median_3x3(mean(jnp.abs(change))[0])[None], bound)
    bounded = jnp.clip(jnp.clip(change, -limit, limit), -_MOST, _MOST)
    return bounded, jnp.all(jnp.abs(change) <= limit, axis=0, keepdims=True).astype(change.dtype)


@numba_call.implements(_winsorize)
def _winsorize_by_numba(change: jax.Array, *, bound: float) -> tuple[jax.Array, jax.Array]:
    from jaxdn.sequence.numba_change import winsorize_rows

    shapes, limits = [change.shape, (1, *change.shape[1:])], (np.float32(bound), np.float32(_MOST))
    bounded, common = numba_call.call(winsorize_rows, shapes, [change], *limits, rows=change.shape[1])
    return bounded, common


@operation
def second_differences(change: jax.Array) -> jax.Array:
    """[4, H, W] the squares of second differences of planes [C, H, W] along each direction; of noise the mean is V."""
    height, width = change.shape[1:]
    # Mirrored: repeated pixels at the border would look smooth.
    padded = jnp.pad(change, ((0, 0), (1, 1), (1, 1)), mode="reflect")

    def at(dy: int, dx: int) -> jax.Array:
        return padded[:, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    return jnp.concatenate([mean_square(at(dy, dx) - 2 * change + at(-dy, -dx)) / 6 for dy, dx in _DIRECTIONS])


@numba_call.implements(second_differences)
def _second_differences_by_numba(change: jax.Array) -> jax.Array:
    from jaxdn.sequence.numba_change import curve_rows

    return numba_call.call(curve_rows, [(len(_DIRECTIONS), *change.shape[1:])], [change], rows=change.shape[1])[0]


@_winsorize.example
def _winsorize_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    yield Example((3 * rng.standard_normal((3, height, width)),), {"bound": 3.0})


@second_differences.example
def _second_differences_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for channels in (1, 3):
        yield Example((rng.standard_normal((channels, height, width)),))


def mean_square(image: jax.Array) -> jax.Array:
    """[1, H, W] over the colours."""
    return mean(image**2)


def mean(image: jax.Array) -> jax.Array:
    """[1, H, W] over the colours, plane by plane: XLA:CPU does not vectorise a reduction."""
    return functools.reduce(jnp.add, jnp.split(image, len(image))) / len(image)
