"""The light that a history lacks: a change is told from noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.methods.steady.lighting_change import estimate_change, receptive_field, split_checkerboard
from jaxdn.ops.affinity.filter import Guide, affinity_filter
from tests.gradients import check_gradients

SIZE = 96, 128


@jax.jit
def noticed(difference, light=None, hit=None):
    """The change after four levels of a filter that knows one even wall."""
    size = difference.shape[:2]
    light = jnp.ones_like(difference) if light is None else light
    hit = jnp.ones(size, bool) if hit is None else hit
    alike = Guide(jnp.zeros((1, *size)), jnp.zeros((3, *size)), hit * 1.0)
    planes = split_checkerboard(difference.transpose(2, 0, 1))
    for step in (1, 2, 4, 8):
        planes = affinity_filter(planes, alike, step=step)
    return estimate_change(planes, light.transpose(2, 0, 1), hit).transpose(1, 2, 0)


def noise(rng, strength=1.0):
    """Light of single samples less its mean, which many pixels have nothing of and some much."""
    light = rng.exponential(size=(*SIZE, 1)) * (rng.uniform(size=(*SIZE, 1)) < 0.3) / 0.3
    return (strength * (light - 1.0) * np.ones(3)).astype(np.float32)


def test_halves_are_the_squares_of_a_checkerboard_and_signs_alternate_by_row(rng):
    difference = rng.normal(size=(4, 6, 3)).astype(np.float32)
    rows, columns = np.mgrid[:4, :6]
    white = (rows + columns) % 2 == 1
    found = np.asarray(jax.jit(split_checkerboard)(difference.transpose(2, 0, 1))).transpose(1, 2, 0)
    np.testing.assert_array_equal(found[..., :3], np.where(white[..., None], 0, difference))
    np.testing.assert_array_equal(found[..., 3:6], np.where(white[..., None], difference, 0))
    level = difference @ np.float32([0.2126, 0.7152, 0.0722]) * (-1.0) ** rows
    np.testing.assert_allclose(found[..., 6], np.where(white, 0, level), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[..., 7], np.where(white, level, 0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("rise", [-0.5, 0.3, 4.0])
def test_an_even_change_is_found_in_the_noise_of_single_samples(rise, rng):
    found = np.asarray(noticed(noise(rng) + rise))[24:-24, 24:-24]
    np.testing.assert_allclose(found.mean(), rise, rtol=0.25)
    assert (np.sign(found) == np.sign(rise)).mean() > 0.97


def test_noise_is_no_change(rng):
    """Of the power that a filter alone would leave of it, less than a fifth is added."""

    @jax.jit
    def filtered(given):
        alike = Guide(jnp.zeros((1, *SIZE)), jnp.zeros((3, *SIZE)), jnp.ones(SIZE))
        planes = given.transpose(2, 0, 1)
        for step in (1, 2, 4, 8):
            planes = affinity_filter(planes, alike, step=step)
        return planes

    added, plain = [], []
    for _ in range(8):
        given = noise(rng)
        added.append(np.square(noticed(given)).mean())
        plain.append(np.square(filtered(given)).mean())
    assert np.mean(added) < 0.2 * np.mean(plain)


@pytest.mark.slow
def test_noise_does_not_darken(rng):
    """Shares that know the bright samples that they are taken of make it 13 %, four standard errors."""
    added = [np.asarray(noticed(noise(rng))) for _ in range(400)]
    mean, size = np.mean([(each.mean(), np.abs(each).mean()) for each in added], axis=0)
    assert np.abs(mean) < 0.08 * size


def test_nothing_new_adds_nothing_and_an_exact_change_is_taken_whole():
    np.testing.assert_array_equal(noticed(np.zeros((*SIZE, 3))), 0.0)
    whole = np.asarray(noticed(np.full((*SIZE, 3), 0.25)))
    # At the border the signs do not cancel.
    np.testing.assert_allclose(whole[40:-40, 40:-40], 0.25, rtol=1e-3)


def test_brightness_does_not_matter(rng):
    given = noise(rng) + 0.3
    plain = np.asarray(noticed(given))
    for gain in (2.0**-12, 2.0**10):
        scaled = noticed(gain * given, np.full((*SIZE, 3), gain))
        np.testing.assert_allclose(np.asarray(scaled) / gain, plain, rtol=1e-4, atol=1e-6)


def test_the_sky_says_nothing_of_noise(rng):
    """What lies in it changes nothing at a surface."""
    hit = np.ones(SIZE, bool)
    hit[:, 64:] = False
    given = np.array(noise(rng) + 0.3)
    one, other = given.copy(), given.copy()
    one[:, 64:], other[:, 64:] = 0.0, 1e3
    one, other = (np.asarray(noticed(each, hit=hit)) for each in (one, other))
    np.testing.assert_allclose(one[:, :64], other[:, :64], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [1e30, 65504.0, 1e-30])
def test_any_light_is_bounded_by_what_came_in(size, rng):
    given = size * noise(rng)
    found = np.asarray(noticed(given, np.full((*SIZE, 3), size)))
    assert np.isfinite(found).all()
    assert np.abs(found).max() <= 1.001 * np.abs(given).max()


def test_no_further_than_it_says(rng):
    """Filtered differences beyond its reach change nothing."""
    filtered = rng.uniform(0.5, 1.5, (8, *SIZE)).astype(np.float32)
    filtered[6:] *= 0.5
    tripled = filtered.copy()
    tripled[..., 64] *= 3.0
    light, hit = np.ones((3, *SIZE)), np.ones(SIZE, bool)
    plain, changed = (np.asarray(jax.jit(estimate_change)(each, light, hit)) for each in (filtered, tripled))
    differs = np.flatnonzero((plain != changed).any(axis=(0, 1)))
    assert differs.min() == 64 - receptive_field()
    assert differs.max() == 64 + receptive_field()


@pytest.mark.slow
def test_gradients(rng, x64):
    filtered = rng.uniform(0.5, 1.5, (8, 12, 14))
    filtered[6:] *= 0.4
    light, hit = rng.uniform(0.5, 1.5, (3, 12, 14)), np.ones((12, 14), bool)
    assert np.asarray(jax.jit(estimate_change)(filtered, light, hit)).min() > 0
    check_gradients(lambda *given: estimate_change(*given, hit), (filtered, light), rtol=1e-5)
