"""Camera rays of samples: through filtered points of the pixels and, where a camera has a lens, through points of it.

Their random numbers come from a stream of their own, so that the paths that follow take the same numbers whatever the
filter is. The samples of a pixel spread over the filter and over the lens
(:mod:`jaxdn.render.tracing.low_discrepancy`), as in other renderers: straight edges of 4 samples
have a third of the variance of independent ones, of 16 samples a sixth.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.tracing.low_discrepancy import scatter_points
from jaxdn.render.tracing.pixel_filters import PixelFilter, compute_quantiles, draw_offsets
from jaxdn.render.tracing.seeds import tea

_CAMERA = 0x43414D
"""Mixed into a stream's key for its camera rays."""
_FILM, _LENS = range(2)
"""The pairs of numbers of a camera ray."""
_ROUNDS = 4
"""Of Mitsuba's ``sample_tea_32``."""


def make_camera_key(key: tuple[int, int]) -> tuple[int, int]:
    """The key of the random numbers of a stream's camera rays."""
    return tea(key[0] ^ _CAMERA, key[1])


def make_camera_rays(sensor: Any, column: Any, row: Any, lens: Any = None) -> Any:
    """Rays through the centres of pixels of the sensor's film, or others at fractions of a pixel from there.

    ``lens`` is a point of the unit square for each, which a lens maps to itself; None: its middle.
    """
    width, height = sensor.film().crop_size()
    position = mi.Point2f((mi.Float(column) + 0.5) / float(width), (mi.Float(row) + 0.5) / float(height))
    ray: Any = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5) if lens is None else lens)[0]
    return mi.Ray3f(ray)


def sample_camera_rays(scene: Any, pixel: Any, sample: Any, key: tuple[int, int], pixel_filter: PixelFilter) -> Any:
    """The camera rays of samples of pixels, one each, with the vectorised variants.

    Args:
      scene: the ``mi.Scene``.
      pixel: indices of pixels.
      sample: indices of samples.
      key: of the stream (:func:`jaxdn.render.tracing.seeds.make_frame_key`).
      pixel_filter: one of :data:`jaxdn.render.tracing.pixel_filters.PIXEL_FILTERS`.
    """
    sensor = scene.sensors()[0]
    width = dr.opaque(mi.UInt32, int(sensor.film().crop_size()[0]))
    row = pixel // width
    column = pixel - row * width
    if pixel_filter == "centre":
        return make_camera_rays(sensor, column, row)
    across, down = (_look_up(pixel_filter, share) for share in _spread(pixel, sample, key, _FILM))
    lens = sample_lens(pixel, sample, key)
    return make_camera_rays(sensor, mi.Float(column) + across, mi.Float(row) + down, lens)


def sample_lens(pixel: Any, sample: Any, key: tuple[int, int]) -> Any:
    """The points of the unit square that stand for the lens in :func:`sample_camera_rays`, for the same arguments."""
    return mi.Point2f(*_spread(pixel, sample, key, _LENS))


def _spread(pixel: Any, sample: Any, key: tuple[int, int], pair: int) -> tuple[Any, Any]:
    """Two numbers in [0, 1) for every sample, that spread over the samples of its pixel."""
    first, second = make_camera_key(key)
    # Literals would be compiled into the kernel, a new one for every frame; opaque values are data.
    mix: Any = mi.sample_tea_32
    seeds = mix(pixel ^ dr.opaque(mi.UInt32, first), dr.opaque(mi.UInt32, second ^ pair))
    third = mix(seeds[0], seeds[1])[0]
    # Layer n has the samples n - 1 ... 2n - 2: their indices are to begin at a multiple of n.
    points = scatter_points(sample + 1, (third, *seeds))
    return mi.Float(points[0] >> 8) * 2.0**-24, mi.Float(points[1] >> 8) * 2.0**-24


def draw_camera_points(
    pixel: np.ndarray, sample: np.ndarray, size: tuple[int, int], key: tuple[int, int], pixel_filter: PixelFilter
) -> tuple[np.ndarray, np.ndarray]:
    """The points of the film [n, 2], in its own width and height, and of the lens [n, 2], of samples of pixels.

    The same as in :func:`sample_camera_rays`, for the variant without vectorisation. ``size`` is (height, width).
    """
    centre = np.stack([pixel % size[1], pixel // size[1]], axis=-1) + 0.5
    offset = draw_offsets(pixel_filter, _spread_arrays(pixel, sample, key, _FILM))
    return (centre + offset) / size[::-1], draw_lens_points(pixel, sample, key)


def draw_lens_points(pixel: np.ndarray, sample: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """The points of the lens [n, 2] of :func:`draw_camera_points`."""
    return _spread_arrays(pixel, sample, key, _LENS)


def _spread_arrays(pixel: np.ndarray, sample: np.ndarray, key: tuple[int, int], pair: int) -> np.ndarray:
    """[n, 2] the numbers of :func:`_spread`."""
    first, second = make_camera_key(key)
    seeds = tea(pixel.astype(np.int64) ^ first, np.full(pixel.shape, second ^ pair, np.int64), _ROUNDS)
    third = tea(seeds[0], seeds[1], _ROUNDS)[0]
    words = [np.asarray(each).astype(np.uint32) for each in (sample + 1, third, *seeds)]
    points = scatter_points(words[0], (words[1], words[2], words[3]))
    return np.stack([point >> 8 for point in points], axis=-1) * 2.0**-24


def _look_up(pixel_filter: PixelFilter, uniform: Any) -> Any:
    """Offsets in pixels by uniform numbers in [0, 1)."""
    quantiles = compute_quantiles(pixel_filter)
    table = mi.Float(quantiles.astype(np.float32))
    at = uniform * float(len(quantiles) - 1)
    low = dr.minimum(mi.UInt32(at), len(quantiles) - 2)
    first, second = (dr.gather(mi.Float, table, low + step) for step in (0, 1))
    return dr.lerp(first, second, at - mi.Float(low))
