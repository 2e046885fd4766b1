"""Powers and lengths: equal to the truth where it can be represented, finite with finite slopes everywhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxdn.numerics import absolute, safe_norm, safe_power

power = jax.jit(safe_power)
length = jax.jit(safe_norm)
power_and_slope = jax.jit(jax.vmap(jax.value_and_grad(safe_power), in_axes=(0, None)))
power_by_exponent = jax.jit(jax.vmap(jax.grad(safe_power, argnums=1), in_axes=(0, None)))
length_and_slope = jax.jit(jax.vmap(jax.value_and_grad(lambda v: safe_norm(v)[0])))


def magnitudes() -> np.ndarray:
    """0, subnormals, every decade of float32, its ends and infinity."""
    decades = np.array([10.0**exponent for exponent in range(-45, 39)], np.float32)
    ends = np.array([0.0, np.finfo(np.float32).tiny, np.finfo(np.float32).max, np.inf], np.float32)
    return np.sort(np.concatenate([ends, decades]))


@pytest.mark.parametrize("exponent", [0.0, 0.5, 0.7, 1.0])
def test_power_is_true_where_normal_and_finite_everywhere(exponent: float) -> None:
    x = magnitudes()
    value, slope = power_and_slope(x, exponent)
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))
    assert np.all(np.diff(value) >= 0)
    normal = (x > 2e-38) & np.isfinite(x)
    np.testing.assert_allclose(value[normal], x[normal].astype(np.float64) ** exponent, rtol=3e-6)
    assert value[0] == 0
    assert slope[0] == 0


def test_power_has_a_finite_derivative_by_its_exponent() -> None:
    slope = power_by_exponent(magnitudes(), 0.3)
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("other", ["zero", "same"])
def test_norm_is_true_where_normal_and_finite_everywhere(other: str) -> None:
    x = magnitudes()
    vectors = np.stack([x, np.zeros_like(x) if other == "zero" else x, np.zeros_like(x)], axis=-1)
    value, slope = length_and_slope(vectors)
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))
    normal = (x > 2e-38) & (x < 2e38)
    expected = np.linalg.norm(vectors[normal].astype(np.float64), axis=-1)
    np.testing.assert_allclose(value[normal], expected, rtol=1e-6)
    # the derivative of a length is the unit vector
    np.testing.assert_allclose(np.linalg.norm(slope[normal], axis=-1), 1.0, rtol=1e-5)
    assert np.all(slope[0] == 0)


def test_nan_stays_nan() -> None:
    assert np.isnan(power(jnp.float32(jnp.nan), 0.5))
    assert np.isnan(length(jnp.asarray([1.0, jnp.nan])))


def test_negative_arguments_of_a_power_count_as_zero() -> None:
    assert power(jnp.float32(-2.0), 0.5) == 0


def test_absolute_pulls_neither_way_at_zero() -> None:
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(absolute)))(jnp.asarray([-2.0, -0.0, 0.0, 3.0]))
    np.testing.assert_array_equal(value, [2, 0, 0, 3])
    np.testing.assert_array_equal(slope, [-1, 0, 0, 1])


def test_derivatives(x64: None, rng: np.random.Generator) -> None:
    x = rng.uniform(0.1, 2.0, (3, 4))
    check_grads(jax.jit(safe_power), (x, rng.uniform(0.2, 0.9, (3, 4))), order=2, modes=["rev"])
    check_grads(jax.jit(safe_norm), (x,), order=2, modes=["rev"])
