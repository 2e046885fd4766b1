"""Tone curves against NumPy in float64, their inverses, and every magnitude a float32 can have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxdn import color
from tests.gradients import check_gradients

TOE = np.expm1(1e-4)

compress = jax.jit(color.compress)
expand = jax.jit(color.expand)
luminance = jax.jit(color.luminance)
tonemap = jax.jit(color.tonemap, static_argnames="operator")
round_trip = jax.jit(lambda x: color.srgb_decode(color.srgb_encode(x)))


def compress_reference(x: np.ndarray) -> np.ndarray:
    u = np.log1p(np.asarray(x, np.float64))
    return np.where(u <= 1e-4, u * 1e-4 ** (1 / 2.2 - 1), np.maximum(u, 1e-4) ** (1 / 2.2))


def encode_reference(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def magnitudes() -> np.ndarray:
    """0, subnormals, every decade of float32, its ends and infinity, of both signs."""
    decades = np.array([10.0**exponent for exponent in range(-45, 39)], np.float32)
    positive = np.concatenate([decades, np.array([np.finfo(np.float32).max, np.inf], np.float32)])
    return np.concatenate([-positive[::-1], np.zeros(1, np.float32), positive])


def test_compress_is_the_formula() -> None:
    x = np.concatenate([[0.0], np.geomspace(1e-30, 65504, 500)]).astype(np.float32)
    np.testing.assert_allclose(compress(x), compress_reference(x), rtol=2e-6, atol=1e-30)


def test_compress_is_continuous_at_the_toe_with_slope_152_below() -> None:
    below, above = np.float32(TOE * (1 - 1e-6)), np.float32(TOE * (1 + 1e-6))
    slope = jax.jit(jax.grad(compress))
    assert 0 <= np.subtract(compress(above), compress(below)) < 1e-6
    np.testing.assert_allclose(slope(0.0), 151.99, rtol=1e-4)
    # the slope at black is that of the toe from both sides: a black pixel learns
    np.testing.assert_allclose(slope(-1e-9), 151.99, rtol=1e-4)


@pytest.mark.parametrize("curve", [compress, expand])
def test_value_and_slope_are_finite_for_every_float(curve) -> None:
    x = magnitudes()
    value, slope = map(np.asarray, jax.jit(jax.vmap(jax.value_and_grad(curve)))(x))
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))
    assert np.all(slope >= 0)
    assert np.all(np.diff(value) >= 0)
    np.testing.assert_array_equal(value, -value[::-1])


def test_infinity_counts_as_the_largest_number_and_nan_stays() -> None:
    assert compress(jnp.inf) == compress(jnp.finfo(jnp.float32).max)
    assert np.isnan(compress(jnp.nan))
    assert np.isnan(expand(jnp.nan))


@given(st.floats(-65504, 65504, width=32))
def test_expand_undoes_compress(x: float) -> None:
    np.testing.assert_allclose(expand(compress(jnp.float32(x))), x, rtol=1e-5, atol=1e-37)


@given(st.floats(0, 1e30), st.floats(1.0001, 10.0))
def test_compress_increases(x: float, factor: float) -> None:
    first, second = jnp.float32(max(x, 1e-30)), jnp.float32(max(x, 1e-30) * factor)
    assert compress(first) <= compress(second)
    if factor > 1.01 and x < 1e20:
        assert compress(first) < compress(second)


def test_round_trip_in_double_precision_and_derivatives(x64: None) -> None:
    x = np.concatenate([[0.0], np.geomspace(1e-12, 1e6, 200)])
    np.testing.assert_allclose(expand(compress(x)), x, rtol=1e-12)
    inside = np.array([1e-5, 0.01, 0.5, 3.0, 200.0])
    check_gradients(compress, (inside,), eps=1e-7)
    check_gradients(expand, (np.array([0.002, 0.1, 0.8, 2.0]),), eps=1e-6)


def test_half_precision_stays_finite() -> None:
    x = jnp.asarray([0.0, 1e-7, 1e-3, 1.0, 65504.0, jnp.inf], jnp.float16)
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(compress)))(x)
    assert value.dtype == jnp.float16
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))


def test_luminance(rng: np.random.Generator) -> None:
    image = rng.random((2, 3, 4, 3)).astype(np.float32)
    expected = image.astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    result = np.asarray(luminance(image))
    assert result.shape == (2, 3, 4, 1)
    np.testing.assert_allclose(result[..., 0], expected, rtol=1e-6)
    np.testing.assert_allclose(luminance(np.ones(3)), [1.0], rtol=1e-6)


def test_luminance_needs_three_channels() -> None:
    with pytest.raises(ValueError, match="3 channels"):
        color.luminance(jnp.ones((4, 4, 1)))


def tonemap_reference(x: np.ndarray, operator: str) -> np.ndarray:
    x = np.clip(np.asarray(x, np.float64), 0, 65504)
    if operator == "compress":
        return compress_reference(x) / compress_reference(65504)
    if operator == "aces":
        x = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    if operator == "reinhard":
        x = x / (1 + x @ np.array([[0.2126], [0.7152], [0.0722]]))
    return encode_reference(np.minimum(x, 1))


@pytest.mark.parametrize("operator", color.OPERATORS)
def test_tonemap(operator: str, rng: np.random.Generator) -> None:
    image = np.exp(rng.normal(-1, 3, (5, 6, 7, 3))).astype(np.float32)
    image[0, 0, 0] = 0
    result = np.asarray(tonemap(image, operator=operator))
    np.testing.assert_allclose(result, tonemap_reference(image, operator), rtol=1e-5, atol=1e-6)
    assert np.all((result >= 0) & (result <= 1))


@pytest.mark.parametrize("operator", color.OPERATORS)
def test_tonemap_is_finite_for_every_float(operator: str) -> None:
    colors = np.repeat(magnitudes()[:, None], 3, axis=1)
    value = np.asarray(tonemap(colors, operator=operator))
    slope = jax.jit(jax.grad(lambda x: jnp.sum(tonemap(x, operator=operator))))(colors)
    assert np.all((value >= 0) & (value <= 1 + 1e-6))
    assert np.all(np.diff(value, axis=0) >= -1e-6)
    assert np.all(np.isfinite(slope))
    assert np.all(np.isnan(tonemap(np.full(3, np.nan), operator=operator)))


def test_tonemap_defaults_to_srgb_and_names_its_operators() -> None:
    np.testing.assert_allclose(tonemap(np.full(3, 0.2158605)), 0.5019, atol=1e-4)  # code value 128
    with pytest.raises(ValueError, match="reinhard"):
        tonemap(jnp.ones(3), operator="filmic")


@given(st.floats(0, 1, width=32))
def test_srgb_round_trip(x: float) -> None:
    np.testing.assert_allclose(round_trip(jnp.float32(x)), x, rtol=2e-5, atol=1e-7)


def exposure_reference(image: np.ndarray) -> float:
    light = np.asarray(image, np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    means = [light[y : y + 16, x : x + 16].mean() for y in range(0, 32, 16) for x in range(0, 48, 16)]
    return 0.18 / np.exp(np.mean([np.log(mean) for mean in means if mean > 0]))


def test_exposure(rng: np.random.Generator) -> None:
    image = rng.exponential(size=(32, 48, 3)).astype(np.float32)
    image[:16, :16] = 0

    def find(image: np.ndarray) -> np.ndarray:
        return np.asarray(jax.jit(color.exposure)(image))

    np.testing.assert_allclose(find(image), exposure_reference(image), rtol=1e-5)
    # Rows and columns beyond the last whole block do not count.
    np.testing.assert_allclose(find(np.pad(image, ((0, 5), (0, 7), (0, 0)))), find(image), rtol=1e-6)
    for factor in (2.0**-20, 3.0, 2.0**12):
        np.testing.assert_allclose(factor * find(factor * image), find(image), rtol=1e-5)
    np.testing.assert_allclose(find(np.full((3, 5, 3), 0.36, np.float32)), 0.5, rtol=1e-6)  # less than a block
    assert find(np.zeros((8, 8, 3), np.float32)) == 1
    assert np.isfinite(find(np.full((32, 32, 3), 65504, np.float32)))
    assert not np.asarray(jax.jit(jax.grad(color.exposure))(image)).any()
