"""Powers and lengths: accurate where the true value can be represented, finite with finite slopes elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxdn.core.numerics import absolute, safe_norm, safe_power

power = jax.jit(safe_power)
length = jax.jit(safe_norm)
power_and_slope = jax.jit(jax.vmap(jax.value_and_grad(safe_power), in_axes=(0, None)))
power_by_exponent = jax.jit(jax.vmap(jax.grad(safe_power, argnums=1), in_axes=(0, None)))
length_and_slope = jax.jit(jax.vmap(jax.value_and_grad(lambda v: safe_norm(v)[0])))


def magnitudes() -> np.ndarray:
    """0, every power of two that float32 has, subnormal ones included, with 16 mantissas each, and infinity."""
    mantissas = np.unique([0, 1, *np.linspace(0, 2**23 - 1, 13).astype(np.uint32), 2**22, 2**23 - 2, 2**23 - 1])
    exponents = np.arange(255, dtype=np.uint32) << 23
    numbers = (exponents[:, None] | mantissas[None].astype(np.uint32)).view(np.float32).ravel()
    below_normal = np.ldexp(np.float32(1), np.arange(-149, -126))
    return np.unique(np.concatenate([numbers, below_normal, np.float32([np.inf])]))


def normal_and_finite(x: np.ndarray) -> np.ndarray:
    """Where single precision can represent the argument; below, hardware may read it as 0."""
    return (x >= np.finfo(np.float32).tiny) & np.isfinite(x)


def test_the_sweep_covers_every_magnitude() -> None:
    x = magnitudes()
    assert np.all(np.diff(x) > 0)
    assert x[0] == 0
    assert x[1] == 2.0**-149
    assert x[-2] == np.finfo(np.float32).max
    assert x[-1] == np.inf
    assert set(np.frexp(x[1:-1])[1]) == set(range(-148, 129))


@pytest.mark.parametrize("exponent", [0.0, 1 / 2.2, 0.5, 0.7, 1.0])
def test_power_is_accurate_where_normal_and_finite_everywhere(exponent: float) -> None:
    x = magnitudes()
    value, slope = (np.asarray(found) for found in power_and_slope(x, exponent))
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))
    # A power may be off by one ulp.
    assert np.all(value[1:] >= value[:-1] * (1 - 3e-7))
    normal, wide = normal_and_finite(x), x[normal_and_finite(x)].astype(np.float64)
    np.testing.assert_allclose(value[normal], wide**exponent, rtol=2e-5)
    true_slope = exponent * wide ** (exponent - 1)
    np.testing.assert_allclose(slope[normal], true_slope, rtol=2e-5)
    assert value[0] == slope[0] == 0
    assert value[-1] == value[-2]
    low, flat = power_and_slope(-x, exponent)
    assert not np.any(low)
    assert not np.any(flat)


def test_power_has_a_finite_derivative_by_its_exponent() -> None:
    x = magnitudes()
    slope = np.asarray(power_by_exponent(x, 0.3))
    assert np.all(np.isfinite(slope))
    normal = normal_and_finite(x)
    wide = x[normal].astype(np.float64)
    np.testing.assert_allclose(slope[normal], wide**0.3 * np.log(wide), rtol=1e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("other", ["zero", "same", "small"])
def test_norm_is_accurate_where_normal_and_finite_everywhere(other: str, sign: float) -> None:
    x = sign * magnitudes()
    beside = {"zero": np.zeros_like(x), "same": x, "small": x * np.float32(2.0**-20)}[other]
    vectors = np.stack([x, beside, np.zeros_like(x)], axis=-1).astype(np.float32)
    value, slope = (np.asarray(found) for found in length_and_slope(vectors))
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))
    normal = normal_and_finite(np.abs(x))
    wide = vectors[normal].astype(np.float64)
    expected = np.minimum(np.linalg.norm(wide, axis=-1), np.finfo(np.float32).max)
    np.testing.assert_allclose(value[normal, 0] if value.ndim > 1 else value[normal], expected, rtol=1e-6)
    # The derivative of a length is the unit vector.
    unit = wide / np.linalg.norm(wide, axis=-1, keepdims=True)
    np.testing.assert_allclose(slope[normal], unit, rtol=1e-5, atol=1e-6)
    assert not np.any(slope[0])


def test_nan_stays_nan() -> None:
    assert np.isnan(power(jnp.float32(jnp.nan), 0.5))
    assert np.isnan(length(jnp.asarray([1.0, jnp.nan])))


def test_absolute_has_derivative_zero_at_zero() -> None:
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(absolute)))(jnp.asarray([-2.0, -0.0, 0.0, 3.0]))
    np.testing.assert_array_equal(value, [2, 0, 0, 3])
    np.testing.assert_array_equal(slope, [-1, 0, 0, 1])


def test_absolute_is_the_magnitude_of_every_number() -> None:
    x = np.concatenate([-magnitudes()[::-1], magnitudes()])
    value, slope = (np.asarray(found) for found in jax.jit(jax.vmap(jax.value_and_grad(absolute)))(x))
    normal = (np.abs(x) >= np.finfo(np.float32).tiny) | (x == 0)
    np.testing.assert_array_equal(value[normal], np.abs(x[normal]))
    np.testing.assert_array_equal(slope[normal], np.sign(x[normal]))
    assert np.all(np.abs(slope) <= 1)


def test_derivatives(x64: None, rng: np.random.Generator) -> None:
    x = rng.uniform(0.1, 2.0, (3, 4))
    check_grads(jax.jit(safe_power), (x, rng.uniform(0.2, 0.9, (3, 4))), order=2, modes=["rev"])
    check_grads(jax.jit(safe_norm), (x,), order=2, modes=["rev"])
