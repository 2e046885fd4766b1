"""Errors without the noise of the reference: against float64 NumPy, and against the truth of synthetic noise."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import color, metrics
from tests.gradients import check_gradients

unbiased_mse, unbiased_psnr, unbiased_relative_mse, unbiased_temporal_psnr = (
    jax.jit(getattr(metrics, f"unbiased_{name}")) for name in ("mse", "psnr", "relative_mse", "temporal_psnr")
)
tonemap = jax.jit(color.tonemap, static_argnames="operator")
tonemap_halves = jax.jit(color.tonemap_halves, static_argnames="operator")

SAMPLES = 128
"""In each half of a reference of 256 samples per pixel."""
IMAGES = {
    "noisy": lambda shown, error, rng: shown + error * rng.standard_normal(shown.shape),
    "too bright": lambda shown, error, rng: shown + error,
    "too dark": lambda shown, error, rng: shown - error,
}


def srgb(x):
    """The curve in float64, without the code under test."""
    x = np.clip(x, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def rendered(rng, *, spread, shape):
    """A scene from 0.01 to 1.2, and two halves of its reference; ``spread``: of one sample, relative to its mean."""
    truth = np.exp(rng.uniform(np.log(0.01), np.log(1.2), shape))
    count = SAMPLES / spread**2
    return truth, *(truth * rng.gamma(count, 1 / count, shape) for _ in range(2))


def decibels(error):
    return -10 * np.log10(np.mean(error**2))


def singles(*arrays):
    return [array.astype(np.float32) for array in arrays]


@pytest.mark.parametrize("operator", color.OPERATORS)
def test_the_product_of_errors_is_the_jackknife_of_the_squared_error(x64, rng, operator):
    first, second = rng.exponential(0.5, (2, 9, 7, 3))
    image = rng.random((9, 7, 3))

    def error(reference):
        return (image - np.asarray(tonemap(reference, operator=operator))) ** 2

    a, b = (np.asarray(half) for half in tonemap_halves(first, second, operator=operator))
    expected = 2 * error((first + second) / 2) - (error(first) + error(second)) / 2
    np.testing.assert_allclose((image - a) * (image - b), expected, atol=1e-12)
    other = [np.asarray(half) for half in tonemap_halves(second, first, operator=operator)]
    np.testing.assert_allclose(other[0] + other[1], a + b, atol=1e-12)


def test_halves_without_noise_are_the_tone_mapped_image(rng):
    (light,) = singles(rng.exponential(0.5, (5, 6, 3)))
    for half in tonemap_halves(light, light):
        np.testing.assert_allclose(half, tonemap(light), atol=1e-6)
    slope = jax.jit(jax.grad(lambda light: jnp.sum(color.tonemap_halves(light, light)[0])))(light)
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("spread", [1.0, 2.0])
@pytest.mark.parametrize("kind", IMAGES)
def test_psnr_is_the_true_one_where_the_plain_one_is_3_decibels_off(kind, spread):
    rng = np.random.default_rng(3)
    truth, first, second = rendered(rng, spread=spread, shape=(300, 400, 3))
    shown = srgb(truth)
    error = np.sqrt(np.mean((srgb((first + second) / 2) - shown) ** 2))
    image = IMAGES[kind](shown, error, rng)
    true = decibels(image - shown)
    image, first, second = singles(image, first, second)
    assert true - float(jax.jit(metrics.psnr)(image, tonemap((first + second) / 2))) > 2.6
    halves = tonemap_halves(first, second)
    assert abs(float(unbiased_psnr(image, *halves)) - true) < 0.1
    np.testing.assert_allclose(unbiased_mse(image, *halves), 10 ** (-true / 10), rtol=0.023)
    if kind != "noisy":  # halves tone-mapped one by one are too dark
        one_by_one = unbiased_psnr(image, tonemap(first), tonemap(second))
        assert abs(float(one_by_one) - true) > 0.35


def test_few_samples_judge_as_well_as_many():
    rng = np.random.default_rng(5)
    truth, first, second = rendered(rng, spread=2.0, shape=(300, 400, 3))
    shown = srgb(truth)
    image = shown + 0.02 * rng.standard_normal(shown.shape)
    found = []
    for noise in (1.0, 0.25):  # a sixteenth of the variance: 16 times the samples
        halves = (truth + noise * (half - truth) for half in (first, second))
        found.append(float(unbiased_psnr(image, *tonemap_halves(*singles(*halves)))))
    assert abs(found[0] - found[1]) < 0.15
    assert abs(found[1] - decibels(image - shown)) < 0.05


def test_temporal_psnr_is_the_true_one_where_the_plain_one_is_3_decibels_off():
    rng = np.random.default_rng(4)
    truth, first, second = rendered(rng, spread=1.0, shape=(4, 150, 200, 3))
    truth_again = np.repeat(truth[:1], 4, axis=0)  # nothing moves: all of the change is an error
    first, second = first / truth * truth_again, second / truth * truth_again
    shown = srgb(truth_again)
    error = np.sqrt(np.mean((srgb((first + second) / 2) - shown) ** 2))
    image = shown + error * rng.standard_normal(shown.shape)
    true = decibels(np.diff(image - shown, axis=0))
    image, first, second = singles(image, first, second)
    assert true - float(jax.jit(metrics.temporal_psnr)(image, tonemap((first + second) / 2))) > 2.6
    halves = tonemap_halves(first, second)
    assert abs(float(unbiased_temporal_psnr(image, *halves)) - true) < 0.1
    of_bytes = jax.jit(partial(metrics.unbiased_temporal_psnr, peak=255.0))(image, *halves)
    np.testing.assert_allclose(of_bytes, true + 48.13, atol=0.1)


@pytest.mark.parametrize("kind", IMAGES)
@pytest.mark.parametrize(("spread", "tolerance"), [(1.0, 0.15), (2.0, 0.4)])
def test_relative_mse_is_the_true_one_where_the_plain_one_is_twice_as_large(kind, spread, tolerance):
    rng = np.random.default_rng(6)
    truth, first, second = rendered(rng, spread=spread, shape=(300, 400, 3))
    image = truth + IMAGES[kind](0 * truth, spread / (2 * SAMPLES) ** 0.5, rng) * truth
    weight = 1 / (truth**2 + 0.01)
    true = np.mean((image - truth) ** 2 * weight)
    image, first, second = singles(image, first, second)

    def off(value):
        return 10 * np.log10(float(value) / true)

    assert off(jax.jit(metrics.relative_mse)(image, (first + second) / 2)) > 2.0
    assert abs(off(unbiased_relative_mse(image, first, second))) < tolerance
    if kind != "noisy":
        mean = (first + second) / 2
        assert abs(off(np.mean((image - first) * (image - second) / (mean**2 + 0.01)))) > 0.7


def test_relative_mse_under_noise_of_heavy_tails_needs_a_weight_without_it():
    rng = np.random.default_rng(8)
    truth = np.exp(rng.uniform(np.log(0.05), np.log(1.2), (300, 400, 3)))
    # One pixel in fifty has 6 times its light in a half, and the others less, so that the mean is right.
    lit = [rng.random(truth.shape) < 0.02 for _ in range(2)]
    first, second = (truth * np.where(bright, 6.0, 0.88 / 0.98) for bright in lit)
    image = truth * (1 + 0.1 * rng.standard_normal(truth.shape))
    near = truth * (1 + 0.03 * rng.standard_normal(truth.shape))
    true = np.mean((image - truth) ** 2 / (near**2 + 0.01))
    image, first, second, near = singles(image, first, second, near)
    assert float(unbiased_relative_mse(image, first, second)) > 5 * true
    found = unbiased_relative_mse(image, first, second, relative_to=near)
    assert float(found) == pytest.approx(true, rel=0.25)


@pytest.mark.parametrize("clip", [True, False])
def test_a_given_weight_is_used_alone(rng, clip):
    shape = (3, 8, 9, 3) if clip else (8, 9, 3)
    image, first, second, near = rng.exponential(0.3, (4, *shape))
    mask = rng.random((*shape[:-1], 1)) < 0.5
    broken = [np.where(mask, each, np.nan) for each in singles(image, first, second, near)]
    x, a, b, n = (each[mask[..., 0]] for each in (image, first, second, near))
    expected = np.mean((x - a) * (x - b) / (n**2 + 0.01))
    found = unbiased_relative_mse(*broken[:3], relative_to=broken[3], mask=mask)
    np.testing.assert_allclose(found, expected, rtol=2e-5)
    with pytest.raises(ValueError, match="same size"):
        metrics.unbiased_relative_mse(*singles(image, first, second), relative_to=near[..., 1:, :])


@pytest.mark.parametrize("clip", [True, False])
def test_what_is_computed_in_numpy(rng, clip):
    shape = (3, 8, 9, 3) if clip else (8, 9, 3)
    image, first, second = rng.exponential(0.3, (3, *shape))
    mask = rng.random((*shape[:-1], 1)) < 0.5
    broken = [np.where(mask, each, np.nan) for each in singles(image, first, second)]
    x, a, b = (each[mask[..., 0]] for each in (image, first, second))
    mean, half = (a + b) / 2, (a - b) / 2
    weight, slope = 1 / (mean**2 + 0.01), -2 * mean / (mean**2 + 0.01) ** 2
    expected = np.mean(weight * (x - a) * (x - b) + 2 * slope * (x - mean) * half**2)
    np.testing.assert_allclose(unbiased_relative_mse(*broken, mask=mask), expected, rtol=2e-5)
    if clip:
        dx, da, db = (np.diff(each, axis=0)[mask[1:, ..., 0]] for each in (image, first, second))
        expected = -10 * np.log10(max(np.mean((dx - da) * (dx - db)), 0))
        hidden = [np.where(mask | np.roll(mask, -1, 0), each, np.nan) for each in singles(image, first, second)]
        np.testing.assert_allclose(unbiased_temporal_psnr(*hidden, mask=mask), expected, rtol=2e-5)


def test_two_references_that_are_one_give_the_plain_errors(rng):
    image, reference = singles(*rng.random((2, 3, 8, 9, 3)))
    relative = unbiased_relative_mse(image, reference, reference)
    np.testing.assert_allclose(relative, jax.jit(metrics.relative_mse)(image, reference), rtol=1e-5)
    temporal = unbiased_temporal_psnr(image, reference, reference)
    expected = jax.jit(partial(metrics.temporal_psnr, average="mse"))(image, reference)
    np.testing.assert_allclose(temporal, expected, rtol=1e-6)


def test_nothing_to_measure_on(rng):
    clip = singles(*rng.random((3, 3, 4, 5, 3)))
    nothing = np.zeros((3, 4, 5, 1), bool)
    assert float(unbiased_relative_mse(*clip, mask=nothing)) == 0
    assert float(unbiased_temporal_psnr(*clip, mask=nothing)) == np.inf
    assert float(unbiased_temporal_psnr(*(each[:1] for each in clip))) == np.inf
    clip[0][1, 2, 2] = np.nan
    for metric in (unbiased_relative_mse, unbiased_temporal_psnr):
        assert np.isnan(metric(*clip))


def test_gradients(x64, rng):
    image, first, second = rng.uniform(0.2, 0.8, (3, 2, 5, 6, 3))
    image = 1.5 * image  # far from the halves, where the estimates are above 0
    for metric in (metrics.unbiased_relative_mse, metrics.unbiased_temporal_psnr):
        check_gradients(metric, (image, first, second))


def test_shapes_are_checked(rng):
    clip = rng.random((3, 4, 5, 3))
    for metric in (metrics.unbiased_relative_mse, metrics.unbiased_temporal_psnr):
        with pytest.raises(ValueError, match="same size"):
            metric(clip, clip, clip[:, 1:])
    with pytest.raises(ValueError, match="T, H, W, C"):
        metrics.unbiased_temporal_psnr(clip[0], clip[0], clip[0])


def test_a_firefly_in_a_half_or_in_the_image_overflows_nothing():
    image, first, second = (np.full((4, 4, 3), value, np.float32) for value in (0.5, 0.4, 0.6))
    first[0, 0] = 1e30
    assert np.isfinite(unbiased_relative_mse(image, first, second))
    image[1, 1] = 1e36
    assert float(unbiased_relative_mse(image, first, second)) == np.inf
    slope = jax.jit(jax.grad(metrics.unbiased_relative_mse))(image, first, second)
    assert np.all(np.isfinite(slope))
