"""The gains of the Kalman filter: against float64 NumPy, and what they do on light whose truth is known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxdn.filters.kalman import PLANES, RECEPTIVE_FIELD, box_sum, kalman_blend, measure_support

SIZE = (48, 64)
blend = jax.jit(kalman_blend, static_argnames=("history_max",))


def window_sums(plane, radius):
    """Sums over squares, pixel by pixel."""
    height, width = plane.shape
    wide = np.pad(plane, radius)
    side = 2 * radius + 1
    return np.array([[wide[y : y + side, x : x + side].sum() for x in range(width)] for y in range(height)])


def blend_in_numpy(past, valid, image, noisy, exposure, fetch_error, history_max, measured=True):
    """The equations of the module's docstring, in the order in which they stand."""
    measured = measured * np.ones(valid.shape)
    d = np.where(valid, exposure * (image - past[:3]), 0)
    e = np.where(valid, exposure * (noisy - past[:3]), 0)
    before = np.where(valid, past[3], 0)
    kept = np.where(valid, (exposure * past[5]) ** 2, 0)
    count = window_sums(measured, 3)
    now = window_sums(measured * ((exposure * (noisy - image)) ** 2).mean(axis=0), 3)
    now = np.where(count > 0, now / np.maximum(count, 1), kept)
    v = np.maximum(np.maximum(now, kept), 1e-8)
    tracked = np.where(kept > 0, 0.8 * kept + 0.2 * now, now)
    most = np.maximum(3 * np.sqrt(v), np.abs(d))
    e = np.clip(e, -most, most)
    s = np.zeros(valid.shape)
    for radius in (3, 7):
        a, b = (window_sums(measured * (d * each).sum(axis=0) / v, radius) for each in (e, d))
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.maximum(s, np.where(b > 0, a / b - 3.5 / np.sqrt(b), 0))
    s = np.minimum(s, 1)
    square = (d * d).mean(axis=0)
    number = np.maximum(window_sums(valid.astype(float), 1), 1)
    q = s**2 * window_sums(square, 1) / number
    own = window_sums((1 - s**2) * square, 1) / number
    r = np.where(valid, (exposure * past[4]) ** 2, 0)
    last = np.maximum(before, 1 / history_max)
    bias = np.where(valid, exposure**2 * fetch_error, 0)
    around = window_sums(np.maximum((1 - s**2) * square - bias / last**2, 0), 7) / np.maximum(
        window_sums(valid.astype(float), 7), 1
    )
    r = np.where(r > 0, r, around / 2)
    p = before * r
    q = q + bias * (2 - last) ** 2 / last
    with np.errstate(invalid="ignore"):
        k = np.where(p + q + r > 0, (p + q) / (p + q + r), 1)
    k = np.where(valid, np.maximum(k, 1 / history_max), 1)
    color = np.where(valid, past[:3] + k * (image - past[:3]), image)
    with np.errstate(divide="ignore", invalid="ignore"):
        sample = np.where(r > 0, np.minimum(own / (1 + before + bias / last**2 / r), 3 * r), 0)
    r = np.where(valid, 0.8 * r + 0.2 * sample, 0)
    return np.concatenate([color, np.stack([k, np.sqrt(r) / exposure, np.sqrt(tracked) / exposure])])


def draw_frame(rng, size=SIZE):
    truth = rng.uniform(0.2, 1, (3, *size))
    past = np.concatenate([truth + 0.05 * rng.normal(size=truth.shape), rng.uniform(0.1, 1, (3, *size))])
    past[4:] *= rng.random((2, *size)) > 0.2
    past[:3, 10:20, 10:30] *= 2  # a change
    return np.maximum(past, 0), rng.random(size) > 0.1, truth * 1.01, truth * rng.exponential(size=truth.shape)


@pytest.mark.parametrize("size", [SIZE, (1, 1), (3, 50)])
def test_it_is_what_its_equations_say(size, rng, x64):
    for history_max in (1, 16):
        arguments = (*draw_frame(rng, size), 0.3, 0.01 * rng.random(size) * (rng.random(size) > 0.5))
        found = blend(*map(jnp.asarray, arguments), history_max=history_max)
        np.testing.assert_allclose(found, blend_in_numpy(*arguments, history_max), rtol=1e-9, atol=1e-12)


def test_what_is_not_measured_counts_for_nothing(rng, x64):
    """Whatever its radiance, also where nothing around a pixel is measured."""
    past, valid, image, noisy = draw_frame(rng, (40, 36))
    measured, bias = rng.random(valid.shape) < 0.3, 0.01 * rng.random(valid.shape)
    measured[:18, :18] = False
    expected = blend_in_numpy(past, valid, image, noisy, 0.3, bias, 16, measured)
    for other in (noisy, np.where(measured, noisy, 0.0)):
        found = blend(*map(jnp.asarray, (past, valid, image, other, 0.3, bias, measured)), history_max=16)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_single_precision_is_enough(rng):
    arguments = (*draw_frame(rng), 0.3)
    single = blend(*map(jnp.asarray, arguments), history_max=16)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, blend_in_numpy(*arguments, 0.0, 16), rtol=2e-3, atol=2e-4)


