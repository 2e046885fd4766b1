"""Losses against loops and sums in float64 NumPy, and their derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import color, losses
from tests.gradients import check_gradients

SHAPE = (4, 5, 7, 3)

spatial = jax.jit(losses.spatial)
temporal = jax.jit(losses.temporal)
gradient = jax.jit(losses.gradient, static_argnames="operator")
occlusion = jax.jit(losses.occlusion, static_argnames="weights")
pyramid = jax.jit(losses.pyramid, static_argnames="levels")


def pair(rng: np.random.Generator, shape: tuple[int, ...] = SHAPE) -> tuple[np.ndarray, np.ndarray]:
    return rng.random(shape).astype(np.float32), rng.random(shape).astype(np.float32)


def masks(rng: np.random.Generator, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return (rng.random((*shape[:-1], 1)) < 0.4).astype(np.float32)


def occlusion_reference(x: np.ndarray, y: np.ndarray, m: np.ndarray, weights: tuple[float, ...]) -> float:
    total = 0.0
    for i in range(len(x)):
        s = sum(w * (m[i - k] if i - k >= 0 else m[i]).astype(np.float64) for k, w in enumerate(weights))
        total += np.sum(np.abs((x[i].astype(np.float64) - y[i]) * s))
    return total / x.size


def hfen_reference(x: np.ndarray, y: np.ndarray) -> float:
    axis = np.arange(-7, 8)
    r2 = axis[:, None] ** 2 + axis[None, :] ** 2
    s = 1.5
    kernel = -1 / (np.pi * s**4) * (1 - r2 / (2 * s**2)) * np.exp(-r2 / (2 * s**2))
    kernel -= kernel.mean()
    error = np.pad(x.astype(np.float64) - y, ((0, 0), (7, 7), (7, 7), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(error, (15, 15), axis=(1, 2))
    return np.abs(np.einsum("thwcij,ij->thwc", windows, kernel)).mean()


def test_spatial(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    np.testing.assert_allclose(spatial(x, y), np.abs(x.astype(np.float64) - y).mean(), rtol=1e-6)


def test_temporal(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    expected = np.abs(np.diff(x.astype(np.float64), axis=0) - np.diff(y.astype(np.float64), axis=0)).mean()
    np.testing.assert_allclose(temporal(x, y), expected, rtol=1e-6)


def test_temporal_ignores_a_constant_error_and_is_zero_for_one_frame(rng: np.random.Generator) -> None:
    x, _ = pair(rng)
    np.testing.assert_allclose(temporal(x + 0.25, x), 0, atol=1e-7)
    value, slope = jax.jit(jax.value_and_grad(temporal))(x[:1], x[:1] + 1)
    assert value == 0
    assert np.all(np.asarray(slope) == 0)


def test_gradient_of_differences(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    error = x.astype(np.float64) - y
    both = np.concatenate([np.diff(error, axis=1).ravel(), np.diff(error, axis=2).ravel()])
    np.testing.assert_allclose(gradient(x, y), np.abs(both).mean(), rtol=1e-6)
    assert gradient(x[:, :1, :1], y[:, :1, :1]) == 0


def test_gradient_hfen(rng: np.random.Generator) -> None:
    x, y = pair(rng, (2, 17, 9, 2))
    np.testing.assert_allclose(gradient(x, y, operator="hfen"), hfen_reference(x, y), rtol=1e-5)


def test_hfen_cancels_in_bfloat16_too() -> None:
    """A constant error has no high frequencies; taps summed in bfloat16 found 4e-4 of it."""
    constant = np.full((1, 1, 1, 3), 0.3, jnp.bfloat16)
    found = gradient(constant, np.zeros_like(constant), operator="hfen")
    assert found.dtype == jnp.bfloat16
    assert float(found) < 1e-7


@pytest.mark.parametrize("operator", ["difference", "hfen"])
def test_gradient_ignores_a_constant_offset(operator: str, rng: np.random.Generator) -> None:
    x, _ = pair(rng)
    np.testing.assert_allclose(gradient(x + 0.5, x, operator=operator), 0, atol=1e-6)


def test_laplacian_of_a_ramp_is_zero_inside() -> None:
    ramp = np.broadcast_to(np.arange(24.0)[:, None, None], (1, 24, 24, 1))
    response = jax.jit(losses._laplacian_of_gaussian)(ramp)
    np.testing.assert_allclose(np.asarray(response)[:, 7:-7], 0, atol=1e-5)


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
@pytest.mark.parametrize("weights", [(1.0, 0.8, 0.6), (1.0,), (0.5, 0.0, 0.0, 0.25, 2.0)])
def test_occlusion(frames: int, weights: tuple[float, ...], rng: np.random.Generator) -> None:
    x, y = pair(rng)
    m = masks(rng)
    result = occlusion(x[:frames], y[:frames], m[:frames], weights=weights)
    np.testing.assert_allclose(result, occlusion_reference(x[:frames], y[:frames], m[:frames], weights), rtol=1e-6)


def test_occlusion_weighs_the_last_three_masks() -> None:
    """One pixel disoccluded at frame 2 of 5, error 1 everywhere: 1, 0.8 and 0.6 at frames 2, 3 and 4."""
    m = np.zeros((5, 1, 1, 1), np.float32)
    m[2] = 1
    slope = jax.jit(jax.grad(occlusion))(np.ones((5, 1, 1, 1)), np.zeros((5, 1, 1, 1)), m)
    np.testing.assert_allclose(np.ravel(slope) * 5, [0, 0, 1, 0.8, 0.6], rtol=1e-6)


def test_masks_before_the_first_frame_are_each_frames_own() -> None:
    """A pixel masked in frame 0 alone counts 2.4 there and 0.8 at frame 1; one masked in frame 1 alone counts 1.6."""
    m = np.zeros((2, 1, 2, 1), np.float32)
    m[0, 0, 0] = m[1, 0, 1] = 1
    slope = jax.jit(jax.grad(occlusion))(np.ones((2, 1, 2, 1)), np.zeros((2, 1, 2, 1)), m)
    np.testing.assert_allclose(np.asarray(slope).reshape(2, 2) * 4, [[2.4, 0.0], [0.8, 1.6]], rtol=1e-6)


def test_occlusion_without_and_with_full_masks(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    nothing = np.zeros((*SHAPE[:-1], 1), np.float32)
    value, slope = jax.jit(jax.value_and_grad(occlusion))(x, y, nothing)
    assert value == 0
    assert np.all(np.asarray(slope) == 0)
    everything = np.ones((*SHAPE[:-1], 1), bool).astype(np.float32)
    np.testing.assert_allclose(occlusion(x, y, everything), 2.4 * np.asarray(spatial(x, y)), rtol=1e-5)


CASES = {
    "spatial": spatial,
    "temporal": temporal,
    "difference": gradient,
    "pyramid": lambda x, y: pyramid(x, y, levels=2),
    "hfen": lambda x, y: gradient(x, y, operator="hfen"),
    "occlusion": lambda x, y: occlusion(x, y, jnp.ones((*x.shape[:-1], 1), x.dtype)),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives(name: str, x64: None, rng: np.random.Generator) -> None:
    x, y = rng.random((3, 4, 5, 2)), rng.random((3, 4, 5, 2))
    check_gradients(CASES[name], (x, y), eps=1e-7, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_symmetric_zero_on_identical_with_finite_gradient(name: str, rng: np.random.Generator) -> None:
    x, y = pair(rng)
    loss = jax.jit(CASES[name])
    np.testing.assert_allclose(loss(x, y), loss(y, x), rtol=1e-6)
    value, slope = jax.jit(jax.value_and_grad(loss))(x, x)
    assert value == 0
    assert np.all(np.asarray(slope) == 0)
    assert loss(x, y).shape == ()
    assert float(loss(x, y)) > 0


def test_shapes_are_checked(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    with pytest.raises(ValueError, match="T, H, W, C"):
        spatial(x[0], y[0])
    with pytest.raises(ValueError, match="channels"):
        temporal(x, y[..., :1])
    with pytest.raises(ValueError, match="same size"):
        gradient(x, y[:, :4])
    with pytest.raises(ValueError, match="hfen"):
        gradient(x, y, operator="sobel")
    with pytest.raises(ValueError, match="masks"):
        occlusion(x, y, masks(rng)[:2])


def test_squared_losses_are_means_of_squares(rng: np.random.Generator) -> None:
    (x, y), m = pair(rng), masks(rng)
    error = x.astype(np.float64) - y
    np.testing.assert_allclose(jax.jit(partial(losses.spatial, squared=True))(x, y), np.mean(error**2), rtol=1e-5)
    found = jax.jit(partial(losses.temporal, squared=True))(x, y)
    np.testing.assert_allclose(found, np.mean(np.diff(error, axis=0) ** 2), rtol=1e-5)
    found = jax.jit(partial(losses.occlusion, weights=(1.0,), squared=True))(x, y, m)
    np.testing.assert_allclose(found, np.mean((error * m) ** 2), rtol=1e-5)


def test_squares_of_the_unbiased_pair_seek_the_mean_of_noisy_targets_and_l1_does_not(rng: np.random.Generator) -> None:
    """One pixel value learned from many noisy targets of mean 1: gradient descent on both losses."""
    targets = rng.exponential(size=(4000, 1, 1, 3)).astype(np.float32)

    def by_squares(x: jax.Array) -> jax.Array:
        image = jnp.full(targets.shape, 1.0) * x
        return losses.spatial(*losses.unbiased(image, targets), squared=True)

    def by_l1(x: jax.Array) -> jax.Array:
        return losses.spatial(color.compress(jnp.full(targets.shape, 1.0) * x), color.compress(jnp.asarray(targets)))

    found = {}
    for loss in (by_squares, by_l1):
        slope, x = jax.jit(jax.grad(loss)), jnp.float32(0.5)
        for _ in range(1500):
            x = x - 0.1 * slope(x)
        found[loss.__name__] = float(x)
    np.testing.assert_allclose(found["by_squares"], targets.mean(), rtol=0.01)
    np.testing.assert_allclose(found["by_l1"], np.median(targets), rtol=0.05)  # 0.69: a third too dark


def test_pyramid_is_the_sum_of_its_bands(rng: np.random.Generator) -> None:
    x, y = pair(rng, (2, 8, 12, 3))
    error, wanted = x.astype(np.float64) - y, 0.0
    for size in (2, 4):
        means = error.reshape(2, 8 // size, size, 12 // size, size, 3).mean(axis=(2, 4))
        above = error.reshape(2, 16 // size, size // 2, 24 // size, size // 2, 3).mean(axis=(2, 4))
        wanted += np.abs(above - np.repeat(np.repeat(means, 2, 1), 2, 2)).mean()
    wanted += np.abs(means).mean()
    np.testing.assert_allclose(pyramid(x, y, levels=2), wanted, rtol=1e-5)
    # 12 can be halved twice, and then it is odd.
    np.testing.assert_allclose(pyramid(x, y, levels=9), wanted, rtol=1e-5)
    np.testing.assert_allclose(pyramid(x[:, 1:], y[:, 1:], levels=3), spatial(x[:, 1:], y[:, 1:]), rtol=1e-5)


def test_pyramid_seeks_nearly_the_mean_of_noisy_targets(rng: np.random.Generator) -> None:
    """One value for all pixels, learned from targets whose median is a third below their mean."""
    targets = rng.exponential(size=(8, 64, 64, 1)).astype(np.float32)
    slope, x = jax.jit(jax.grad(lambda x: losses.pyramid(jnp.full(targets.shape, 1.0) * x, targets))), jnp.float32(0.5)
    for _ in range(400):
        x = x - 0.01 * slope(x)
    np.testing.assert_allclose(x, targets.mean(), rtol=0.02)


def test_the_unbiased_pair_is_the_compressed_pair_to_first_order(rng: np.random.Generator) -> None:
    x = 0.02 + np.exp(rng.normal(0, 2, SHAPE)).astype(np.float32)
    y = (x * (1 + 1e-3 * rng.standard_normal(SHAPE))).astype(np.float32)
    unbiased, compress = jax.jit(losses.unbiased, static_argnames="curve"), jax.jit(color.compress)
    first, second = map(np.asarray, unbiased(x, y))
    wanted = np.asarray(compress(x), np.float64) - np.asarray(compress(y), np.float64)
    np.testing.assert_allclose(first - second, wanted, rtol=2e-2, atol=2e-5)
    first, second = map(np.asarray, unbiased(x, y, curve="reinhard"))
    np.testing.assert_allclose(
        first - second, np.float64(x) / (1.0 + x) - np.float64(y) / (1.0 + y), rtol=2e-2, atol=2e-5
    )
    # One firefly in the target weighs as much as some hundred pixels, not as the whole image.
    image, firefly = np.full(SHAPE, 0.2), np.full(SHAPE, 0.3)
    firefly[0, 0, 0] = 60000.0
    gap = np.subtract(*unbiased(image, firefly))
    assert 10 < np.square(gap).max() / np.square(gap[-1, -1, -1]).max() < 1000
