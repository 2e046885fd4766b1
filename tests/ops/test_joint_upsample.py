"""Joint bilateral upsampling against its formula in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops.affinity import joint_upsample as module
from jaxdn.ops.affinity.filter import Guide
from jaxdn.ops.affinity.joint_upsample import joint_bilateral_upsample
from tests.gradients import check_gradients


def drawn(rng, height=5, width=6, *, features=2):
    def guide(*size):
        return Guide(0.5 * rng.normal(size=(features, *size)), 0.2 * rng.normal(size=(3, *size)), rng.random(size))

    return rng.normal(size=(2, height, width)), guide(height, width), guide(2 * height, 2 * width)


def by_formula(coarse, there, here):
    channels, height, width = coarse.shape
    out, sums = np.zeros((channels, 2 * height, 2 * width)), np.zeros((2 * height, 2 * width))
    for y, x in np.ndindex(*sums.shape):
        total, weights, full = np.zeros(channels), 0.0, 0.0
        for b, a in [(y // 2 + dy, x // 2 + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]:
            away = np.array([2 * a + 0.5 - x, 2 * b + 0.5 - y])
            spatial = np.exp(-away @ away / 3)
            full += spatial
            if not (0 <= b < height and 0 <= a < width):
                continue
            offset = np.array([2 * a - x, 2 * b - y])
            slope = here.slanted[1:, y, x] + there.slanted[1:, b, a]
            residual = there.slanted[0, b, a] - here.slanted[0, y, x] - 0.5 * offset @ slope
            distance = residual**2 + ((there.features[:, b, a] - here.features[:, y, x]) ** 2).sum()
            one = spatial * np.exp(-distance) * there.confidence[b, a]
            total, weights = total + one * coarse[:, b, a], weights + one
        out[:, y, x], sums[y, x] = total / weights, weights / full
    return out, sums


@pytest.mark.parametrize(("name", "tile"), [("reference", 4096), ("reference", 12), ("unrolled", 4096)])
def test_it_is_the_formula(name, tile, rng, x64, monkeypatch):
    monkeypatch.setattr(module, "_TILE_PIXELS", tile)
    coarse, *guides = jax.tree.map(jnp.asarray, drawn(rng))
    # A function of its own: one that is jitted for the whole module would keep the tiles of its first call.
    found, weight = jax.jit(partial(joint_bilateral_upsample, implementation=name))(coarse, *guides)
    wanted, sums = by_formula(*jax.tree.map(np.asarray, (coarse, *guides)))
    np.testing.assert_allclose(found, wanted, rtol=1e-10)
    np.testing.assert_allclose(weight, sums, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reference", "unrolled"])
def test_gradients(name, rng, x64):
    coarse, there, here = drawn(rng, 3, 4)

    def upsampled(coarse, *parts):
        fine = Guide(*parts[3:], jnp.ones(here.confidence.shape))
        return joint_bilateral_upsample(coarse, Guide(*parts[:3]), fine, implementation=name)

    arguments = tuple(map(jnp.asarray, (coarse, *there[:3], *here[:2])))
    check_gradients(upsampled, arguments, atol=1e-5, rtol=1e-5)


def test_a_fine_pixel_that_nothing_resembles_has_no_weight(rng):
    coarse, there, here = drawn(rng)
    here.features[:, 4, 5] = 100.0
    upsample = jax.jit(lambda *given: joint_bilateral_upsample(*given))
    found, weight = jax.device_get(upsample(jnp.asarray(coarse), *jax.tree.map(jnp.asarray, (there, here))))
    assert weight[4, 5] == 0
    assert (found[:, 4, 5] == 0).all()
    assert (weight > 0).sum() == weight.size - 1


def test_light_does_not_cross_a_silhouette():
    """Two walls that meet between two fine pixels of one block: each takes from its own side alone."""
    side = (np.arange(16) >= 8).astype(np.float32)
    features = 10 * np.broadcast_to(side, (1, 8, 16))
    flat = np.zeros((3, 8, 16), np.float32)
    here = Guide(jnp.asarray(features), jnp.asarray(flat), jnp.ones((8, 16)))
    there = Guide(here.features[:, ::2, ::2], here.slanted[:, ::2, ::2], jnp.ones((4, 8)))
    found, _ = joint_bilateral_upsample(1.0 + there.features, there, here)
    np.testing.assert_allclose(found, 1.0 + features, rtol=1e-6)
