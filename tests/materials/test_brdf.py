"""Directional albedo against brute-force integration of the BRDF, and demodulation by the reflectance."""

import hypothesis
import hypothesis.extra.numpy as arrays
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies

from jaxdn import brdf
from tests.gradients import check_gradients

directional_albedo = jax.jit(brdf.directional_albedo, static_argnames="lobe")
divisor, restore = jax.jit(brdf.divisor), jax.jit(brdf.restore)
demodulate, remodulate = jax.jit(brdf.demodulate), jax.jit(brdf.remodulate)

CHECK = [  # cosine, roughness, (A, B) separable, (A, B) height-correlated
    (0.3, 0.3, (0.8095, 0.1358), (0.8099, 0.1359)),
    (0.6, 0.6, (0.775, 0.008), (0.778, 0.008)),
    (0.1, 0.1, (0.416, 0.578), (0.416, 0.578)),
    (0.95, 0.9, (0.426, 0.000), (0.427, 0.000)),
    (0.1, 0.9, (0.618, 0.021), (0.767, 0.032)),
    (0.5, 0.5, (0.833, 0.022), (0.835, 0.022)),
]


def looked_up(lobe, cosine, roughness):
    """A and B from the stored table, through the public function."""
    one = np.ones((1, 1, 1))

    def of(specular):
        zero = np.zeros((1, 1, 3))
        found = directional_albedo(zero, zero + specular, roughness * one, cosine * one, lobe=lobe)
        return float(np.asarray(found)[0, 0, 0])

    return of(1.0) - of(0.0), of(0.0)


@pytest.mark.parametrize(("cosine", "roughness", "separable", "correlated"), CHECK)
def test_the_table_has_the_known_values(cosine, roughness, separable, correlated):
    np.testing.assert_allclose(looked_up("ggx", cosine, roughness), separable, atol=0.004)
    np.testing.assert_allclose(looked_up("ggx-correlated", cosine, roughness), correlated, atol=0.004)


def integrated(lobe, cosine, roughness, schlick):
    """Integral of D G F / (4 n.l n.v) n.l over light directions by the midpoint rule, written from the equations."""
    alpha = roughness**2
    count = 600
    mu = (np.arange(count) + 0.5) / count
    phi = (np.arange(count) + 0.5) / count * 2 * np.pi
    mu, phi = np.meshgrid(mu, phi, indexing="ij")
    light = np.stack([np.sqrt(1 - mu**2) * np.cos(phi), np.sqrt(1 - mu**2) * np.sin(phi), mu], -1)
    view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    nh, vh = half[..., 2], half @ view
    if lobe == "beckmann":
        distribution = np.exp((nh**2 - 1) / (nh**2 * alpha**2)) / (np.pi * alpha**2 * nh**4)
    else:
        distribution = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)

    def masking(c):
        if lobe == "beckmann":
            a = c / (alpha * np.sqrt(1 - c**2))
            fit = (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2)
            return np.where(a < 1.6, fit, 1.0)
        return 2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2))

    shadowing = masking(mu) * masking(np.full_like(mu, cosine))
    if lobe == "ggx-correlated":
        shadowing = 1 / (1 / masking(mu) + 1 / masking(np.full_like(mu, cosine)) - 1)
    term = (1 - vh) ** 5 if schlick else 1 - (1 - vh) ** 5
    return np.sum(distribution * shadowing * term / (4 * cosine)) * 2 * np.pi / count**2


@pytest.mark.parametrize("lobe", brdf.LOBES)
@pytest.mark.parametrize(("cosine", "roughness"), [(0.3, 0.5), (0.8, 0.7), (0.55, 0.95), (0.9, 0.4)])
def test_the_table_is_the_integral_of_the_brdf(lobe, cosine, roughness):
    expected = [integrated(lobe, cosine, roughness, schlick) for schlick in (False, True)]
    np.testing.assert_allclose(looked_up(lobe, cosine, roughness), expected, atol=0.003)


@pytest.mark.parametrize("lobe", brdf.LOBES)
def test_the_table_adds_no_energy(lobe):
    table = brdf.albedo_table(lobe)
    assert table.shape == (brdf.SIZE, brdf.SIZE, 2)
    assert table.dtype == np.float32
    assert np.all(table >= 0)
    assert np.all(table.sum(-1) <= 1 + 1e-6)
    np.testing.assert_allclose(table[8:, 0].sum(-1), 1, atol=2e-3)  # a mirror reflects everything


@pytest.mark.slow
def test_the_stored_tables_are_what_the_function_makes():
    for lobe in brdf.LOBES:
        small = brdf.ggx_albedo_table(lobe=lobe, size=8, samples=brdf.SAMPLES)
        centres = (np.arange(8) + 0.5) / 8
        found = np.array([[looked_up(lobe, c, r) for r in centres] for c in centres])
        np.testing.assert_allclose(found, small, atol=0.003)
        again = brdf.ggx_albedo_table(lobe=lobe, size=8, samples=brdf.SAMPLES)
        np.testing.assert_array_equal(small, again)


def test_gradients_of_the_directional_albedo(x64, rng):
    arguments = [rng.uniform(0.05, 0.9, (3, 4, c)) for c in (3, 3, 1, 1)]
    check_gradients(brdf.directional_albedo, arguments, eps=1e-7, atol=1e-4, rtol=1e-4)


