"""The microfacet parameters of the real renderer's materials, extracted from values of their BSDFs."""

from typing import Any

import numpy as np
import pytest

from jaxdn.materials import microfacets
from tests.needs import require_module

ETA, K = 0.2, 3.9


@pytest.fixture
def mitsuba() -> Any:
    """Mitsuba in its scalar variant; the variant that was active is put back."""
    mi = require_module("mitsuba")
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield mi
    if before is not None:
        mi.set_variant(before)


def metal(mi: Any, lobe: str, alpha: float) -> Any:
    return mi.load_dict({"type": "roughconductor", "distribution": lobe, "alpha": alpha, "eta": ETA, "k": K})


def value(mi: Any, bsdf: Any, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """f_r [3] without the cosine."""
    hit = mi.SurfaceInteraction3f()
    hit.n = mi.Normal3f(0, 0, 1)
    hit.sh_frame = mi.Frame3f([1, 0, 0], [0, 1, 0], [0, 0, 1])
    hit.wi = mi.Vector3f(*map(float, view))
    return np.array(bsdf.eval(mi.BSDFContext(), hit, mi.Vector3f(*map(float, light)))) / light[2]


def backscatter(mi: Any, bsdf: Any) -> np.ndarray:
    directions = [np.array([np.sin(theta), 0, np.cos(theta)]) for theta in microfacets.angles()]
    return np.array([value(mi, bsdf, one, one).mean() for one in directions], np.float32)


@pytest.mark.parametrize(
    ("lobe", "alpha", "tolerance"),
    [("beckmann", 0.1, 0.01), ("beckmann", 0.3, 0.01), ("ggx", 0.1, 0.01), ("ggx", 0.3, 0.01)],
)
def test_a_rough_conductor_gives_its_alpha_back(mitsuba: Any, lobe: Any, alpha: float, tolerance: float) -> None:
    data = backscatter(mitsuba, metal(mitsuba, lobe, alpha))
    slopes = microfacets.extract_distribution(data, shadowing="separable")
    fits = {one: microfacets.fit_alpha(slopes, lobe=one) for one in microfacets.LOBES}
    assert min(fits, key=lambda one: float(fits[one].error)) == lobe
    assert float(fits[lobe].alpha) == pytest.approx(alpha, rel=tolerance)


def test_the_operator_of_the_paper_finds_too_narrow_a_ggx(mitsuba: Any) -> None:
    """Mitsuba masks and shadows independently, also where light returns to where it came from."""
    for lobe, alpha, expected in (("ggx", 0.3, 0.280), ("beckmann", 0.3, 0.300)):
        slopes = microfacets.extract_distribution(backscatter(mitsuba, metal(mitsuba, lobe, alpha)))
        assert float(microfacets.fit_alpha(slopes, lobe=lobe).alpha) == pytest.approx(expected, abs=0.003)


def conductor(cosine: np.ndarray) -> np.ndarray:
    """Fresnel's equations for unpolarised light, with the complex index of refraction."""
    index = ETA + 1j * K
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    perpendicular = (cosine - index * inside) / (cosine + index * inside)
    parallel = (index * cosine - inside) / (index * cosine + inside)
    return 0.5 * (np.abs(perpendicular) ** 2 + np.abs(parallel) ** 2)


@pytest.mark.parametrize(("lobe", "alpha"), [("beckmann", 0.2), ("ggx", 0.3)])
def test_its_fresnel_term_is_that_of_the_metal(mitsuba: Any, lobe: Any, alpha: float) -> None:
    bsdf, difference = metal(mitsuba, lobe, alpha), np.linspace(0, 1.3, 9, dtype=np.float32)
    slopes = microfacets.extract_distribution(backscatter(mitsuba, bsdf), shadowing="separable")
    brdf = np.zeros((9, microfacets.CELLS, 3), np.float32)
    for row, apart in enumerate(difference):
        for column, theta in enumerate(microfacets.angles()):
            along = np.cos(apart) * np.array([np.sin(theta), 0, np.cos(theta)])
            across = np.array([0, np.sin(apart), 0])
            brdf[row, column] = value(mitsuba, bsdf, along + across, along - across)
    found = microfacets.extract_fresnel(brdf, difference, slopes, shadowing="separable")
    expected = np.repeat(conductor(np.cos(difference))[:, None], 3, axis=1)
    np.testing.assert_allclose(found, expected, atol=0.02)
