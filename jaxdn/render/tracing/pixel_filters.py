"""Pixel filters by importance sampling: where in and around its pixel a sample lies, so that all have the weight 1.

A pixel is the integral of what the camera sees, weighted with a filter ``w(x) w(y)`` around the pixel's centre. Samples
that are drawn from the filter's own density count the same, and share nothing with the samples of other pixels (Ernst,
Stamminger, Greiner 2006, "Filter importance sampling"). The filters and their widths are Cycles':

* ``centre``: no filter. All samples go through the pixel's centre;
* ``box``: uniform over the pixel;
* ``gaussian``: standard deviation 3/8 px, cut at 3/2 px (Cycles' width of 1.5 px);
* ``blackman-harris``: the window of four terms (Harris 1978), 3 px from end to end (Cycles' default, width 1.5 px).
"""

import functools
from typing import Literal, get_args

import numpy as np

PixelFilter = Literal["centre", "box", "gaussian", "blackman-harris"]
PIXEL_FILTERS: tuple[PixelFilter, ...] = get_args(PixelFilter)

REACH: dict[PixelFilter, float] = {"centre": 0.0, "box": 0.5, "gaussian": 1.5, "blackman-harris": 1.5}
"""How far from the pixel's centre a filter reaches along each axis, in pixels."""
GAUSSIAN_DEVIATION = 0.375
"""In pixels."""
_HARRIS = (0.35875, 0.48829, 0.14128, 0.01168)
_INTERVALS = 1 << 16
"""Of the table of quantiles, with the same share of the filter's weight in each."""
_FINE = 1 << 18
"""Intervals of the numerical integral."""


def evaluate_filter(name: PixelFilter, offset: np.ndarray) -> np.ndarray:
    """The weight ``w`` of a filter at offsets along one axis, in pixels from the centre; not normalised."""
    inside = np.abs(offset) <= REACH[name]
    if name == "gaussian":
        return np.where(inside, np.exp(-0.5 * np.square(offset / GAUSSIAN_DEVIATION)), 0.0)
    if name == "blackman-harris":
        angle = 2 * np.pi * (offset / (2 * REACH[name]) + 0.5)
        signs = (1, -1, 1, -1)
        window = sum(sign * a * np.cos(k * angle) for k, (sign, a) in enumerate(zip(signs, _HARRIS, strict=True)))
        return np.where(inside, window, 0.0)
    return np.where(inside, 1.0, 0.0)


@functools.cache
def compute_quantiles(name: PixelFilter) -> np.ndarray:
    """[65537] float64: the offsets, in pixels, up to which equal shares of a filter's weight lie, from end to end.

    A uniform number ``u`` in [0, 1), looked up at ``65536 u`` with linear interpolation, becomes an offset.
    """
    reach = REACH[name]
    edges = np.linspace(-reach, reach, _FINE + 1)
    weight = evaluate_filter(name, (edges[1:] + edges[:-1]) / 2)
    total = np.concatenate([[0.0], np.cumsum(weight)])
    shares = np.linspace(0.0, 1.0, _INTERVALS + 1)
    found = np.interp(shares, total / total[-1], edges) if reach else np.zeros(_INTERVALS + 1)
    return 0.5 * (found - found[::-1])  # exactly symmetric: the filter must not move the image


def draw_offsets(name: PixelFilter, numbers: np.ndarray) -> np.ndarray:
    """Offsets in pixels along one axis by uniform numbers in [0, 1)."""
    return np.interp(numbers, np.linspace(0.0, 1.0, _INTERVALS + 1), compute_quantiles(name))