def test_out_of_range_is_clamped_and_finite():
    one = np.ones((1, 1, 1))
    color = np.full((1, 1, 3), 0.5)
    for roughness in (-1.0, 0.0, 2.0):
        for cosine in (-1.0, 0.0, 1e-9, 1.0, 5.0):
            found = np.asarray(directional_albedo(color, color, roughness * one, cosine * one))
            assert np.isfinite(found).all()
            assert (found >= 0.5).all()
            assert (found <= 1.5).all()
            beyond = directional_albedo(color, 6 * color, roughness * one, cosine * one)
            np.testing.assert_array_equal(beyond, directional_albedo(color, 2 * color, roughness * one, cosine * one))


@hypothesis.given(
    arrays.arrays(np.float32, (2, 3, 3), elements=strategies.floats(0, 6e4, width=32)),
    arrays.arrays(np.float32, (2, 3, 3), elements=strategies.floats(0, 1, width=32)),
)
def test_dividing_and_multiplying_again_changes_nothing(radiance, reflectance):
    light = demodulate(radiance, reflectance)
    assert np.isfinite(light).all()
    np.testing.assert_allclose(remodulate(light, reflectance), radiance, rtol=1e-6, atol=1e-30)


@hypothesis.given(strategies.floats(0, 1), strategies.floats(1e-6, 1e-3))
def test_similar_neighbours_have_similar_divisors(reflectance, difference):
    first, second = np.asarray(divisor(np.array([reflectance, reflectance + difference])))
    assert abs(second / first - 1) <= difference / brdf.FLOOR * 1.01 + 1e-6


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.05, 0.15, 0.3, 1.0, 1e20])
def test_the_divisor_is_the_reflectance_where_that_is_not_small(value):
    expected = ((np.float64(value) ** 4 + 0.15**4) / (1 + 0.15**4)) ** 0.25
    np.testing.assert_allclose(divisor(np.float32(value)), expected, rtol=1e-6)
    assert value < 0.3 or expected / value < 1.02


def test_slopes_are_finite_at_zero_reflectance():
    slope = jax.jit(jax.grad(lambda reflectance: brdf.demodulate(jnp.ones((1, 1, 3)), reflectance).sum()))
    assert np.isfinite(slope(np.zeros((1, 1, 3)))).all()


def test_a_floor_that_divides_by_zero_is_refused():
    ones, black = np.ones((2, 3, 3), np.float32), np.zeros((2, 3, 3), np.float32)
    for wrong in (0, 0.0, -0.1, float("nan")):
        for function in (brdf.demodulate, brdf.remodulate):
            with pytest.raises(ValueError, match=r"floor: expected more than 0, got"):
                function(ones, black, floor=wrong)
    assert np.isfinite(demodulate(ones, black, floor=jnp.float32(0.04))).all()


def test_wrong_shapes_raise():
    color, one = jnp.ones((2, 2, 3)), jnp.ones((2, 2, 1))
    with pytest.raises(ValueError, match="specular"):
        brdf.directional_albedo(color, one, one, one)
    with pytest.raises(ValueError, match="same size"):
        brdf.directional_albedo(color, color, one[:1], one)
    with pytest.raises(ValueError, match="lobe"):
        brdf.directional_albedo(color, color, one, one, lobe="phong")
    with pytest.raises(ValueError, match="same size"):
        brdf.demodulate(color, color[:1])


def test_what_a_division_leaves():
    reflectance = np.float32([0.0, 0.002, 0.05, 0.15, 0.4, 1.0])
    expected = ((reflectance.astype(np.float64) ** 4 + 0.15**4) / (1 + 0.15**4)) ** 0.25
    left = jax.jit(brdf.texture_left)(reflectance, divisor(reflectance))
    np.testing.assert_allclose(left, np.minimum(reflectance / expected, 1.0), rtol=1e-6)


def test_the_hue_of_what_is_left():
    texture = np.float32([[1.0, 0.0, 0.5], [0.02, 0.02, 0.02], [0.0, 0.0, 0.0], [0.01, 0.02, 0.0]])
    hue = np.asarray(jax.jit(brdf.hue_left)(texture))
    np.testing.assert_allclose(hue, (texture + 0.3) / (texture.max(-1, keepdims=True) + 0.3), rtol=1e-6)
    np.testing.assert_array_equal(hue[2], 1.0)


def test_a_blurred_texture_is_restored(rng):
    """Light times texture, averaged with any weights: the ratio of the means gives the light again."""
    texture, weights = rng.uniform(0.2, 1.0, (1, 8, 3)), rng.random((1, 8, 1))
    mean, mean_texture = ((weights * one).sum(1, keepdims=True) / weights.sum() for one in (3.0 * texture, texture))
    restored = restore(mean, texture, mean_texture)
    np.testing.assert_allclose(restored, mean * (texture + 0.01) / (mean_texture + 0.01), rtol=1e-6)
    np.testing.assert_allclose(restored, 3.0 * texture, rtol=0.1)
    even = np.full((1, 8, 3), 0.013)
    np.testing.assert_allclose(restore(3.0 * even, even, even), 3.0 * even, rtol=1e-6)


def test_restored_light_is_bounded_where_no_reflectance_explains_it():
    restored = restore(np.full((1, 1, 3), 7.0), np.ones((1, 1, 3)), np.zeros((1, 1, 3)))
    np.testing.assert_allclose(restored, 7.0 * 101.0, rtol=1e-5)


def test_gradients_of_restored_light(x64, rng):
    check_gradients(brdf.restore, tuple(rng.uniform(0.1, 1.0, (2, 3, 3)) for _ in range(3)))
    check_gradients(brdf.hue_left, (rng.uniform(0.1, 1.0, (2, 3, 3)),))
