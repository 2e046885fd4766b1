"""FLIP: the difference, pixel by pixel, that a viewer sees when flipping between two images.

Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild 2020, "FLIP: A Difference Evaluator for Alternating
Images" (equation and section numbers below are that paper's), in the separable form of the authors' own evaluator
1.3 and later: the spatial filters are products of one-dimensional ones, and pixels beyond the border repeat the edge.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.color import srgb_decode
from jaxdn.core.numerics import safe_norm, safe_power
from jaxdn.core.separable import correlate, pad_edge

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
"""67.02: a 0.7 m wide monitor of 3840 pixels, seen from 0.7 m (sec. 5)."""

_TO_XYZ = (
    np.array([[10135552, 8788810, 4435075], [5226144, 17577620, 1774030], [475104, 8788810 / 3, 70074185 / 3]])
    / 24577794
)
_WHITE = _TO_XYZ.sum(axis=1)
"""D65, what linear (1, 1, 1) maps to."""
_FROM_XYZ = np.linalg.inv(_TO_XYZ)
_TO_OPPONENT = np.array([[0, 116, 0], [500, -500, 0], [0, 200, -200]]) / _WHITE
"""XYZ to YCxCz, without subtracting 16 from Y (sec. 4.1.1)."""

_COLOR_EXPONENT, _FEATURE_EXPONENT = 0.7, 0.5
_KNEE, _KNEE_VALUE = 0.4, 0.95
_FEATURE_WIDTH = 0.082
"""Degrees of visual angle."""


def flip_map(image: jax.Array, reference: jax.Array, *, pixels_per_degree: float = PIXELS_PER_DEGREE) -> jax.Array:
    """LDR-FLIP error of every pixel, in [0, 1], 0 where no difference is visible.

    ``image`` and ``reference`` [..., H, W, 3] display-encoded sRGB (``color.tonemap``), clipped to [0, 1]; returns
    [..., H, W, 1]. Symmetric. A NaN pixel makes its neighbourhood NaN. Gradients are finite for finite images.
    """
    both = jnp.stack([image, reference])
    opponent = _linear_map(srgb_decode(jnp.clip(both, 0.0, 1.0)), _TO_OPPONENT @ _TO_XYZ)
    color = _color_difference(opponent, pixels_per_degree)
    feature = _feature_difference(opponent[..., 0:1] / 116.0, pixels_per_degree)
    return safe_power(color, 1.0 - feature)  # eq. 2 of sec. 4.3


def _color_difference(opponent: jax.Array, pixels_per_degree: float) -> jax.Array:
    """Perceived colour difference in [0, 1] (sec. 4.1); ``opponent`` [2, ..., H, W, 3] is YCxCz + (16, 0, 0)."""
    taps = _contrast_taps(pixels_per_degree)
    radius = len(taps) // 2
    planes = jnp.concatenate([opponent, opponent[..., 2:3]], axis=-1)
    planes = correlate(pad_edge(planes, radius, axis=-2), taps, axis=-2)
    planes = correlate(pad_edge(planes, radius, axis=-3), taps, axis=-3)
    seen = jnp.concatenate([planes[..., 0:2], planes[..., 2:3] + planes[..., 3:4]], axis=-1)

    linear = jnp.clip(_linear_map(seen, _FROM_XYZ @ np.linalg.inv(_TO_OPPONENT)), 0.0, 1.0)
    lab = _hunt(_lab(_linear_map(linear, _TO_XYZ / _WHITE[:, None])))
    distance = _hyab(lab[0], lab[1])

    # The largest possible distance, green to blue, maps to 1 (sec. 4.1.4).
    largest = _largest_distance() ** _COLOR_EXPONENT
    knee = _KNEE * largest
    x = safe_power(distance, _COLOR_EXPONENT)
    above = _KNEE_VALUE + (x - knee) / (largest - knee) * (1.0 - _KNEE_VALUE)
    return jnp.where(x < knee, x * (_KNEE_VALUE / knee), above)


def _feature_difference(gray: jax.Array, pixels_per_degree: float) -> jax.Array:
    """Difference of edges and points, in [0, 1] (sec. 4.2); ``gray`` [2, ..., H, W, 1] in [0, 1]."""
    smooth, first, second = _feature_taps(pixels_per_degree)
    radius = len(smooth) // 2
    rows = correlate(pad_edge(gray, radius, axis=-2), np.stack([first, second, smooth, smooth], -1), axis=-2)
    slopes = correlate(pad_edge(rows, radius, axis=-3), np.stack([smooth, smooth, first, second], -1), axis=-3)
    edges = safe_norm(slopes[..., 0::2])
    points = safe_norm(slopes[..., 1::2])
    larger = jnp.maximum(jnp.abs(edges[0] - edges[1]), jnp.abs(points[0] - points[1]))
    return safe_power(larger / math.sqrt(2.0), _FEATURE_EXPONENT)


def _contrast_taps(pixels_per_degree: float) -> np.ndarray:
    """[K, 4] one-dimensional contrast sensitivity filters of Y, Cx and the two terms of Cz (table 1).

    In two dimensions each term is ``a sqrt(pi / b) exp(-pi^2 (x^2 + y^2) / b)``: the product of the square roots.
    """
    a = np.array([1.0, 1.0, 34.1, 13.5])
    b = np.array([0.0047, 0.0053, 0.04, 0.025])
    radius = math.ceil(3 * math.sqrt(b.max() / (2 * math.pi**2)) * pixels_per_degree)
    x = np.arange(-radius, radius + 1)[:, None] / pixels_per_degree
    taps = np.sqrt(a * np.sqrt(math.pi / b)) * np.exp(-(math.pi**2) * x * x / b)
    total = taps.sum(axis=0) ** 2
    total[2:] = total[2:].sum()  # the two terms of Cz are one filter
    return taps / np.sqrt(total)


def _feature_taps(pixels_per_degree: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A Gaussian and its first and second derivative; positive and negative taps each sum to one (sec. 4.2)."""
    sigma = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    x = np.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1)
    g = np.exp(-(x**2) / (2 * sigma**2))

    def balanced(taps: np.ndarray) -> np.ndarray:
        positive, negative = taps[taps > 0].sum(), -taps[taps < 0].sum()
        return np.where(taps > 0, taps / positive, taps / negative)

    return g / g.sum(), balanced(-x * g), balanced((x**2 / sigma**2 - 1) * g)


