"""Microfacet distributions from backscattering: against analytic lobes, an eigensolver and quadrature in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erfc

from jaxdn.materials import microfacets
from tests.gradients import check_gradients

CELLS = 128

# A program each; operation by operation there would be a hundred for every size.
extract_distribution = jax.jit(microfacets.extract_distribution, static_argnames="shadowing")
fit_alpha = jax.jit(microfacets.fit_alpha, static_argnames="lobe")
masking_of = jax.jit(microfacets.masking)
extract_fresnel = jax.jit(microfacets.extract_fresnel, static_argnames="shadowing")
distribution = jax.jit(microfacets.distribution, static_argnames="lobe")


def slope_density(lobe, alpha, tangent):
    """Of slopes, for each unit of slope area."""
    if lobe == "ggx":
        return alpha**2 / (np.pi * (alpha**2 + tangent**2) ** 2)
    return np.exp(-((tangent / alpha) ** 2)) / (np.pi * alpha**2)


def smith(lobe, alpha, tangent):
    """Exact masking G1, not a fit."""
    if lobe == "ggx":
        return 2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2))
    a = 1 / (alpha * tangent)
    return 1 / (1 + 0.5 * (np.exp(-(a**2)) / (a * np.sqrt(np.pi)) - erfc(a)))


def backscatter(lobe, alpha, *, separable=False, cells=CELLS, f0=0.8):
    """F0 D G / (4 cos^2) [N] of light that returns to where it came from."""
    theta = microfacets.angles(cells)
    tangent, cosine = np.tan(theta), np.cos(theta)
    masking = smith(lobe, alpha, tangent) ** (2 if separable else 1)
    return f0 * slope_density(lobe, alpha, tangent) / cosine**4 * masking / (4 * cosine**2)


def single(array):
    return jnp.asarray(array, jnp.float32)


@pytest.mark.parametrize(
    ("lobe", "alpha", "separable", "expected"),
    [
        ("ggx", 0.1, False, 0.1000),
        ("ggx", 0.3, False, 0.3005),
        ("ggx", 0.7, False, 0.705),
        ("beckmann", 0.1, False, 0.1000),
        ("beckmann", 0.3, False, 0.3000),
        ("beckmann", 0.6, False, 0.6000),
        # Of data whose masking and shadowing are independent, the operator of the paper finds too narrow a GGX.
        ("ggx", 0.1, True, 0.099),
        ("ggx", 0.3, True, 0.280),
        ("ggx", 0.7, True, 0.535),
    ],
)
def test_alpha_has_the_known_values(lobe, alpha, separable, expected):
    slopes = extract_distribution(single(backscatter(lobe, alpha, separable=separable)))
    found = float(fit_alpha(slopes, lobe=lobe).alpha)
    assert found == pytest.approx(expected, abs=6e-4 * (1 + expected))


@pytest.mark.parametrize("separable", [False, True])
@pytest.mark.parametrize(
    ("lobe", "alpha"), [("ggx", 0.1), ("ggx", 0.3), ("ggx", 0.7), ("beckmann", 0.2), ("beckmann", 0.6)]
)
def test_the_whole_density_comes_back_from_its_own_kind_of_masking(lobe, alpha, separable):
    data = single(backscatter(lobe, alpha, separable=separable))
    slopes = extract_distribution(data, shadowing="separable" if separable else "correlated")
    expected = slope_density(lobe, alpha, np.tan(microfacets.angles()))
    np.testing.assert_allclose(slopes, expected, rtol=0.02, atol=1e-4 * expected.max())
    fit = fit_alpha(slopes, lobe=lobe)
    assert float(fit.alpha) == pytest.approx(alpha, rel=0.01)
    assert float(fit.error) < 0.02


def test_the_lobe_with_the_smaller_error_is_the_right_one():
    for right, wrong in (("ggx", "beckmann"), ("beckmann", "ggx")):
        slopes = extract_distribution(single(backscatter(right, 0.3)))
        errors = {lobe: float(fit_alpha(slopes, lobe=lobe).error) for lobe in (right, wrong)}
        assert errors[right] < 0.1 * errors[wrong]
    # A GGX lobe has no second moment: the sum over the cells grows with their number.
    slopes = extract_distribution(single(backscatter("ggx", 0.3)))
    assert float(fit_alpha(slopes, lobe="beckmann").alpha) == pytest.approx(1.08, abs=0.02)


def quadrature(tangents, others, count=20_000):
    """Integral of max(0, 1 + k cos phi) over phi by the midpoint rule."""
    phi = (np.arange(count) + 0.5) / count * 2 * np.pi
    return np.array([[np.mean(np.maximum(0, 1 + a * b * np.cos(phi))) * 2 * np.pi for b in others] for a in tangents])


def test_the_density_is_the_leading_eigenvector():
    """Of an eigensolver, with the inner integral by quadrature; data that are no analytic lobe."""
    cells = 24
    theta = 0.5 * np.pi * ((np.arange(cells) + 0.5) / cells) ** 2
    width = 0.5 * np.pi * (((np.arange(cells) + 1) / cells) ** 2 - (np.arange(cells) / cells) ** 2)
    tangent, area = np.tan(theta), np.tan(theta) / np.cos(theta) ** 2 * width
    data = np.exp(-3 * theta) * (1.2 + np.sin(5 * theta))
    matrix = (data * np.cos(theta) ** 6)[:, None] * quadrature(tangent, tangent) * area
    values, vectors = np.linalg.eig(matrix)
    leading = np.abs(vectors[:, np.argmax(values.real)].real)
    leading /= 2 * np.pi * np.sum(leading * area)
    found = extract_distribution(single(data))
    np.testing.assert_allclose(found, leading, rtol=0.02, atol=1e-3 * leading.max())


@pytest.mark.parametrize(("lobe", "alpha"), [("ggx", 0.2), ("ggx", 0.6), ("beckmann", 0.5)])
def test_masking_of_a_density_is_smiths(lobe, alpha):
    slopes = slope_density(lobe, alpha, np.tan(microfacets.angles(512)))
    angle = np.array([0.0, 0.3, 0.8, 1.2, 1.5])
    expected = smith(lobe, alpha, np.tan(np.maximum(angle, 1e-9)))
    np.testing.assert_allclose(masking_of(single(slopes), single(angle)), expected, atol=0.004)
    grazing = masking_of(single(slopes), single([np.pi / 2, 1.6]))
    assert np.all(np.asarray(grazing) < 1e-4)
    assert np.all(np.asarray(grazing) > 0)


def test_masking_of_any_density_is_the_integral():
    rng = np.random.default_rng(1)
    cells = 32
    theta, slopes = microfacets.angles(cells), rng.uniform(0, 1, cells)
    width = 0.5 * np.pi * np.diff((np.arange(cells + 1) / cells) ** 2)
    area = np.tan(theta) / np.cos(theta) ** 2 * width
    slopes /= 2 * np.pi * np.sum(slopes * area)
    angle = np.array([0.2, 0.9, 1.4])
    expected = 1 / (quadrature(np.tan(angle), np.tan(theta)) @ (slopes * area))
    np.testing.assert_allclose(masking_of(single(slopes), single(angle)), expected, rtol=1e-4)


def test_scale_and_invalid_values_of_the_data(rng):
    data = backscatter("ggx", 0.3)
    usual = extract_distribution(single(data))
    for scale in (1e-30, 1e30):
        np.testing.assert_allclose(extract_distribution(single(scale * data)), usual, rtol=1e-4)
    broken, zeroed = data.copy(), data.copy()
    broken[[3, 40, 90, 127]], zeroed[[3, 40, 90, 127]] = (-1.0, np.nan, np.inf, -np.inf), 0.0
    found = extract_distribution(single(broken))
    np.testing.assert_array_equal(found, extract_distribution(single(zeroed)))
    assert np.all(np.asarray(found)[[3, 40, 90, 127]] == 0)
    assert np.isfinite(found).all()


def test_black_and_diffuse_surfaces():
    black = extract_distribution(jnp.zeros(CELLS))
    np.testing.assert_array_equal(black, 0)
    assert float(fit_alpha(black, lobe="ggx").alpha) == 0
    assert np.isfinite(fit_alpha(black, lobe="beckmann")).all()
    np.testing.assert_array_equal(masking_of(black, jnp.linspace(0, 1.5, 4)), 1)
    diffuse = extract_distribution(jnp.full(CELLS, 0.5 / np.pi))
    assert float(fit_alpha(diffuse, lobe="ggx").alpha) > 0.5, "of cos^6 alone it would be 0.5"


def test_angles_are_dense_at_the_normal_and_never_at_the_horizon():
    theta = microfacets.angles(90)
    assert theta.shape == (90,)
    assert 0 < theta[0] < 1e-4
    assert theta[-1] < np.pi / 2
    assert np.all(np.diff(theta, 2) > 0)


def schlick(angle, f0):
    return f0 + (1 - f0) * (1 - np.cos(angle)[:, None]) ** 5


def torrance_sparrow(lobe, alpha, difference, f0, *, separable):
    """[M, N, C] with phi_d = pi / 2, from vectors."""
    theta = microfacets.angles()
    half = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)
    sideways = np.array([0.0, 1.0, 0.0])
    light = half * np.cos(difference)[:, None, None] + sideways * np.sin(difference)[:, None, None]
    view = half * np.cos(difference)[:, None, None] - sideways * np.sin(difference)[:, None, None]

    def masking(direction):
        cosine = direction[..., 2]
        return smith(lobe, alpha, np.maximum(np.sqrt(1 - np.minimum(cosine, 1) ** 2) / cosine, 1e-9))

    before, after = masking(light), masking(view)
    both = before * after if separable else 1 / (1 / before + 1 / after - 1)
    d = slope_density(lobe, alpha, np.tan(theta)) / np.cos(theta) ** 4
    return schlick(difference, f0)[:, None] * (d * both / (4 * light[..., 2] * view[..., 2]))[..., None]


@pytest.mark.parametrize("separable", [False, True])
@pytest.mark.parametrize(("lobe", "alpha"), [("ggx", 0.3), ("beckmann", 0.2)])
def test_the_fresnel_term_comes_back(lobe, alpha, separable):
    difference, f0 = np.linspace(0, 1.4, 15), np.array([0.04, 0.5, 0.95])
    shadowing = "separable" if separable else "correlated"
    slopes = extract_distribution(single(backscatter(lobe, alpha, separable=separable)), shadowing=shadowing)
    brdf = torrance_sparrow(lobe, alpha, difference, f0, separable=separable)
    found = extract_fresnel(single(brdf), single(difference), slopes, shadowing=shadowing)
    assert found.shape == (15, 3)
    np.testing.assert_allclose(found, schlick(difference, f0), rtol=0.015)


def test_the_fresnel_term_is_a_share_of_light_whatever_the_data(rng):
    slopes = extract_distribution(single(backscatter("beckmann", 0.1)))
    difference = single([0.0, 0.5, np.pi / 2])
    data = rng.exponential(1.0, (3, CELLS, 2)) * 10 ** rng.uniform(-30, 30, (3, CELLS, 2))
    data[:, ::5], data[:, 1::7], data[:, 2::11] = np.nan, -1.0, np.inf
    found = np.asarray(extract_fresnel(single(data), difference, slopes))
    assert np.isfinite(found).all()
    assert found.min() >= 0
    assert found.max() <= 1
    nothing = extract_fresnel(single(data), difference, jnp.zeros(CELLS))
    np.testing.assert_array_equal(nothing, 0)
    # Where D is all but 0, data divided by it would be huge: they do not count.
    tail = np.where((np.asarray(slopes) < 1e-6)[None, :, None], 1.0, 0.0) * np.ones((3, 1, 2))
    np.testing.assert_array_equal(extract_fresnel(single(tail)[:2], difference[:2], slopes), 0)


@pytest.mark.parametrize("lobe", microfacets.LOBES)
def test_distribution_is_the_formula_and_normalised(lobe):
    count, alpha = 2000, 0.5**2
    theta = (np.arange(count) + 0.5) / count * np.pi / 2
    half = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)[None] * np.linspace(0.1, 9, count)[:, None]
    found = distribution(single(half), jnp.full((1, count, 1), 0.5), lobe=lobe)[0, :, 0]
    expected = slope_density(lobe, alpha, np.tan(theta)) / np.cos(theta) ** 4
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-12)
    weight = np.cos(theta) * np.sin(theta) * 2 * np.pi * np.pi / 2 / count
    assert np.sum(np.asarray(found) * weight) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("lobe", microfacets.LOBES)
def test_distribution_is_finite_with_finite_slopes_everywhere(lobe):
    half = single([[[0, 0, 1], [0, 0, 0], [1, 0, 0], [1, 0, 1e-20], [0, 1, -1], [0, 1e-5, 1]]])
    slopes_of = jax.jit(jax.grad(lambda half, roughness: jnp.sum(distribution(half, roughness, lobe=lobe)), (0, 1)))
    for roughness in (-1.0, 0.0, 0.01, 1.0, 5.0):
        found = distribution(half, jnp.full((1, 6, 1), roughness), lobe=lobe)
        assert np.isfinite(found).all()
        np.testing.assert_array_equal(np.asarray(found)[0, [1, 4]], 0)
        slopes = slopes_of(half, jnp.full((1, 6, 1), roughness))
        assert all(np.isfinite(one).all() for one in slopes)


@pytest.mark.slow
def test_gradients(x64, rng):
    data = backscatter("ggx", 0.4, cells=16) * rng.uniform(0.8, 1.2, 16)
    for shadowing in microfacets.SHADOWINGS:
        for lobe in microfacets.LOBES:

            def alpha(data, shadowing=shadowing, lobe=lobe):
                return fit_alpha(extract_distribution(data, shadowing=shadowing), lobe=lobe)

            check_gradients(alpha, [data], atol=1e-5, rtol=1e-4)
    difference = np.array([0.1, 0.7, 1.2])
    brdf = rng.uniform(0.0, 0.1, (3, 16, 2))

    def fresnel(brdf, data):
        return extract_fresnel(brdf, jnp.asarray(difference), extract_distribution(data))

    check_gradients(fresnel, [brdf, data], atol=1e-5, rtol=1e-4)
    half, roughness = rng.normal(0, 0.3, (2, 3, 3)) + [0, 0, 1], rng.uniform(0.2, 0.9, (2, 3, 1))
    for lobe in microfacets.LOBES:

        def d(half, roughness, lobe=lobe):
            return distribution(half, roughness, lobe=lobe)

        check_gradients(d, [half, roughness], atol=1e-5, rtol=1e-4)


def test_wrong_shapes_and_options_raise():
    curve, image = jnp.ones(8), jnp.ones((2, 8, 3))
    with pytest.raises(ValueError, match=r"backscatter.*jax.vmap"):
        extract_distribution(image)
    with pytest.raises(ValueError, match="backscatter"):
        extract_distribution(jnp.ones(8, jnp.int32))
    with pytest.raises(ValueError, match="shadowing"):
        extract_distribution(curve, shadowing="none")
    with pytest.raises(ValueError, match="slopes"):
        masking_of(image, curve)
    with pytest.raises(ValueError, match="lobe"):
        fit_alpha(curve, lobe="phong")
    with pytest.raises(ValueError, match=r"3 difference angles and 8 half angles.*\(2, 8, 3\)"):
        extract_fresnel(image, jnp.ones(3), curve)
    with pytest.raises(ValueError, match="roughness"):
        distribution(image, image)
