"""The light that a history lacks: a change that is too even to be noise.

A running mean follows light with a delay: a shadow that moves, a lamp that fades, a thing that rolls out of the sun. To
blend new frames in faster would bring back the noise that the mean has got rid of. But what changes is smooth, mostly,
and what is smooth can be told from one noisy frame: the frame's difference from the mean, filtered along surfaces, is
added to the mean at once; details stay those of the mean.

How much of it is noise is told by the same difference under signs that alternate: of noise that no two pixels share a
filter leaves as much with signs as without, of an even change nothing. Where D is the filtered difference and E that
with signs, a share ``max(0, 1 - k <E^2> / <D^2>)`` of D is taken, with means over a wide window of squares relative to
the light: for k = 1 the positive part of the estimator of James and Stein (1961), here for a region. The share is one
half of the pixels', the black squares of a checkerboard, and what it is taken of is the other's, and the other way
round. For light is skewed, many dark samples and few bright ones: a share that knows the bright ones, and is 0 where
they are, takes the dark ones for a change, and darkens the image.

Schied et al. 2018 ("Gradient Estimation for Real-Time Adaptive Temporal Filtering") ask the same question of samples
that are traced twice.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.color import luminance_of_planes
from jaxdn.ops.affinity.filter import Guide, affinity_filter

_SURE = 1.5
"""k. More takes less for a change, which loses a part of it; less lets smooth walls flicker."""
_WINDOW = 8, 16
"""Distances of the taps of the two filters that are the window: 48 pixels to either side. What noise leaves after the
filter are clouds some 25 pixels wide: a smaller window, which knows few of them, takes more of them for changes."""
_NOTHING = 1e-12


def split_checkerboard(difference: jax.Array) -> jax.Array:
    """[8, H, W] the difference [3, H, W] at black squares; at white; luminance of both, its sign new in each row."""
    # Not jnp.indices, which has to know the size: an exported step serves all.
    rows, columns = (lax.broadcasted_iota(jnp.int32, difference.shape[1:], axis) for axis in (0, 1))
    white, down = _odd(rows + columns), _odd(rows)
    black, white = jnp.where(white[None], 0.0, difference), jnp.where(white[None], difference, 0.0)
    level = jnp.stack([luminance_of_planes(black), luminance_of_planes(white)])
    return jnp.concatenate([black, white, jnp.where(down[None], -level, level)])


def _odd(numbers: jax.Array) -> jax.Array:
    """Of integers >= 0; by a shift, as ONNX is not made from remainders."""
    return 2 * lax.shift_right_logical(numbers, jnp.ones_like(numbers)) != numbers


def estimate_change(filtered: jax.Array, light: jax.Array, hit: jax.Array) -> jax.Array:
    """[3, H, W] the part of a filtered difference that is a change of light, between 0 and all of it.

    Args:
      filtered: [8, H, W] what :func:`split_checkerboard` made, after a filter.
      light: [3, H, W] >= 0 what the difference is one from, filtered likewise.
      hit: [H, W] bool, there is a surface; other pixels say nothing of noise.
    """
    black, white, signed = jnp.split(filtered, (3, 6))
    found = jnp.stack([luminance_of_planes(black), luminance_of_planes(white)])
    level = luminance_of_planes(light) + jnp.abs(found[0]) + jnp.abs(found[1]) + _NOTHING
    squares = jnp.square(jnp.concatenate([found, signed]) / level[None])
    size = squares.shape[1:]
    alike = Guide(jnp.zeros((1, *size), squares.dtype), jnp.zeros((3, *size), squares.dtype), hit * 1.0)
    for step in _WINDOW:
        squares = affinity_filter(squares, alike, step=step)
    of_black, of_white = jnp.maximum(1.0 - _SURE * squares[2:] / (squares[:2] + _NOTHING), 0.0)
    return of_white[None] * black + of_black[None] * white


def receptive_field() -> int:
    """How far :func:`estimate_change` sees, in pixels."""
    return 2 * sum(_WINDOW)
