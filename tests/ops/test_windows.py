"""Means over windows and smoothing: what numbers elsewhere in the image have to do with it, which is nothing."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops.dispatch.operation import REFERENCE
from jaxdn.ops.windows import smooth, window_means

TAPS = (0.375, 0.25, 0.0625)
FILTERS = {
    "a window": (partial(window_means, radius=4), 4),
    "a wide window": (partial(window_means, radius=15), 15),
    "smoothing": (partial(smooth, taps=TAPS, step=4), 8),
}
"""What it is, and how many pixels it reaches."""


@pytest.mark.parametrize("name", FILTERS)
def test_a_part_of_an_image_gives_the_same_bits(rng, name):
    """Wherever it begins: a frame in tiles is the frame."""
    function, reach = FILTERS[name]
    image = rng.standard_normal((2, 61, 75)).astype(np.float32)
    run = jax.jit(function)
    part = np.asarray(run(image[:, 3:56, 5:70]))
    inside = np.s_[:, reach : 53 - reach, reach : 65 - reach]
    np.testing.assert_array_equal(part[inside], np.asarray(run(image))[:, 3:56, 5:70][inside])


@pytest.mark.parametrize("value", [1e30, np.inf, np.nan])
@pytest.mark.parametrize("name", FILTERS)
def test_a_pixel_decides_nothing_beyond_its_reach(rng, name, value):
    """Sums that run along rows would carry the rounding of the largest of all numbers with them."""
    function, reach = FILTERS[name]
    image = rng.random((1, 60, 80)).astype(np.float32)
    run = jax.jit(function)
    before = np.asarray(run(image))
    image[0, 20, 30] = value
    rows, columns = np.mgrid[:60, :80]
    away = (abs(rows - 20) > reach) | (abs(columns - 30) > reach)
    np.testing.assert_array_equal(np.asarray(run(image))[0][away], before[0][away])


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (2, 9), (7, 3)])
@pytest.mark.parametrize("name", FILTERS)
def test_images_smaller_than_the_reach(rng, name, size):
    """Borders that are mirrored more than once, windows of which most is outside."""
    function, reach = FILTERS[name]
    image = rng.random((1, *size))
    if name == "smoothing":
        wide = np.pad(image[0], reach, mode="symmetric")
        line = np.array([TAPS[abs(k)] for k in range(-2, 3)])
        wanted = [
            [line @ wide[y : y + 2 * reach + 1 : 4, x : x + 2 * reach + 1 : 4] @ line for x in range(size[1])]
            for y in range(size[0])
        ]
    else:
        wanted = [
            [
                image[0, max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1].mean()
                for x in range(size[1])
            ]
            for y in range(size[0])
        ]
    for implementation in (None, REFERENCE):
        found = jax.jit(partial(function, implementation=implementation))(jnp.asarray(image, jnp.float32))
        np.testing.assert_allclose(found[0], wanted, rtol=1e-6)
