"""Histories that take their texture from the new albedo: against float64 NumPy, and on known textures."""

import jax
import numpy as np
import pytest

from jaxdn.filters.albedo_history import follow_albedo, measure_share

share_of, moved_by = jax.jit(measure_share), jax.jit(follow_albedo)

SIZE = (24, 32)


def share_in_numpy(history, before, albedo, image, exposure):
    h, y = exposure * history, exposure * image
    g = h * ((albedo + 0.02) / (before + 0.02) - 1)
    w = 1 / (y.mean(axis=0) ** 2 + h.mean(axis=0) ** 2 + 1e-8)
    both, own = (w * (each * g).sum(axis=0) for each in (y - h, g))
    found = np.zeros(both.shape)
    for row, column in np.ndindex(both.shape):
        near = slice(max(row - 3, 0), row + 4), slice(max(column - 3, 0), column + 4)
        if own[near].sum() > 0:
            found[row, column] = np.clip(both[near].sum() / own[near].sum(), 0, 1)
    return found


def test_the_share_is_what_its_equation_says(rng, x64):
    history, image = rng.uniform(0, 2, (2, 3, *SIZE))
    before, albedo = rng.uniform(0, 1, (2, 3, *SIZE))
    albedo[:, :12, :12] = before[:, :12, :12]
    found = share_of(history, before, albedo, image, 0.3)
    np.testing.assert_allclose(found, share_in_numpy(history, before, albedo, image, 0.3), rtol=1e-9, atol=1e-12)
    moved = moved_by(history, before, albedo, found)
    expected = history + np.asarray(found) * history * ((albedo + 0.02) / (before + 0.02) - 1)
    np.testing.assert_allclose(moved, expected, rtol=1e-9)


@pytest.mark.parametrize("precise", [True, False])
def test_texture_is_followed_and_noise_is_not(precise, rng):
    """A blurred texture in even light is sharp again; the noise of an albedo leaves the history as it was."""
    texture = rng.uniform(0.2, 0.8, (3, *SIZE))
    blurred = (texture + np.roll(texture, 1, axis=2)) / 2
    if precise:
        before, albedo, history, truth = blurred, texture, 3 * blurred, 3 * texture
    else:
        before, albedo = np.clip(0.5 + 0.2 * rng.normal(size=(2, 3, *SIZE)), 0, 1)
        history = truth = np.full((3, *SIZE), 1.5)
    image = truth * (1 + 0.05 * rng.normal(size=truth.shape))
    share = np.asarray(share_of(history, before, albedo, image, 0.2))
    assert (share > 0.85).all() if precise else share.mean() < 0.05
    errors = [np.mean((np.asarray(each) - truth) ** 2) for each in (moved_by(history, before, albedo, share), image)]
    assert errors[0] < 0.3 * errors[1]
