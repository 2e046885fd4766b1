"""The affinity filter against its formula in float64, its gradients, and what it promises at borders and edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops.affinity import filter as module
from jaxdn.ops.affinity.filter import SPLINE, Guide, affinity_filter
from jaxdn.ops.dispatch.operation import OPERATIONS
from tests.gradients import check_gradients


def drawn(rng, height=9, width=11, *, features=3, channels=2):
    image = rng.normal(size=(channels, height, width))
    slanted = 0.2 * rng.normal(size=(3, height, width))
    return image, 0.5 * rng.normal(size=(features, height, width)), slanted, rng.uniform(0.1, 1, (height, width))


def by_formula(image, features, slanted, confidence, step):
    channels, height, width = image.shape
    out = np.zeros_like(image)
    z, slope = slanted[0], slanted[1:]
    for i, j in np.ndindex(height, width):
        total, weight = np.zeros(channels), 0.0
        for dy, dx in np.ndindex(5, 5):
            dy, dx = dy - 2, dx - 2
            a, b = i + step * dy, j + step * dx
            if not (0 <= a < height and 0 <= b < width):
                continue
            expected = 0.5 * step * (np.array([dx, dy]) @ (slope[:, i, j] + slope[:, a, b]))
            distance = ((features[:, i, j] - features[:, a, b]) ** 2).sum() + (z[a, b] - z[i, j] - expected) ** 2
            one = SPLINE[abs(dy)] * SPLINE[abs(dx)] * confidence[a, b] * np.exp(-distance)
            total, weight = total + one * image[:, a, b], weight + one
        out[:, i, j] = total / weight
    return out


@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("tile", [16384, 22])
def test_it_is_the_formula(step, tile, rng, x64, monkeypatch):
    monkeypatch.setattr(module, "_TILE_PIXELS", tile)
    image, *guide = drawn(rng, 19)
    # A function of its own: one that is jitted for the whole module would keep the tiles of its first call.
    found = jax.jit(lambda image, *guide: affinity_filter(image, Guide(*guide), step=step))(image, *guide)
    np.testing.assert_allclose(found, by_formula(image, *guide, step), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("step", [1, 3])
def test_gradients(step, rng, x64):
    def filtered(image, *guide):
        return affinity_filter(image, Guide(*guide), step=step)

    check_gradients(filtered, tuple(map(jnp.asarray, drawn(rng))), atol=1e-5, rtol=1e-5)


@pytest.mark.slow  # test_operations.py compares them with the reference in all runs
@pytest.mark.parametrize(("step", "size"), [(1, (9, 11)), (2, (5, 130)), (3, (20, 64))])
def test_kernels_for_gpus_are_the_formula_and_have_its_gradient(step, size, rng, monkeypatch):
    """Interpreted where there is no GPU; gradients against those of the program that has no kernels."""
    image, *guide = (np.float32(each) for each in drawn(rng, *size))
    wanted = by_formula(image, *guide, step)

    def total(image, *guide):
        filtered = affinity_filter(image, Guide(*guide), step=step)
        return jnp.sum(jnp.sin(filtered)), filtered

    differentiated = jax.grad(total, argnums=(0, 1, 2, 3), has_aux=True)
    by_xla, _ = differentiated(image, *guide)
    declared = OPERATIONS["affinity_filter"].implementations
    here = declared["pallas"]._replace(platforms=("cpu",), unavailable=lambda: "")
    monkeypatch.setitem(declared, "pallas", here)
    monkeypatch.delitem(declared, "numba")
    by_kernels, filtered = differentiated(image, *guide)
    np.testing.assert_allclose(filtered, wanted, rtol=2e-5, atol=2e-6)
    for found, known in zip(by_kernels, by_xla, strict=True):
        np.testing.assert_allclose(found, known, rtol=2e-4, atol=1e-5)
    both, _ = jax.vmap(differentiated)(*(np.stack([each, 2 * each]) for each in (image, *guide)))
    for found, known in zip(both, by_kernels, strict=True):
        np.testing.assert_allclose(found[0], known, rtol=2e-4, atol=1e-5)


def test_a_plane_that_recedes_is_one_surface_and_two_planes_are_not(rng):
    """Inverse depth is affine on a plane; noise is averaged there as without the guide, and nothing crosses an edge."""
    rows, columns = np.mgrid[:16, :32].astype(np.float32)
    z = 3 * columns - 2 * rows
    slanted = np.stack([z, np.full_like(z, 3), np.full_like(z, -2)])
    image = rng.normal(size=(1, 16, 32)).astype(np.float32)
    nothing, all_of_it = np.zeros((0, 16, 32), np.float32), np.ones((16, 32), np.float32)
    flat = affinity_filter(image, Guide(nothing, np.zeros_like(slanted), all_of_it), step=2)
    np.testing.assert_allclose(affinity_filter(image, Guide(nothing, slanted, all_of_it), step=2), flat, rtol=1e-4)
    slanted[0, :, 16:] += 40
    image[:, :, 16:] += 100
    apart = affinity_filter(image, Guide(nothing, slanted, all_of_it), step=2)
    assert np.abs(apart[:, :, :16]).max() < 5
    assert apart[:, :, 16:].min() > 95


def test_pixels_without_confidence_give_nothing_and_may_hold_anything_large(rng):
    image, features, slanted, confidence = (np.float32(each) for each in drawn(rng))
    confidence[:, 5:] = 0
    guide = Guide(features, slanted, confidence)
    found = affinity_filter(image, guide)
    np.testing.assert_array_equal(found[:, :, 7:], image[:, :, 7:])  # no tap with confidence: the value stays
    image[:, :, 5:] = 1e30
    np.testing.assert_array_equal(affinity_filter(image, guide)[:, :, :5], found[:, :, :5])


def test_a_constant_stays_and_shapes_are_checked(rng):
    _, features, slanted, confidence = (np.float32(each) for each in drawn(rng))
    flat = np.full((3, 9, 11), 0.7, np.float32)
    np.testing.assert_allclose(affinity_filter(flat, Guide(features, slanted, confidence), step=2), flat, rtol=1e-6)
    with pytest.raises(ValueError, match=r"slanted \[3, H, W\].* got \(3, 9, 11\), \(2, 9, 11\)"):
        affinity_filter(flat, Guide(features, slanted[:2], confidence))
    for wrong in (features.shape[0], 2):
        with pytest.raises(ValueError, match=rf"guide.scales: expected {len(features) + 1} factors.* got shape"):
            affinity_filter(flat, Guide(features, slanted, confidence, np.ones(wrong, np.float32)))


def test_a_guide_may_be_the_slanted_one_alone(rng):
    """Its gradient too, by every implementation that runs here."""
    image, features, slanted, confidence = (np.float32(each) for each in drawn(rng))

    def total(slanted, implementation):
        guide = Guide(jnp.asarray(features[:0]), slanted, confidence)
        return jnp.sum(affinity_filter(image, guide, implementation=implementation) ** 2)

    found, wanted = (jax.grad(total)(slanted, one) for one in ("numba", "reference"))
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-5)


def test_batches_are_single_images(rng):
    first, second = (tuple(np.float32(each) for each in drawn(rng)) for _ in range(2))
    both = jax.vmap(lambda image, *guide: affinity_filter(image, Guide(*guide)))(
        *map(np.stack, zip(first, second, strict=True))
    )
    for one, (image, *guide) in zip(both, (first, second), strict=True):
        np.testing.assert_allclose(one, affinity_filter(image, Guide(*guide)), rtol=1e-5, atol=1e-6)
