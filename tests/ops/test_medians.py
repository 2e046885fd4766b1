"""Medians without sorting: to the last bit those of NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops import medians

median, median_3x3, median_of_nine = map(jax.jit, (medians.median, medians.median_3x3, medians.median_of_nine))


@pytest.mark.parametrize("number", [1, 2, 3, 10, 1001, 4096])
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e37])
def test_a_median_is_that_of_a_sort(rng, number, scale):
    values = (scale * rng.gamma(0.3, 1, number)).astype(np.float32)
    ordered = np.sort(values)
    low, high = ordered[(number - 1) // 2], ordered[number // 2]
    wanted = low if low == high else np.float32(0.5) * low + np.float32(0.5) * high
    np.testing.assert_array_equal(median(values), wanted)


def test_ties_zeros_and_infinities(rng):
    """Values that occur often, and the ends of the range."""
    values = rng.choice(np.array([0.0, -0.0, 1.0, 2.0, np.inf], np.float32), (30, 41))
    assert float(median(values)) == float(np.median(np.abs(values)))
    assert float(median(jnp.zeros((3, 5)))) == 0.0
    assert float(median(jnp.full((3, 4), jnp.inf))) == np.inf


def test_only_what_counts_is_counted(rng):
    """NaN may stand where nothing counts; where nothing does, the median is 0."""
    values = rng.uniform(0, 9, (17, 23)).astype(np.float32)
    counted = rng.uniform(size=values.shape) < 0.3
    wanted = np.median(values[counted])
    np.testing.assert_allclose(median(np.where(counted, values, np.nan), counted), wanted, rtol=1e-7)
    assert float(median(values, jnp.zeros(values.shape, bool))) == 0.0
    with pytest.raises(ValueError, match=r"counted: expected the shape \(17, 23\) of values, got \(17, 1\)"):
        median(values, jnp.ones((17, 1), bool))


def test_nine_images(rng):
    images = rng.standard_normal((9, 40, 50)).astype(np.float32).round(1)
    np.testing.assert_array_equal(median_of_nine(list(images)), np.median(images, axis=0))


@pytest.mark.parametrize("size", [(1, 1), (1, 6), (2, 3), (15, 16)])
def test_windows(rng, size):
    image = rng.standard_normal(size).astype(np.float32)
    wide = np.pad(image, 1, mode="edge")
    wanted = [[np.median(wide[y : y + 3, x : x + 3]) for x in range(size[1])] for y in range(size[0])]
    np.testing.assert_array_equal(median_3x3(jnp.asarray(image)), np.asarray(wanted, np.float32))
