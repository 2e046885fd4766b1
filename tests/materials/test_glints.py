"""Glints against the binomial distribution, the smooth lobe, and the counting rule written in plain integers."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxdn.materials import glints, microfacets
from tests.gradients import check_gradients

OPTIONS = ("lobe", "flakes", "bins")
LEVEL = 6
glint_distribution = jax.jit(glints.glint_distribution, static_argnames=OPTIONS)
flake_normals = jax.jit(glints.flake_normals, static_argnums=0, static_argnames=OPTIONS)


@partial(jax.jit, static_argnames=OPTIONS)
def ratio(half, position, width, rough, **options):
    """[H, W] glints divided by the smooth distribution."""
    smooth = microfacets.distribution(half, rough, lobe=options.get("lobe", "ggx"))
    return (glints.glint_distribution(half, position, width, rough, **options) / smooth)[..., 0]


def cells(level, tile=(0, 0)):
    """[n, n, 2] centres of the cells of a level of the quadtree."""
    count = 2**level
    centres = (np.arange(count) + 0.5) / count
    return np.stack(np.meshgrid(centres + tile[0], centres + tile[1]), -1).astype(np.float32)


def everywhere(shape, value):
    return np.broadcast_to(np.float32(value), (*shape, len(value)))


def relative(level, half=(0.1, 0.2, 0.9), *, tile=(0, 0), footprint=None, **options):
    """Count over expected count [n, n] in the cells of a level: one program for all of them, up to the finest."""
    shape = (2**LEVEL, 2**LEVEL)
    width = everywhere(shape, [2.0**-level if footprint is None else footprint])
    found = ratio(everywhere(shape, half), cells(LEVEL, tile), width, everywhere(shape, [0.5]), **options)
    step = 2 ** (LEVEL - level)
    return np.asarray(found, np.float64)[::step, ::step]


@pytest.mark.parametrize(("lobe", "flakes"), [("ggx", 1), ("ggx", 32), ("ggx", 33), ("ggx", 256), ("beckmann", 256)])
def test_the_mean_over_the_cells_is_the_smooth_distribution(lobe, flakes):
    for level in (0, 1, 4, 6):
        found = relative(level, lobe=lobe, flakes=flakes)
        np.testing.assert_allclose(found.mean(), 1, rtol=1e-5)
        np.testing.assert_allclose(found * flakes / 4**level, np.round(found * flakes / 4**level), atol=1e-4)


def test_counts_of_four_cells_add_up_to_their_parents():
    for level in (1, 4, 6):
        children, parent = relative(level), relative(level - 1)
        size = 2 ** (level - 1)
        np.testing.assert_allclose(children.reshape(size, 2, size, 2).mean((1, 3)), parent, rtol=1e-5)


@pytest.mark.parametrize(("level", "flakes"), [(1, 33), (2, 256), (4, 256)])
def test_counts_are_binomial(level, flakes):
    """One cell of each of 4096 tiles."""
    share = 4.0**-level
    tiles = np.stack(np.meshgrid(np.arange(-32, 32), np.arange(5, 69)), -1).astype(np.float32) + np.float32(0.01)
    shape = tiles.shape[:2]
    width = everywhere(shape, [2.0**-level])
    found = ratio(everywhere(shape, (0.1, 0.2, 0.9)), tiles, width, everywhere(shape, [0.5]), flakes=flakes)
    counts = np.round(np.asarray(found).ravel() * flakes * share)
    edges = np.unique(stats.binom.ppf([0, 0.1, 0.3, 0.5, 0.7, 0.9], flakes, share))
    observed = np.histogram(counts, [-np.inf, *(edges + 0.5), np.inf])[0]
    below = np.concatenate([stats.binom.cdf(edges, flakes, share), [1.0]])
    expected = np.diff(below, prepend=0.0) * counts.size
    kept = expected > 5
    kept[-1] = True
    chi2 = np.sum((observed - expected)[kept] ** 2 / expected[kept])
    assert chi2 < stats.chi2.ppf(0.9999, kept.sum())


def test_a_larger_footprint_converges_to_the_smooth_distribution():
    spread = [relative(6, footprint=2.0**-level).std() for level in (6, 4, 2, 0)]
    for found, level in zip(spread, (6, 4, 2), strict=False):
        assert found == pytest.approx(np.sqrt((4.0**level - 1) / glints.FLAKES), rel=0.25)
    for footprint in (1.0, 30.0, np.inf):
        np.testing.assert_array_equal(relative(3, footprint=footprint), 1)


def test_between_two_levels_it_is_linear():
    coarse, fine = relative(5, footprint=1 / 4), relative(5, footprint=1 / 8)
    between = relative(5, footprint=2**-2.3)
    np.testing.assert_allclose(between, 0.7 * coarse + 0.3 * fine, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(between.mean(), 1, rtol=1e-4)


def mixed(bits):
    bits = ((bits ^ (bits >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
    bits = ((bits ^ (bits >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    return bits ^ (bits >> 16)


def hashed(node, index):
    return mixed(node ^ mixed((index + 0x9E3779B9) & 0xFFFFFFFF))


def counted(seed, tile, direction, cell, level, flakes):
    """Flakes of one bin in the cell (x, y) of a level, in Python's integers, bit by bit."""
    node = hashed(hashed(hashed(hashed(seed, 0), tile[0] & 0xFFFFFFFF), tile[1] & 0xFFFFFFFF), direction)
    count = flakes
    for depth in reversed(range(level)):
        for axis in (0, 1):
            ones = sum(hashed(node, 2 + flake // 32) >> (flake % 32) & 1 for flake in range(count))
            upper = cell[axis] >> depth & 1
            count = count - ones if upper else ones
            node = hashed(node, upper)
    return count


def test_the_counting_rule_in_plain_integers():
    """The flakes of a seed are the same on every machine: a scene's textures are made of them."""
    level, flakes, middle = 3, 33, 7 * 15 + 7
    for seed, tile in ((0, (0, 0)), (123456789, (-2, 5))):
        found = relative(level, (0, 0, 1), tile=tile, seed=seed, flakes=flakes) * flakes / 4**level
        expected = [[counted(seed, tile, middle, (x, y), level, flakes) for x in range(8)] for y in range(8)]
        np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.slow
def test_a_cell_knows_nothing_of_its_batch(rng):
    shape = (6, 5)
    half, position = rng.normal(0, 0.3, (*shape, 3)) + [0, 0, 1], rng.uniform(-4, 4, (*shape, 2))
    width, rough = rng.uniform(0.01, 0.4, (*shape, 1)), rng.uniform(0.2, 0.9, (*shape, 1))
    arguments = [each.astype(np.float32) for each in (half, position, width, rough)]
    usual = np.asarray(glint_distribution(*arguments))
    np.testing.assert_allclose(glints.glint_distribution(*arguments), usual, rtol=1e-5)
    flipped = glint_distribution(*(one[::-1, ::-1] for one in arguments))
    np.testing.assert_array_equal(np.asarray(flipped)[::-1, ::-1], usual)
    batched = jax.jit(jax.vmap(glint_distribution))(*(np.stack([one, one]) for one in arguments))
    np.testing.assert_allclose(np.asarray(batched)[1], usual, rtol=1e-5)


def test_tiles_seeds_and_directions_have_flakes_of_their_own():
    usual = relative(5)
    others = [
        relative(5, tile=(1, 0)),
        relative(5, tile=(0, 1)),
        relative(5, tile=(-1, 0)),
        relative(5, seed=1),
        relative(5, (-0.1, 0.2, 0.9)),
        usual.T,
    ]
    for other in others:
        assert abs(np.corrcoef(usual.ravel(), other.ravel())[0, 1]) < 0.12
    np.testing.assert_allclose(relative(5, (0.101, 0.2, 0.9)), usual, rtol=1e-6)  # of the same bin


@pytest.mark.parametrize("lobe", microfacets.LOBES)
def test_normals_of_the_flakes_follow_the_distribution(lobe):
    normals = np.asarray(flake_normals(128, jnp.float32(0.6), lobe=lobe, flakes=256), np.float64)
    assert normals.shape == (128, 128, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert normals[..., 2].min() > 0
    x, y, z = normals[normals[..., 2] < 1].T
    assert len(z) > 0.95 * 128**2
    slope = (x**2 + y**2) / z**2 / 0.6**4
    inclined_less = slope / (1 + slope) if lobe == "ggx" else 1 - np.exp(-slope)
    assert stats.kstest(inclined_less, "uniform").pvalue > 1e-3
    assert stats.kstest(np.arctan2(y, x) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("lobe", microfacets.LOBES)
def test_the_normal_map_shows_the_flakes_that_are_counted(lobe):
    options = {"lobe": lobe, "flakes": 20, "bins": 9, "seed": 4}
    size, rough = 32, 0.5
    normals = flake_normals(size, jnp.float32(rough), **options)
    position, shape = cells(5), (size, size)
    here, width = everywhere(shape, [rough]), everywhere(shape, [1 / size])
    counts = np.asarray(ratio(normals, position, width, here, **options)) * 20 / size**2
    occupied = np.asarray(normals)[..., 2] < 1
    assert 0.7 < occupied.mean() < 0.9  # exp(-20 81 / 32^2) of them have none
    assert np.all(np.round(counts[occupied]) >= 1)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)
    assert np.all(counts[~occupied] == 0)
    # Nor does a texel without a flake reflect in any other direction.
    rng = np.random.default_rng(0)
    for _ in range(20):
        half = np.float32(rng.normal(0, 0.3, (*shape, 3)) + [0, 0, 1])
        assert np.all(np.asarray(glint_distribution(half, position, width, here, **options))[~occupied] == 0)


@pytest.mark.slow
@pytest.mark.parametrize("lobe", microfacets.LOBES)
def test_no_case_gives_anything_but_numbers(lobe):
    halves = [[0, 0, 1], [0, 0, 0], [1, 0, 0], [1, 0, 1e-20], [0, 1, -1], [0, 1e-30, 1e-30], [3e38, 1, 3e38]]
    positions = [[0, 0], [1, 1], [-1e-9, 0.5], [1e9, -1e30], [1 - 2**-24, 1]]
    widths = [0.0, -1.0, 1e-30, 1.0, 1e30, np.inf]
    grid = [(h, p, w) for h in halves for p in positions for w in widths]
    half, position, width = (jnp.asarray([[one[at]] for one in grid], jnp.float32) for at in range(3))
    width = width[..., None]

    @functools.partial(jax.jit, static_argnames="flakes")
    def slopes_and_values(*arguments, flakes):
        def total(*arguments):
            found = glint_distribution(*arguments, lobe=lobe, flakes=flakes)
            return jnp.sum(found), found

        return jax.grad(total, (0, 1, 2, 3), has_aux=True)(*arguments)

    for roughness in (0.0, 0.3, 1.0):
        rough = jnp.full((len(grid), 1, 1), roughness)
        for flakes in (1, 33):
            slopes, found = slopes_and_values(half, position, width, rough, flakes=flakes)
            assert np.isfinite(found).all()
            assert np.all(np.asarray(found) >= 0)
            assert all(np.isfinite(one).all() for one in slopes)
            np.testing.assert_array_equal(slopes[1], 0)
        sparse = flake_normals(16, jnp.float32(roughness), lobe=lobe, flakes=1, bins=3)
        assert np.isfinite(sparse).all()
        assert np.mean(np.asarray(sparse)[..., 2] == 1) > 0.9


@pytest.mark.slow
def test_gradients(x64, rng):
    shape = (3, 4)
    half = rng.normal(0, 0.3, (*shape, 3)) + [0, 0, 1]
    position, width = rng.uniform(-4, 4, (*shape, 2)), rng.uniform(0.1, 0.9, (*shape, 1))
    rough = rng.uniform(0.3, 0.9, (*shape, 1))
    for lobe in microfacets.LOBES:

        @jax.jit
        def run(half, width, rough, lobe=lobe):
            return glint_distribution(half, jnp.asarray(position), width, rough, lobe=lobe)

        check_gradients(run, [half, width, rough], eps=1e-7, atol=1e-4, rtol=1e-4)

        def incline(rough, lobe=lobe):
            return flake_normals(8, rough, lobe=lobe)

        check_gradients(incline, [jnp.float64(0.4)], atol=1e-4, rtol=1e-4)


def test_wrong_shapes_and_numbers_raise():
    half, position, one = jnp.ones((2, 3, 3)), jnp.ones((2, 3, 2)), jnp.ones((2, 3, 1))
    with pytest.raises(ValueError, match="position"):
        glints.glint_distribution(half, one, one, one)
    with pytest.raises(ValueError, match=r"footprint.*same size"):
        glints.glint_distribution(half, position, one[:1], one)
    with pytest.raises(ValueError, match="lobe"):
        glints.glint_distribution(half, position, one, one, lobe="phong")
    with pytest.raises(ValueError, match="flakes"):
        glints.glint_distribution(half, position, one, one, flakes=0)
    with pytest.raises(ValueError, match="bins"):
        glints.flake_normals(8, jnp.float32(0.5), bins=0)
    for size in (0, 12, -4):
        with pytest.raises(ValueError, match="power of two"):
            glints.flake_normals(size, jnp.float32(0.5))
