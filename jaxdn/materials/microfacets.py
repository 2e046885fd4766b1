"""Microfacet distribution and Fresnel term of any isotropic BRDF, by power iteration.

The backscattering of a surface determines its distribution of microfacet slopes, as the eigenvector of a linear
operator (Dupuy et al. 2015, "Extracting Microfacet-based BRDF Parameters from Arbitrary Materials with Power
Iterations"). The slope density p(theta) is the number of facets of an isotropic surface for each unit of slope area:
``D(h) = p(theta) / cos^4(theta)`` and ``2 pi integral of p tan / cos^2 dtheta = 1``. Masking and the Fresnel term
follow from it. All angles are in radians.

Densities are arrays [N], one value for each cell of :func:`angles`. Functions raise ValueError for wrong shapes and
options; BRDF values that are negative or not finite count as 0.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.core.numerics import absolute, safe_norm, safe_power

Lobe = Literal["ggx", "beckmann"]
LOBES: tuple[Lobe, ...] = ("ggx", "beckmann")
Shadowing = Literal["correlated", "separable"]
SHADOWINGS: tuple[Shadowing, ...] = ("correlated", "separable")
"""How masking and shadowing combine: ``1 / (1 / G1(v) + 1 / G1(l) - 1)`` and, as in Mitsuba, ``G1(v) G1(l)``.

At backscatter both directions are masked by the same facets, and the correlated form is G1 itself.
"""

CELLS = 128
SMALLEST_ROUGHNESS = 0.01
"""Smaller roughness counts as this: alpha = 1e-4, as in Mitsuba."""
STEPS: dict[Shadowing, int] = {"correlated": 4, "separable": 16}
"""Steps of the iteration. The square of G1 converges more slowly than G1."""
SMALLEST_DENOMINATOR = 1e-4
"""A BRDF value is not divided by less than this."""


def angles(cells: int = CELLS) -> np.ndarray:
    """Centres [N] of the cells in theta: ``(pi / 2) u^2`` for u = (i + 0.5) / N; dense at 0, and never pi / 2."""
    return 0.5 * np.pi * ((np.arange(cells) + 0.5) / cells) ** 2


def _slope_area(cells: int) -> np.ndarray:
    """``tan / cos^2 dtheta`` [N] of the cells: the slope area of a ring, divided by 2 pi."""
    theta = angles(cells)
    width = np.pi * (np.arange(cells) + 0.5) / cells**2
    return np.tan(theta) / np.cos(theta) ** 2 * width


def distribution(half: jax.Array, roughness: jax.Array, *, lobe: Lobe = "ggx") -> jax.Array:
    """D(h) [H, W, 1] in 1/sr, normalised so that ``integral of D(h) h_z dh = 1``; 0 where h_z <= 0.

    GGX is ``alpha^2 / (pi (alpha^2 cos^2 + sin^2)^2)``, Beckmann ``exp(-tan^2 / alpha^2) / (pi alpha^2 cos^4)`` (Walter
    et al. 2007, eq. 33 and 25), with ``alpha = roughness^2``.

    Args:
      half: [H, W, 3] half vectors in the frame of the surface, whose normal is z; of any length.
      roughness: [H, W, 1] linear roughness in [0, 1].
      lobe: "ggx" or "beckmann".
    """
    check_image(half, "half", channels=3)
    check_image(roughness, "roughness", channels=1)
    check_same_size(half, roughness, ("half", "roughness"))
    check_option(lobe, "lobe", LOBES)
    cosine, sine = cosine_and_sine(half)
    return _density(cosine, sine, alpha_of(roughness), lobe)


def alpha_of(roughness: jax.Array) -> jax.Array:
    """``roughness^2``, at least that of the sharpest lobe, in single precision or better."""
    exact = roughness.astype(jnp.promote_types(roughness.dtype, jnp.float32))
    return jnp.clip(exact, SMALLEST_ROUGHNESS, 1.0) ** 2


def cosine_and_sine(half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of the angle between half vectors [..., 3] of any length and z: each [..., 1]. A zero vector has cosine 0."""
    half = half.astype(jnp.promote_types(half.dtype, jnp.float32))
    half = half / _size(half)  # the square of a length, in the derivative, would underflow
    length = safe_norm(half)
    unit = half / jnp.where(length == 0, 1.0, length)
    return unit[..., 2:], safe_norm(unit[..., :2])


