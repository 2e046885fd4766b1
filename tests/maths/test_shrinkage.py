"""What is kept of a noisy image: against NumPy, and for noise, lost detail and their mixtures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.shrinkage import BLOCK, CLEAN, DOUBT, MOST, NOISY, RADIUS, combine

SIZE = (48, 64)


def mse(image, truth):
    return float(np.mean((np.asarray(image) - truth) ** 2))


def box(height, width):
    """A grey wall and a brighter box with slanted sides: the edges are lost in its blurred version."""
    rows, columns = np.mgrid[:height, :width]
    inside = np.clip((columns - 16 - 0.3 * rows), 0, 1) * np.clip(height - 12 - rows, 0, 1)
    truth = np.repeat((0.5 + inside)[..., None], 3, axis=-1).astype(np.float32)
    blurred = truth
    for axis in (0, 1):
        blurred = sum(np.roll(blurred, step, axis) for step in range(-2, 3)) / 5
    return truth, blurred.astype(np.float32)


def reference(noisy, denoised):
    """The share, pixel by pixel in float64."""
    noisy, denoised = np.asarray(noisy, np.float64), np.asarray(denoised, np.float64)
    light = denoised.mean(axis=-1, keepdims=True)
    change = (noisy - denoised) / (light + 0.05 * light.mean())
    height, width = change.shape[:2]
    wide = np.pad(change, ((1, 1), (1, 1), (0, 0)), mode="reflect")
    square = np.mean(change**2, axis=-1)
    curved = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = wide[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        behind = wide[1 - dy : 1 - dy + height, 1 - dx : 1 - dx + width]
        curved.append(np.mean((ahead - 2 * change + behind) ** 2, axis=-1) / 6)
    share, noise = np.zeros((height, width)), np.zeros((height, width))
    firefly = np.zeros((height, width), bool)
    for y, x in np.ndindex(height, width):
        window = np.s_[max(y - RADIUS, 0) : y + RADIUS + 1, max(x - RADIUS, 0) : x + RADIUS + 1]
        energy, variance = square[window].mean(), min(each[window].mean() for each in curved)
        number = square[window].sum() ** 2 / (square[window] ** 2).sum()
        share[y, x] = np.clip(1 - min(1 + DOUBT / np.sqrt(number), MOST) * variance / energy, 0, 1)
        noise[y, x] = np.sqrt(variance)
        firefly[y, x] = variance > 0.7 * energy and energy > 0.1
    level = np.median(noise)  # of one block
    part = np.clip((NOISY - level) / (NOISY - CLEAN), 0, 1)
    clean = np.where(firefly, 0, part * part * (3 - 2 * part))
    return (share + (1 - share) * clean)[..., None], np.median(noise)


@pytest.mark.parametrize("deviation", [0.005, 0.05, 0.4])
def test_the_share_is_that_of_numpy(rng, deviation):
    truth, blurred = (image[:BLOCK, :BLOCK] for image in box(BLOCK, BLOCK))
    noisy = (truth * rng.gamma(deviation**-2, deviation**2, truth.shape)).astype(np.float32)
    share, noise = reference(noisy, blurred)
    found = jax.jit(combine)(noisy, blurred)
    np.testing.assert_allclose(found.share, share, atol=2e-4)
    np.testing.assert_allclose(found.noise, noise, rtol=1e-4)
    np.testing.assert_allclose(found.image, blurred + share * (noisy - blurred), atol=1e-3)


def test_what_has_no_noise_comes_back(rng):
    truth, blurred = box(*SIZE)
    assert mse(blurred, truth) > 1e-3
    assert mse(combine(truth, blurred).image, truth) < 1e-6


@pytest.mark.parametrize("samples", [1, 4, 16, 64, 256])
def test_the_mixture_is_not_worse_than_either(rng, samples):
    """Of exponential noise, the mean of so many samples; at few of them nothing is lost, at many detail comes back."""
    truth, blurred = box(*SIZE)
    noisy = (truth * rng.gamma(samples, 1 / samples, truth.shape)).astype(np.float32)
    image = combine(noisy, blurred).image
    assert mse(image, truth) < 1.01 * min(mse(noisy, truth), mse(blurred, truth))
    if samples >= 64:
        assert mse(image, truth) < 0.6 * min(mse(noisy, truth), mse(blurred, truth))


def test_half_of_a_frame_may_be_clean(rng):
    """Noise on one half is taken away, detail on the other comes back."""
    height, width = 64, 192
    truth, blurred = box(height, width)
    noisy = truth.copy()
    noisy[:, 96:] *= rng.gamma(1.0, 1.0, noisy[:, 96:].shape).astype(np.float32)
    image = np.asarray(combine(noisy, blurred).image)
    assert mse(image[:, :64], truth[:, :64]) < 1e-3 * mse(blurred[:, :64], truth[:, :64])
    assert mse(image[:, 128:], truth[:, 128:]) < 1.01 * mse(blurred[:, 128:], truth[:, 128:])


def test_fireflies_and_invalid_values_do_not_come_back():
    denoised = np.full((*SIZE, 3), 0.5, np.float32)
    noisy = denoised.copy()
    noisy[20, 30], noisy[3, 3, 0], noisy[40, 50], noisy[5, 60] = 200.0, np.nan, np.inf, -1.0
    found = combine(noisy, denoised)
    np.testing.assert_allclose(found.image, denoised, atol=1e-6)
    assert np.isfinite(found.share).all()


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (3, 2, 3)])
def test_small_and_black_images_stay_finite(shape):
    black = jnp.zeros(shape)
    for noisy in (black, black + 65504.0):
        for denoised in (black, black + 1.0):
            found = combine(noisy, denoised)
            assert np.isfinite(found.image).all()
            assert np.isfinite(found.noise)


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match="noisy and denoised: expected the same size"):
        combine(jnp.zeros((4, 4, 3)), jnp.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="noisy: expected 3 channels"):
        combine(jnp.zeros((4, 4, 1)), jnp.zeros((4, 4, 1)))