@pytest.mark.slow
@given(st.integers(0, 9), st.integers(1, 40), st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_sums_of_windows_are_those_of_their_pixels(radius, height, width):
    planes = np.random.default_rng(radius).normal(size=(2, height, width)).astype(np.float32)
    expected = np.stack([window_sums(plane, radius) for plane in planes])
    # One program for each size, in place of one for each operation.
    np.testing.assert_allclose(jax.jit(partial(box_sum, radius=radius))(planes), expected, atol=1e-4)


@given(st.floats(-12, 12), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_gains_have_no_unit(exponent, seed):
    """Light in any unit has the same gains: by powers of two to the last bit."""
    past, valid, image, noisy = draw_frame(np.random.default_rng(seed), (16, 20))
    unit = 2.0 ** round(exponent)
    usual = blend(past, valid, image, noisy, jnp.float32(0.25), history_max=16)
    scaled = past * np.array([unit] * 3 + [1] + [unit] * 2)[:, None, None]
    other = blend(scaled, valid, unit * image, unit * noisy, jnp.float32(0.25 / unit), history_max=16)
    np.testing.assert_allclose(other[3], usual[3], rtol=1e-6)
    np.testing.assert_allclose(other[:3] / unit, usual[:3], rtol=1e-6)


@pytest.mark.parametrize("ratio", [0.001, 0.01, 0.1, 1.0, 10.0])
def test_the_gain_that_stays_has_the_least_error(ratio, rng):
    """Where every fetch errs by b alike: that of the minimum of ``(b (1 - k) / k)^2 + r k / (2 - k)``."""
    bias, size = np.sqrt(ratio) * 0.03, (40, 40)
    past, gains = jnp.zeros((PLANES, *size)), []
    for index in range(60):
        image = (0.5 + 0.03 * rng.normal(size=(3, *size))).astype(np.float32)
        noisy = (0.5 + rng.normal(size=(3, *size))).astype(np.float32)
        fetched = past.at[:3].add(bias)
        past = blend(
            fetched, np.full(size, index > 0), image, noisy, jnp.float32(1), jnp.full(size, bias**2), history_max=100
        )
        gains.append(float(jnp.median(past[3])))
    grid = np.linspace(0.01, 1, 1000)
    best = grid[np.argmin(ratio * (1 - grid) ** 2 / grid**2 + grid / (2 - grid))]
    assert abs(np.mean(gains[40:]) - best) < 0.06 + 0.05 * best, (np.mean(gains[40:]), best)


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_image_lies_between_the_new_one_and_the_history(seed):
    past, valid, image, noisy = draw_frame(np.random.default_rng(seed), (16, 20))
    found = np.asarray(blend(past, valid, image, noisy, jnp.float32(0.3), history_max=16))
    low, high = np.minimum(past[:3], image), np.maximum(past[:3], image)
    assert (found[:3] >= low - 1e-5).all()
    assert (found[:3] <= high + 1e-5).all()
    assert (found[3] >= 1 / 16 - 1e-6).all()
    assert (found[3] <= 1).all()
    np.testing.assert_array_equal(found[:3, ~valid], image.astype(np.float32)[:, ~valid])


def test_nothing_farther_than_the_receptive_field_counts(rng):
    past, valid, image, noisy = (np.asarray(each) for each in draw_frame(rng))
    exposure = jnp.float32(0.3)
    usual = blend(past, valid, image, noisy, exposure, history_max=16)
    changed = noisy.copy()
    changed[:, 0, 0] += 100
    other = np.asarray(blend(past, valid, image, changed, exposure, history_max=16))
    rows, columns = np.nonzero((other != np.asarray(usual)).any(axis=0))
    assert 0 < max(rows.max(), columns.max()) <= RECEPTIVE_FIELD


# Light whose truth is known. The denoiser's errors are made: noise of its own, blurred as a denoiser's are.


def blur(noise):
    """Errors that neighbours share, of deviation 1."""
    for axis in (-1, -2):
        noise = sum(np.roll(noise, shift, axis) for shift in range(-2, 3))
    return noise / 5


def run(truth, rng, error, noise, history_max=16):
    """The images of a still camera over frames ``truth`` [T, 3, H, W], and the denoiser's own."""
    past, found, alone = jnp.zeros((PLANES, *truth.shape[2:])), [], []
    for index, light in enumerate(truth):
        image = np.maximum(light * (1 + error * blur(rng.normal(size=light.shape))), 0)
        noisy = light * (1 + noise * (rng.exponential(size=light.shape) - 1))
        valid = np.full(light.shape[1:], index > 0)
        past = blend(past, valid, np.float32(image), np.float32(noisy), np.float32(0.3), history_max=history_max)
        found.append(np.asarray(past[:3]))
        alone.append(image)
    return np.stack(found), np.stack(alone)


def mean_square(images, truth):
    return np.mean((images - truth) ** 2)


def test_errors_of_a_still_scene_fall_with_the_number_of_frames(rng):
    """As one over it, but for what is taken for a change: within a factor of 1.6 after 8 frames, 2 after 16."""
    truth = np.broadcast_to(rng.uniform(0.3, 1, (1, 3, *SIZE)), (16, 3, *SIZE))
    found, alone = run(truth, rng, error=0.05, noise=0.7)
    for frames, factor in ((2, 1.2), (8, 1.6), (16, 2.0)):
        ratio = mean_square(found[frames - 1], truth[0]) / mean_square(alone[frames - 1], truth[0])
        assert 0.8 < ratio * frames < factor, (frames, ratio * frames)


@pytest.mark.parametrize(("factor", "noise"), [(0.3, 0.7), (3.0, 0.7), (0.7, 0.3)])
def test_light_that_is_switched_is_there_at_once(factor, noise, rng):
    """In the frame of the change no more than a tenth of the old light is left, and after three a fiftieth."""
    truth = np.full((12, 3, *SIZE), 0.8)
    truth[6:] *= factor
    found, _ = run(truth, rng, error=0.03, noise=noise)
    left = np.abs((found[6:] - truth[6:]).mean(axis=(1, 2, 3))) / np.abs(truth[6] - truth[5]).mean()
    assert left[0] < 0.1
    assert left[3] < 0.02


def test_a_lamp_in_view_that_goes_out_is_gone_at_once(rng):
    """The lamp has no noise, the wall has much: a residual of many deviations that the image has too is no outlier."""
    truth = np.full((10, 3, *SIZE), 0.3)
    truth[:6, :, 18:30, 24:36] = 20.0
    noise = np.where(truth > 1, 0.001, 0.7)
    found, _ = run(truth, rng, error=0.01, noise=noise[0])
    lamp, around = (slice(20, 28), slice(26, 34)), (slice(10, 38), slice(16, 44))
    for index in (6, 9):
        assert np.abs(found[index][:, *lamp] - 0.3).mean() < 0.03
        assert np.abs(found[index][:, *around] - 0.3).mean() < 0.03


def test_an_outlier_is_no_proof(rng):
    """One pixel of 1000, half of which the denoiser lets through, where nothing changed: it does not stay."""
    truth = np.full((3, *SIZE), 0.5, np.float32)
    past = jnp.zeros((PLANES, *SIZE))
    for index in range(8):
        image = truth * (1 + 0.03 * blur(rng.normal(size=truth.shape)))
        noisy = truth * (1 + 0.7 * (rng.exponential(size=truth.shape) - 1))
        if index == 7:
            noisy[:, 20, 30], image[:, 19:22, 29:32] = 1000.0, 50.0
        valid = np.full(SIZE, index > 0)
        past = blend(past, valid, np.float32(image), np.float32(noisy), np.float32(0.3), history_max=16)
    assert np.asarray(past[:3, 20, 30]).max() < 0.2 * 50


def test_a_moving_shadow_does_not_trail(rng):
    """What it leaves behind is within 1.3 times the denoiser's own error after two frames; a plain mean is far off."""
    columns = np.arange(SIZE[1])
    shadows = [(columns >= 3 * index) & (columns < 3 * index + 12) for index in range(14)]
    truth = np.stack([np.broadcast_to(np.where(shadow, 0.2, 0.8), (3, *SIZE)) for shadow in shadows])
    found, alone = run(truth, rng, error=0.05, noise=0.5)
    mean = np.cumsum(alone, axis=0) / np.arange(1, 15)[:, None, None, None]
    trail = shadows[10] & ~shadows[12]
    errors = [mean_square(images[12][..., trail], truth[12][..., trail]) for images in (found, alone, mean)]
    assert errors[0] < 1.3 * errors[1]
    assert errors[2] > 10 * errors[1]
    far = ~np.any(shadows, axis=0)
    still = [mean_square(images[12][..., far], truth[12][..., far]) for images in (found, alone)]
    assert still[0] < 0.3 * still[1]


def test_frames_without_noise_stay_as_they_are(rng):
    """Also where they change a little, and where the history is blurred."""
    truth = rng.uniform(0.1, 1, (6, 3, *SIZE))
    truth[1:3] = truth[0]
    truth[4] = 1.01 * truth[3]
    truth = truth.astype(np.float32)
    found, _ = run(truth, rng, error=0.0, noise=0.0)
    np.testing.assert_array_equal(found[:3], truth[:3])
    np.testing.assert_allclose(found[3:], truth[3:], rtol=1e-3)


def test_support_is_no_more_than_chance_where_nothing_changed(rng):
    """Residuals of pure noise support less than a hundredth of the innovations."""
    innovation = 0.05 * blur(rng.normal(size=(3, 96, 128))).astype(np.float32)
    noise = 0.7 * rng.normal(size=innovation.shape).astype(np.float32)
    variance = jnp.full((96, 128), 0.49)
    measure = jax.jit(measure_support)
    assert measure(noise, innovation, variance).mean() < 0.01
    assert measure(noise + 20 * innovation, 20 * innovation, variance).mean() > 0.7