def _size(values: jax.Array) -> jax.Array:
    """The largest magnitude over the last axis, as a constant to divide by; 1 where all are 0.

    At most an eighth of the largest number: XLA may multiply by its reciprocal, which must not be subnormal.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(values), axis=-1, keepdims=True))
    limits = jnp.finfo(values.dtype)
    return jnp.where(largest < limits.tiny, 1.0, jnp.minimum(largest, float(limits.max) / 8))


def _density(cosine: jax.Array, sine: jax.Array, alpha: jax.Array, lobe: Lobe) -> jax.Array:
    """:func:`distribution` of cosines and sines, without checks."""
    above = cosine > 0
    # Below this cosine Beckmann's exponential is 0 for every alpha up to 1.
    c2, s2 = jnp.where(above, jnp.maximum(cosine, 1e-3), 1.0) ** 2, sine**2
    if lobe == "ggx":
        found = alpha**2 / (jnp.pi * (alpha**2 * c2 + s2) ** 2)
    else:
        # Two divisions: the square of one divisor, in the derivative, would underflow.
        found = jnp.exp(-s2 / (c2 * alpha**2)) / (jnp.pi * alpha**2) / c2**2
    return jnp.where(above, found, 0.0)


def _projected_area(product: jax.Array) -> jax.Array:
    """``integral over phi of max(0, 1 + k cos phi)`` for ``k = tan(theta_o) tan(theta_h)``: 2 pi up to k = 1.

    Beyond, it is ``2 (phi_0 + sqrt(k^2 - 1))`` with ``phi_0 = arccos(-1 / k) = pi - arctan sqrt(k^2 - 1)``.
    """
    root = safe_power(jnp.maximum(product**2 - 1, 0.0), 0.5)
    return 2 * (jnp.pi + root - jnp.arctan(root))


def _operator(cells: int, dtype: jnp.dtype) -> jax.Array:
    """[N, N] from a slope density to 1 / G1 of every cell's angle."""
    tangent = np.tan(angles(cells))
    area = _projected_area(jnp.asarray(tangent[:, None] * tangent, dtype))
    return area * jnp.asarray(_slope_area(cells), dtype)[None]


def _normalised(slopes: jax.Array) -> jax.Array:
    """With an integral of 1; all zeros stay zeros."""
    total = 2 * jnp.pi * jnp.sum(slopes * jnp.asarray(_slope_area(slopes.shape[0]), slopes.dtype))
    return slopes / jnp.where(total == 0, 1.0, total)


def _measured(brdf: jax.Array) -> jax.Array:
    exact = brdf.astype(jnp.promote_types(brdf.dtype, jnp.float32))
    return jnp.where((exact > 0) & jnp.isfinite(exact), exact, 0.0)


def extract_distribution(backscatter: jax.Array, *, shadowing: Shadowing = "correlated") -> jax.Array:
    """The slope density p [N] of a surface from its backscattering f_r(w, w) [N], at the angles of :func:`angles`.

    The fixed point of ``p(o) ~ f_r(o, o) cos^6(o) (K p)(o)``, normalised in every step, where ``K p`` is 1 / G1:
    ``(K p)(o) = integral of p(h) tan(h) / cos^2(h) [integral of max(0, 1 + tan(o) tan(h) cos phi) dphi] dh`` (Dupuy et
    al. 2015). The Fresnel term at normal incidence, or any other factor, cancels. ``shadowing="separable"``
    takes the square of ``K p``, for a BRDF that masks and shadows independently even at backscatter, like Mitsuba's:
    the paper's operator would find GGX lobes too narrow (alpha 0.28 for 0.3).

    Pure microfacet reflection is assumed: a diffuse part appears as a very broad density. All zeros for data that are
    all zero.

    Args:
      backscatter: [N] BRDF values in 1/sr without the cosine, of one channel or their mean; any scale.
      shadowing: of the BRDF.
    """
    _check_curve(backscatter, "backscatter")
    check_option(shadowing, "shadowing", SHADOWINGS)
    measured = _measured(backscatter)
    cells = measured.shape[0]
    # The result is the same for every scale.
    weight = measured / _size(measured) * jnp.asarray(np.cos(angles(cells)) ** 6, measured.dtype)
    operator = _operator(cells, measured.dtype)
    power = 1 if shadowing == "correlated" else 2
    slopes = _normalised(jnp.ones_like(measured))
    for _ in range(STEPS[shadowing]):
        slopes = _normalised(weight * (operator @ slopes) ** power)
    return slopes


def masking(slopes: jax.Array, angle: jax.Array) -> jax.Array:
    """Smith's masking G1 in (0, 1] for directions at ``angle`` [...] to the normal, of a slope density [N].

    ``1 / G1(o) = integral of p(h) max(0, 1 + tan(o) tan(h) cos phi) over all slopes`` (Dupuy et al. 2015).
    """
    _check_curve(slopes, "slopes")
    angle = jnp.asarray(angle, slopes.dtype)
    # At pi / 2 nothing is seen, and the tangent has no value.
    return _masking(slopes, jnp.sin(angle) / jnp.maximum(jnp.cos(angle), 1e-6))


def _masking(slopes: jax.Array, tangent: jax.Array) -> jax.Array:
    cells = slopes.shape[0]
    facets = jnp.asarray(np.tan(angles(cells)), slopes.dtype)
    inverse = _projected_area(jnp.tensordot(tangent, facets, axes=0)) @ (
        slopes * jnp.asarray(_slope_area(cells), slopes.dtype)
    )
    return 1 / jnp.maximum(inverse, 1.0)


