"""Directional albedo: BRDFs pre-integrated over the incident directions, and demodulation by it.

The directional albedo ``F_b = integral of f_r cos(theta_i) dw_i`` is the share of uniform incident light that a surface
reflects to the viewer, and the contribution of textures and materials to an image. Dividing by it leaves the incident
light, which is what a denoiser should filter (Zhuang et al. 2021, "Real-Time Denoising Using BRDF
Pre-Integration Factorization"). For a microfacet lobe with Schlick's Fresnel term ``F0 + (1 - F0) (1 - v.h)^5`` it is
``F0 A + B`` with two numbers that depend only on the cosine n.v and the roughness (Karis 2013).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float

    Image = Float[Array, "H W 3"]


Lobe = Literal["ggx", "ggx-correlated", "beckmann"]
"""GGX with Smith's separable shadowing (as in Mitsuba) or the height-correlated one, Beckmann (separable)."""

LOBES: tuple[Lobe, ...] = ("ggx", "ggx-correlated", "beckmann")
SIZE = 128
"""Entries of a stored table along each axis."""
SAMPLES = 4096
"""Half vectors averaged for a stored entry."""
SMALLEST_COSINE = 1 / 512
"""Smaller cosines are replaced by this: shading normals may face away from the viewer."""
FLOOR = 0.15
"""The divisor of a surface that reflects nothing; from twice this value on, the divisor is the reflectance itself.

0.04 gained 0.1 dB where the reflectance is known, and lost 0.6 to 2.1 dB where only the albedo is, which metal does not
have (filters on eight clips, 2026-11-23).
"""

_STORED = Path(__file__).parent / "materials" / "directional-albedo.npz"


def ggx_albedo_table(
    *, lobe: Lobe = "ggx", size: int = SIZE, samples: int = SAMPLES
) -> Float[np.ndarray, "size size 2"]:
    """The table [size, size, 2] of A and B, float32, over n.v (first axis) and linear roughness r (second).

    Entry (i, j) stands for ``n.v = (i + 0.5) / size`` and ``r = (j + 0.5) / size``, with alpha = r^2. Half vectors
    (visible normals; Heitz 2018) come from a Hammersley set of ``samples`` points: the same table on every machine, up
    to rounding. A, B >= 0 and A + B <= 1. A stored table of every lobe comes with the package (:func:`albedo_table`).
    """
    check_option(lobe, "lobe", LOBES)
    centres = (np.arange(size) + 0.5) / size
    points = _hammersley(samples)
    table = np.empty((size, size, 2))
    for column, roughness in enumerate(centres):
        table[:, column] = _integrate(lobe, centres, roughness**2, points)
    # The sampled mean of a full reflector may exceed 1 by its error (Beckmann: 7e-6).
    return (table / np.maximum(table.sum(-1, keepdims=True), 1.0)).astype(np.float32)


def _hammersley(count: int) -> np.ndarray:
    """[count, 2] low-discrepancy points in [0, 1)^2: centres of equal intervals, and radical inverses in base 2."""
    index = np.arange(count, dtype=np.uint64)
    inverse, scale = np.zeros(count), 0.5
    for _ in range(32):
        inverse += scale * (index & np.uint64(1))
        index, scale = index >> np.uint64(1), scale / 2
    return np.stack([(np.arange(count) + 0.5) / count, inverse], axis=-1)


def _integrate(lobe: Lobe, cosines: np.ndarray, alpha: float, points: np.ndarray) -> np.ndarray:
    """A and B [n, 2] for cosines [n] of the view direction, float64."""
    view = np.stack([np.sqrt(1 - cosines**2), np.zeros_like(cosines), cosines], axis=-1)[:, None]  # [n, 1, 3]
    if lobe == "beckmann":
        half, weight = _beckmann_normals(view, alpha, points)
    else:
        half, weight = _visible_normals(view, alpha, points), None
    aligned = np.sum(view * half, axis=-1)  # v.h
    light = 2 * aligned[..., None] * half - view
    above = (light[..., 2] > 0) & (aligned > 0)
    to_light = np.where(above, light[..., 2], 1.0)
    before, after = (_smith(lobe, cosine, alpha) for cosine in (view[..., 2], to_light))
    if weight is None:  # visible normals: the weight is G2 / G1(v)
        shadowing = (1 + before) / (1 + before + after) if lobe == "ggx-correlated" else 1 / (1 + after)
    else:
        shadowing = weight * aligned / ((1 + before) * (1 + after))
    shadowing = np.where(above, shadowing, 0.0)
    grazing = (1 - np.clip(aligned, 0, 1)) ** 5
    return np.stack([np.mean(shadowing * (1 - grazing), axis=-1), np.mean(shadowing * grazing, axis=-1)], axis=-1)