def _linear_map(image: jax.Array, matrix: np.ndarray) -> jax.Array:
    """``matrix`` times the colour of every pixel, as explicit sums: devices may compute dot products less precisely."""
    columns = matrix.T.reshape((3,) + (1,) * (image.ndim - 1) + (3,)).astype(image.dtype)
    return image[..., 0:1] * columns[0] + image[..., 1:2] * columns[1] + image[..., 2:3] * columns[2]


def _lab(relative: jax.Array) -> jax.Array:
    """CIELAB of XYZ divided by white."""
    delta = 6 / 29
    toe = relative <= delta**3
    root = jnp.where(toe, relative / (3 * delta**2) + 4 / 29, jnp.where(toe, 1.0, relative) ** (1 / 3))
    x, y, z = root[..., 0:1], root[..., 1:2], root[..., 2:3]
    return jnp.concatenate([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _hunt(lab: jax.Array) -> jax.Array:
    """Hunt effect, dark colours look less colourful: a and b times L / 100 (sec. 4.1.2)."""
    return jnp.concatenate([lab[..., 0:1], 0.01 * lab[..., 0:1] * lab[..., 1:3]], axis=-1)


def _hyab(first: jax.Array, second: jax.Array) -> jax.Array:
    """City-block in lightness, Euclidean in a and b (sec. 4.1.3)."""
    difference = first - second
    return jnp.abs(difference[..., 0:1]) + safe_norm(difference[..., 1:3])


def _largest_distance() -> float:
    """HyAB distance of Hunt-adjusted linear green and blue."""
    delta = 6 / 29
    relative = (_TO_XYZ / _WHITE[:, None])[:, 1:].T
    root = np.where(relative <= delta**3, relative / (3 * delta**2) + 4 / 29, np.cbrt(relative))
    lightness = 116 * root[:, 1] - 16
    a = 0.01 * lightness * 500 * (root[:, 0] - root[:, 1])
    b = 0.01 * lightness * 200 * (root[:, 1] - root[:, 2])
    return float(abs(lightness[0] - lightness[1]) + math.hypot(a[0] - a[1], b[0] - b[1]))