class Fit(NamedTuple):
    """An analytic lobe in place of a slope density."""

    alpha: jax.Array
    """Scalar; the linear roughness is its square root."""
    error: jax.Array
    """Scalar: integral of |p - p_lobe| over all slopes, from 0 (the same) to 2 (apart)."""


def fit_alpha(slopes: jax.Array, *, lobe: Lobe) -> Fit:
    """The lobe with the moment of a slope density [N]: of GGX ``alpha = E|x|``, of Beckmann ``alpha^2 = 2 E[x^2]``.

    x is the slope along one axis: ``E|x| = 4 integral of p tan^2 / cos^2``, ``E[x^2] = pi integral of p tan^3 / cos^2``
    (Dupuy et al. 2015). GGX has no second moment, so its Beckmann fit is far too rough: take the lobe whose
    ``error`` is smaller.
    """
    _check_curve(slopes, "slopes")
    check_option(lobe, "lobe", LOBES)
    theta, area = angles(slopes.shape[0]), _slope_area(slopes.shape[0])
    tangent = np.tan(theta)
    if lobe == "ggx":
        alpha = 4 * jnp.sum(slopes * jnp.asarray(tangent * area, slopes.dtype))
    else:
        alpha = safe_power(2 * jnp.pi * jnp.sum(slopes * jnp.asarray(tangent**2 * area, slopes.dtype)), 0.5)
    return Fit(alpha, _difference(slopes, alpha, lobe))


def _difference(slopes: jax.Array, alpha: jax.Array, lobe: Lobe) -> jax.Array:
    theta, area = angles(slopes.shape[0]), _slope_area(slopes.shape[0])
    cosine, sine = (jnp.asarray(one, slopes.dtype) for one in (np.cos(theta), np.sin(theta)))
    model = _density(cosine, sine, jnp.maximum(alpha, SMALLEST_ROUGHNESS**2), lobe) * cosine**4
    return 2 * jnp.pi * jnp.sum(absolute(slopes - model) * jnp.asarray(area, slopes.dtype))


def extract_fresnel(
    brdf: jax.Array, difference: jax.Array, slopes: jax.Array, *, shadowing: Shadowing = "correlated"
) -> jax.Array:
    """The Fresnel term F [M, C] in [0, 1] of a BRDF, at the difference angles ``difference`` [M].

    The mean over the half angles of ``f_r / (D G / (4 n.l n.v))``, without those whose denominator is below 1e-4; 0
    where none is left. The two directions lie at the difference angle on both sides of the half vector, in the plane
    that is perpendicular to the one of half vector and normal (phi_d = pi / 2), so that
    ``n.l = n.v = cos(theta_h) cos(theta_d)`` (Dupuy et al. 2015).

    Args:
      brdf: [M, N, C] values in 1/sr without the cosine; half angles along N, as in :func:`angles`.
      difference: [M] angles between the directions and the half vector.
      slopes: [N] slope density, of :func:`extract_distribution`.
      shadowing: of the BRDF.
    """
    check_image(brdf, "brdf")
    _check_curve(difference, "difference")
    _check_curve(slopes, "slopes")
    check_option(shadowing, "shadowing", SHADOWINGS)
    if brdf.shape[:2] != (difference.shape[0], slopes.shape[0]):
        raise ValueError(
            f"brdf: expected {difference.shape[0]} difference angles and {slopes.shape[0]} half angles in its first "
            f"axes, got shape {brdf.shape}; evaluate it at `difference` and at `angles({slopes.shape[0]})`."
        )
    measured = _measured(brdf)
    half_cosine = jnp.asarray(np.cos(angles(slopes.shape[0])), slopes.dtype)
    cosine = jnp.maximum(jnp.cos(difference.astype(slopes.dtype))[:, None] * half_cosine[None], 1e-6)
    single = _masking(slopes, safe_power(1 - cosine**2, 0.5) / cosine)
    both = single / (2 - single) if shadowing == "correlated" else single**2
    full = (slopes / half_cosine**4)[None] * both / (4 * cosine**2)
    usable = full >= SMALLEST_DENOMINATOR
    ratio = jnp.where(usable[..., None], measured / jnp.where(usable, full, 1.0)[..., None], 0.0)
    count = jnp.sum(usable, axis=1)[:, None]
    return jnp.clip(jnp.sum(ratio, axis=1) / jnp.maximum(count, 1), 0.0, 1.0)


def _check_curve(values: jax.Array, name: str) -> None:
    if jnp.ndim(values) != 1 or not jnp.issubdtype(jnp.result_type(values), jnp.floating) or jnp.size(values) == 0:
        raise ValueError(
            f"{name}: expected a floating-point array with one axis, got {jnp.result_type(values)} of shape "
            f"{jnp.shape(values)}; batch with jax.vmap."
        )