def _visible_normals(view: np.ndarray, alpha: float, points: np.ndarray) -> np.ndarray:
    """GGX half vectors [n, s, 3], sampled in proportion to their visible area (Heitz 2018)."""
    stretched = view * np.array([alpha, alpha, 1.0])
    stretched /= np.linalg.norm(stretched, axis=-1, keepdims=True)
    # An orthonormal basis about the stretched view direction, which has no y component.
    first = np.array([0.0, 1.0, 0.0])
    second = np.cross(stretched, first)
    radius, angle = np.sqrt(points[:, 0]), 2 * np.pi * points[:, 1]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    share = 0.5 * (1 + stretched[..., 2])
    y = (1 - share) * np.sqrt(1 - x**2) + share * y
    z = np.sqrt(np.maximum(0, 1 - x**2 - y**2))
    normal = x[..., None] * first + y[..., None] * second + z[..., None] * stretched
    half = normal * np.array([alpha, alpha, 1.0])
    half[..., 2] = np.maximum(half[..., 2], 1e-9)
    return half / np.linalg.norm(half, axis=-1, keepdims=True)


def _beckmann_normals(view: np.ndarray, alpha: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beckmann half vectors [1, s, 3] in proportion to D n.h, and the rest of the estimator, 1 / (n.h n.v) [n, s]."""
    slope = alpha**2 * -np.log1p(-points[:, 0])  # tan^2
    cosine = 1 / np.sqrt(1 + slope)
    sine, angle = np.sqrt(np.maximum(0, 1 - cosine**2)), 2 * np.pi * points[:, 1]
    half = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=-1)[None]
    return half, 1 / (cosine[None] * view[..., 2])


def _smith(lobe: Lobe, cosine: np.ndarray, alpha: float) -> np.ndarray:
    """Smith's Lambda: masking is 1 / (1 + Lambda). Beckmann's by the fit of Walter et al. 2007, as in Mitsuba."""
    tangent = np.sqrt(np.maximum(0, 1 - cosine**2)) / cosine
    if lobe != "beckmann":
        return 0.5 * (np.sqrt(1 + (alpha * tangent) ** 2) - 1)
    a = 1 / np.maximum(alpha * tangent, 1e-12)
    fit = np.where(a < 1.6, (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2), 1.0)
    return 1 / fit - 1


@functools.cache
def albedo_table(lobe: Lobe = "ggx") -> Float[np.ndarray, "128 128 2"]:
    """The stored table [128, 128, 2] of a lobe, made by :func:`ggx_albedo_table`."""
    check_option(lobe, "lobe", LOBES)
    with np.load(_STORED, allow_pickle=False) as stored:
        return stored[lobe]


def directional_albedo(
    albedo: Float[Array, "... 3"],
    specular: Float[Array, "... 3"],
    roughness: Float[Array, "... 1"],
    cosine: Float[Array, "... 1"],
    *,
    lobe: Lobe = "ggx",
) -> Float[Array, "... 3"]:
    """``albedo + specular A + B`` [H, W, 3]: reflectance of a diffuse surface with a microfacet lobe in uniform light.

    Differentiable in all four. F0, roughness and cosines are clamped to the range that they can have. Raises ValueError
    for inconsistent shapes.

    Args:
      albedo: [H, W, 3] reflectance of the diffuse part.
      specular: [H, W, 3] F0, the specular reflectance at normal incidence.
      roughness: [H, W, 1] linear roughness r in [0, 1], alpha = r^2.
      cosine: [H, W, 1] n.v, of the shading normal and the direction to the viewer.
      lobe: the microfacet model.
    """
    for name, image, channels in (("albedo", albedo, 3), ("specular", specular, 3)):
        check_image(image, name, channels=channels)
    for name, image in (("roughness", roughness), ("cosine", cosine)):
        check_image(image, name, channels=1)
        check_same_size(albedo, image, ("albedo", name))
    check_same_size(albedo, specular, ("albedo", "specular"))
    found = _look_up(jnp.asarray(albedo_table(lobe)), jnp.maximum(cosine, SMALLEST_COSINE), roughness)
    return albedo + jnp.clip(specular, 0.0, 1.0) * found[..., :1] + found[..., 1:]


def _look_up(table: jax.Array, cosine: jax.Array, roughness: jax.Array) -> jax.Array:
    """A and B [H, W, 2], bilinear between the centres of the entries, constant beyond the outermost."""
    size = table.shape[0]
    y, x = (jnp.clip(value[..., 0] * size - 0.5, 0.0, size - 1.0) for value in (cosine, roughness))
    top, left = (jnp.clip(jnp.floor(at), 0, size - 2).astype(jnp.int32) for at in (y, x))
    down, right = (y - top)[..., None], (x - left)[..., None]
    table = table.astype(y.dtype)
    upper = (1 - right) * table[top, left] + right * table[top, left + 1]
    lower = (1 - right) * table[top + 1, left] + right * table[top + 1, left + 1]
    return (1 - down) * upper + down * lower


def divisor(reflectance: Image, *, floor: float = FLOOR) -> Image:
    """The divisor ``((reflectance^4 + floor^4) / (1 + floor^4))^(1/4)``: the reflectance itself where it is not small.

    For white, the neutral value of the buffer, it is 1.

    It is smooth everywhere: neighbours of similar reflectance have similar divisors, however dark they are. With a
    threshold (1 below it), reflectances of 0.009 and 0.011 would differ by a factor of 90 after the division.

    Raises ValueError for a ``floor`` that is a Python number and not more than 0.
    """
    if isinstance(floor, int | float) and not floor > 0:
        raise ValueError(
            f"floor: expected more than 0, got {floor}; it is the divisor of surfaces that reflect nothing."
        )
    larger, smaller = jnp.maximum(reflectance, floor), jnp.minimum(reflectance, floor)
    # Two square roots: XLA:CPU does not vectorise powers.
    return larger * jnp.sqrt(jnp.sqrt(1 + (smaller / larger) ** 4)) / (1 + floor**4) ** 0.25


def demodulate(radiance: Image, reflectance: Image, *, floor: float = FLOOR) -> Image:
    """Radiance [H, W, 3] divided by the surface's reflectance; finite for any reflectance >= 0.

    Raises ValueError for sizes that differ, and as :func:`divisor` does.
    """
    check_same_size(radiance, reflectance, ("radiance", "reflectance"))
    return radiance / divisor(reflectance, floor=floor)


def remodulate(light: Image, reflectance: Image, *, floor: float = FLOOR) -> Image:
    """The inverse of :func:`demodulate` with the same reflectance, up to rounding."""
    check_same_size(light, reflectance, ("light", "reflectance"))
    return light * divisor(reflectance, floor=floor)


def texture_left(reflectance: Image, divided_by: Image, light: Image | None = None) -> Image:
    """The texture that a division leaves: what light of 1 looks like after it, ``reflectance / divided_by``, <= 1.

    It is 1 where the reflectance is not small, and dark where the divisor is larger than the reflectance. It is 1, too,
    where there is ``light`` [..., 3] though less than 0.005 of every colour is reflected: that light is emitted, and
    the texture is none of it. Without ``light`` nothing is.
    """
    texture = jnp.minimum(reflectance / divided_by, 1.0)
    if light is None:
        return texture
    black = _largest(reflectance) < _BLACK
    return jnp.where(black & (_largest(light) > 0), 1.0, texture)


def hue_left(texture: Image) -> Image:
    """The colour [..., 3] of what is left of a texture, without its brightness: about 1 in its brightest channel.

    For albedos that may not be all that a surface reflects: metal and gloss, whose albedo is 0 or dark, give light all
    the same, and to darken it would be wrong. ``(s + e) / (max s + e)``, e = 0.3: 1 for black.
    """
    return (texture + _FAINT) / (_largest(texture) + _FAINT)


def _largest(colour: jax.Array) -> jax.Array:
    """[..., 1] the largest of three channels; XLA:CPU takes four times as long for a maximum over so short an axis."""
    red, green, blue = (colour[..., index : index + 1] for index in range(3))
    return jnp.maximum(jnp.maximum(red, green), blue)


@operation
def texture_or_hue(reflectance: Image, light: Image, hue: Bool[Array, ""]) -> Image:
    """The texture [H, W, 3] that dividing ``light`` by :func:`divisor` leaves of a reflectance, or its colour alone.

    :func:`texture_left` where ``hue``, a bool scalar, is false, else :func:`hue_left` of it.
    """
    texture = texture_left(reflectance, divisor(reflectance), light)
    return jnp.where(hue, hue_left(texture), texture)


@numba_call.implements(texture_or_hue)
def _texture_or_hue_by_numba(reflectance: jax.Array, light: jax.Array, hue: jax.Array) -> jax.Array:
    from jaxdn.materials.numba_brdf import texture

    numbers = (np.float32(number) for number in (FLOOR, (1 + FLOOR**4) ** -0.25, _BLACK, _FAINT))
    arrays = [reflectance, light, jnp.reshape(hue, (1,))]
    return numba_call.call(texture, [reflectance.shape], arrays, *numbers, rows=reflectance.shape[0])[0]


def restore(filtered: Image, texture: Image, filtered_texture: Image) -> Image:
    """The filtered light with the texture that the division left, which the filter has blurred: a ratio estimator.

    ``filtered * (texture + e) / (filtered_texture + e)``, e = 0.01, where both were filtered with the same weights. Of
    light x = E s, with s the texture and E smooth, ``sum w x / sum w s`` is E: without it, a channel that a surface
    hardly reflects would darken its neighbours and get their light. Where s is the same everywhere nothing changes, and
    e keeps light bounded that no reflectance explains. The weights must not be negative: a filter that also subtracts
    may leave a texture of about -e, and divides by 0.
    """
    return filtered * ((texture + _UNEXPLAINED) / (filtered_texture + _UNEXPLAINED))


_BLACK = 0.005
_FAINT, _UNEXPLAINED = 0.3, 0.01
"""From 0.1 to 0.3 the first, and from 0.02 to 0.1 the second, make no difference of more than 0.03 dB to svgf (means
of four and of nine clips).
"""


@texture_or_hue.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    reflectance, light = rng.random((height, width, 3)) ** 4, 9 * rng.random((height, width, 3))
    for hue in (False, True):
        yield Example((reflectance * (rng.random((height, width, 1)) > 0.2), light, np.array(hue)))
