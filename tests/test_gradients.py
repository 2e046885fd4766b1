"""The check of gradients finds a wrong one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.gradients import check_gradients

pytestmark = pytest.mark.usefixtures("x64")


def times(factor):
    """The product of two arrays and their sum, whose gradient by the first array is ``factor`` times too large."""

    @jax.custom_vjp
    def function(a, b):
        return a * b, a + b

    def backward(kept, cotangents):
        a, b = kept
        product, total = cotangents
        return factor * (product * b + total), product * a + total

    function.defvjp(lambda a, b: (function(a, b), (a, b)), backward)
    return function


def given(rng):
    return [jnp.asarray(rng.normal(size=(3, 4))) for _ in range(2)]


def test_a_right_gradient_passes(rng):
    check_gradients(times(1.0), given(rng))
    check_gradients(lambda tree: jnp.sin(tree["a"]) * tree["b"], [dict(zip("ab", given(rng), strict=True))])


def test_the_gradient_of_the_sum_of_results_is_returned(rng):
    a, b = given(rng)
    for found, expected in zip(check_gradients(times(1.0), (a, b)), (b + 1, a + 1), strict=True):
        np.testing.assert_allclose(found, expected)


def test_a_wrong_gradient_fails(rng):
    with pytest.raises(AssertionError):
        check_gradients(times(1.001), given(rng))
    check_gradients(times(1.001), given(rng), rtol=1e-2)
