"""Camera rays of samples: through filtered points of the pixels and, where a camera has a lens, through points of it.

Their random numbers come from a stream of their own, so that the paths that follow take the same numbers whatever the
filter is.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.tracing.lobes import make_generator
from jaxdn.render.tracing.pixel_filters import PixelFilter, compute_quantiles, draw_offsets
from jaxdn.render.tracing.seeds import tea

_CAMERA = 0x43414D
"""Mixed into a stream's key for its camera rays."""


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
    lens, numbers = _draw_lens(pixel, sample, key)
    across, down = (_look_up(pixel_filter, numbers.next_float32()) for _ in range(2))
    return make_camera_rays(sensor, mi.Float(column) + across, mi.Float(row) + down, lens)


def sample_lens(pixel: Any, sample: Any, key: tuple[int, int]) -> Any:
    """The points of the unit square that stand for the lens in :func:`sample_camera_rays`, for the same arguments."""
    return _draw_lens(pixel, sample, key)[0]


def _draw_lens(pixel: Any, sample: Any, key: tuple[int, int]) -> tuple[Any, Any]:
    """Points of the lens, and the generator of the numbers that come next."""
    numbers = make_generator(pixel, sample, make_camera_key(key))
    return mi.Point2f(numbers.next_float32(), numbers.next_float32()), numbers


def draw_camera_points(
    pixel: np.ndarray, sample: np.ndarray, size: tuple[int, int], key: tuple[int, int], pixel_filter: PixelFilter
) -> tuple[np.ndarray, np.ndarray]:
    """The points of the film [n, 2], in its own width and height, and of the lens [n, 2], of samples of pixels.

    For the variant without vectorisation, whose random numbers are others than those of :func:`sample_camera_rays`.
    ``size`` is (height, width).
    """
    centre = np.stack([pixel % size[1], pixel // size[1]], axis=-1) + 0.5
    offset = draw_offsets(pixel_filter, _draw_uniform(pixel, sample, key, 1))
    return (centre + offset) / size[::-1], draw_lens_points(pixel, sample, key)


def draw_lens_points(pixel: np.ndarray, sample: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """The points of the lens [n, 2] of :func:`draw_camera_points`."""
    return _draw_uniform(pixel, sample, key, 0)


def _draw_uniform(pixel: np.ndarray, sample: np.ndarray, key: tuple[int, int], pair: int) -> np.ndarray:
    """[n, 2] in [0, 1), one pair of numbers of several for every sample."""
    first, second = make_camera_key(key)
    mixed = tea(pixel.astype(np.int64) ^ first, sample.astype(np.int64) ^ second)
    return np.stack(tea(mixed[0] ^ pair, mixed[1]), axis=-1) * 2.0**-32


def _look_up(pixel_filter: PixelFilter, uniform: Any) -> Any:
    """Offsets in pixels by uniform numbers in [0, 1)."""
    quantiles = compute_quantiles(pixel_filter)
    table = mi.Float(quantiles.astype(np.float32))
    at = uniform * float(len(quantiles) - 1)
    low = dr.minimum(mi.UInt32(at), len(quantiles) - 2)
    first, second = (dr.gather(mi.Float, table, low + step) for step in (0, 1))
    return dr.lerp(first, second, at - mi.Float(low))
