"""What is kept of a noisy image: against NumPy, and for noise, lost detail and their mixtures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.sequence.james_stein import (
    BLOCK,
    CLEAN,
    DOUBT,
    LITTLE,
    MOST,
    MUCH,
    NOISY,
    QUIET,
    RADIUS,
    combine,
    measure_confidence,
)

SIZE = (48, 64)
mixed = jax.jit(combine, static_argnames="texture_unknown")


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
    blocks = np.mean([c.reshape(height // QUIET, QUIET, width // QUIET, QUIET) for c in curved], axis=(2, 4)).min(
        axis=0
    )
    around = np.pad(blocks, 1, constant_values=np.inf)
    least = [[around[y : y + 3, x : x + 3].min() for x in range(blocks.shape[1])] for y in range(blocks.shape[0])]
    quiet = 1.68 * np.asarray(jax.image.resize(np.asarray(least), (height, width), "linear"))
    for y, x in np.ndindex(height, width):
        window = np.s_[max(y - RADIUS, 0) : y + RADIUS + 1, max(x - RADIUS, 0) : x + RADIUS + 1]
        energy, variance = square[window].mean(), min(each[window].mean() for each in curved)
        number = square[window].sum() ** 2 / (square[window] ** 2).sum()
        part = np.clip((MUCH - np.sqrt(variance)) / (MUCH - LITTLE), 0, 1)
        alone = min(each[y, x] for each in curved) > 0.4 * square[y, x]
        if not (square[y, x] > 50 * energy and alone and change[y, x].mean() > 0):
            variance += part * part * (3 - 2 * part) * (min(variance, quiet[y, x]) - variance)
        part = np.clip((MUCH - np.sqrt(variance)) / (MUCH - LITTLE), 0, 1)
        doubt = min(DOUBT / np.sqrt(number), MOST) * (1 - 0.5 * part * part * (3 - 2 * part))
        share[y, x] = np.clip(1 - (1 + doubt) * variance / energy, 0, 1)
        noise[y, x] = np.sqrt(variance)
        firefly[y, x] = variance > 0.7 * energy and energy > 0.1
    level = np.median(noise)  # of one block
    part = np.clip((NOISY - level) / (NOISY - CLEAN), 0, 1)
    clean = np.where(firefly, 0, part * part * (3 - 2 * part))
    return (share + (1 - share) * clean)[..., None], noise[..., None]


@pytest.mark.parametrize("deviation", [0.005, 0.05, 0.4, 0.8])
def test_the_share_is_that_of_numpy(rng, deviation):
    truth, blurred = (image[:BLOCK, :BLOCK] for image in box(BLOCK, BLOCK))
    noisy = (truth * rng.gamma(deviation**-2, deviation**2, truth.shape)).astype(np.float32)
    share, noise = reference(noisy, blurred)
    found = mixed(noisy, blurred)
    np.testing.assert_allclose(found.noisy_weight, share, atol=2e-4)
    np.testing.assert_allclose(found.noise, noise, rtol=1e-4)
    np.testing.assert_allclose(found.image, blurred + share * (noisy - blurred), atol=1e-3)


def test_what_has_no_noise_comes_back(rng):
    truth, blurred = box(*SIZE)
    assert mse(blurred, truth) > 1e-3
    assert mse(mixed(truth, blurred).image, truth) < 1e-6


@pytest.mark.parametrize("samples", [1, 4, 16, 64, 256])
def test_the_mixture_is_not_worse_than_either(rng, samples):
    """Of exponential noise, the mean of so many samples; at few of them nothing is lost, at many detail comes back."""
    truth, blurred = box(*SIZE)
    noisy = (truth * rng.gamma(samples, 1 / samples, truth.shape)).astype(np.float32)
    image = mixed(noisy, blurred).image
    assert mse(image, truth) < 1.01 * min(mse(noisy, truth), mse(blurred, truth))
    if samples >= 64:
        assert mse(image, truth) < 0.6 * min(mse(noisy, truth), mse(blurred, truth))


def speckled(rng, height=96, width=128):
    """A wall with a texture of single pixels on half of it, which is lost in the denoised version."""
    wall = np.full((height, width, 3), 0.5, np.float32)
    truth = wall.copy()
    truth[:, : width // 2] *= rng.choice([0.7, 1.3], (height, width // 2, 1)).astype(np.float32)
    return truth, wall


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.2])
def test_texture_of_single_pixels_comes_back_where_quiet_blocks_are_near(rng, deviation):
    """Near the border of the texture the noise of the wall tells what is noise; as sharp as the noise allows."""
    truth, wall = speckled(rng)
    noisy = truth * (1 + deviation * rng.standard_normal(truth[..., :1].shape)).astype(np.float32)
    image = np.asarray(mixed(noisy, wall).image)
    near, bare = np.s_[:, 59:63], np.s_[:, 80:]
    assert mse(image[near], truth[near]) < 0.05 * mse(wall[near], truth[near]) + 1.1 * mse(noisy[near], truth[near])
    assert mse(image[bare], truth[bare]) <= 0.6 * mse(noisy[bare], truth[bare])


def test_the_least_of_blocks_has_no_bias(rng):
    """Of grey Gaussian noise: what is measured is its variance, near or far blocks alike."""
    noise = np.repeat(rng.standard_normal((640, 640, 1)), 3, axis=-1)
    flat = np.ones_like(noise, np.float32)
    for texture_unknown in (False, True):
        found = mixed(jnp.asarray(flat + 0.1 * noise, jnp.float32), flat, texture_unknown=texture_unknown)
        measured = np.mean(np.square(np.asarray(found.noise) * 1.05))  # relative to the light and 5 % of its mean
        assert 0.85 < measured / 0.1**2 < 1.0  # at most that of the window, which is sometimes less


def test_a_bright_speck_in_a_quiet_place_is_a_firefly(rng):
    wall = np.full((64, 64, 3), 0.5, np.float32)
    noisy = wall * (1 + 0.1 * rng.standard_normal((64, 64, 1))).astype(np.float32)
    noisy[20, 20] = 2.0
    image = np.asarray(mixed(noisy, wall).image)
    assert np.abs(image[20, 20] - 0.5).max() < 0.1


@pytest.mark.parametrize(("samples", "trusted"), [(1, True), (16, False), (256, False)])
def test_a_frame_that_lost_more_than_noise_explains_is_not_trusted(rng, samples, trusted):
    """Guides of another picture drew their own pattern into the denoised image; one sample is still worse."""
    truth = np.full((96, 128, 3), 0.5, np.float32)
    pattern = np.kron(rng.uniform(0.3, 1.7, (12, 16, 1)), np.ones((8, 8, 3))).astype(np.float32)
    noisy = (truth * rng.gamma(samples, 1 / samples, truth[..., :1].shape)).astype(np.float32)
    for denoised, expected in ((truth * pattern, trusted), (truth, True)):
        confidence = measure_confidence(mixed(noisy, denoised))
        assert (confidence.fallback < 0.05) if expected else (confidence.fallback > 0.95)
    assert abs(float(confidence.noise) - samples**-0.5) < 0.15 * samples**-0.5 + 0.01


def test_half_of_a_frame_may_be_clean(rng):
    """Noise on one half is taken away, detail on the other comes back."""
    height, width = 64, 192
    truth, blurred = box(height, width)
    noisy = truth.copy()
    noisy[:, 96:] *= rng.gamma(1.0, 1.0, noisy[:, 96:].shape).astype(np.float32)
    image = np.asarray(mixed(noisy, blurred).image)
    assert mse(image[:, :64], truth[:, :64]) < 1e-3 * mse(blurred[:, :64], truth[:, :64])
    assert mse(image[:, 128:], truth[:, 128:]) < 1.01 * mse(blurred[:, 128:], truth[:, 128:])


def test_fireflies_and_invalid_values_do_not_come_back():
    denoised = np.full((*SIZE, 3), 0.5, np.float32)
    noisy = denoised.copy()
    noisy[20, 30], noisy[3, 3, 0], noisy[40, 50], noisy[5, 60] = 200.0, np.nan, np.inf, -1.0
    found = mixed(noisy, denoised)
    np.testing.assert_allclose(found.image, denoised, atol=1e-6)
    assert np.isfinite(found.noisy_weight).all()


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (3, 2, 3)])
def test_small_and_black_images_stay_finite(shape):
    black = jnp.zeros(shape)
    for noisy in (black, black + 65504.0):
        for denoised in (black, black + 1.0):
            found = mixed(noisy, denoised)
            assert np.isfinite(found.image).all()
            assert np.isfinite(found.noise).all()
            assert np.isfinite(found.lost).all()


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match="noisy and denoised: expected the same size"):
        mixed(jnp.zeros((4, 4, 3)), jnp.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="noisy: expected 3 channels"):
        mixed(jnp.zeros((4, 4, 1)), jnp.zeros((4, 4, 1)))
