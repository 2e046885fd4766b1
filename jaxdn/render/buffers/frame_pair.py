"""Two consecutive frames, between which the paths of one noisy image are followed."""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.buffers.geometry import View
from jaxdn.render.tracing.camera_rays import make_camera_rays
from jaxdn.render.tracing.lobes import make_generator
from jaxdn.render.tracing.radiance import get_film_size
from jaxdn.render.tracing.seeds import SampleStream


class BuiltFrame(NamedTuple):
    """One frame with its geometry."""

    scene: Any
    """The ``mi.Scene``."""
    view: View


class FramePair(NamedTuple):
    """A frame and the one before it."""

    previous: BuiltFrame
    current: BuiltFrame
    noise: SampleStream
    """The random numbers of the current frame's noisy image."""
    sample: int
    """Index of the sample, of each of the two noisy images, that is followed."""


def repeat_camera_rays(scene: Any, stream: SampleStream, sample: int) -> tuple[Any, Any]:
    """The camera rays of one sample of all pixels, and a generator of the random numbers that its paths began with."""
    height, width = get_film_size(scene)
    pixel = dr.arange(mi.UInt32, width * height)
    across = dr.opaque(mi.UInt32, width)
    ray = make_camera_rays(scene.sensors()[0], pixel % across, pixel // across)
    return ray, make_generator(pixel, dr.opaque(mi.UInt32, sample), stream.key())


def to_image(lanes: Any, size: tuple[int, int], dtype: Any) -> np.ndarray:
    """Mitsuba's values, one for each pixel of an image of ``size`` (height, width), as an array [H, W, ...]."""
    values = np.array(lanes).T.astype(dtype)
    return values.reshape(*size, *values.shape[1:])


def to_lanes(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] as Mitsuba takes them: [3, N] float32."""
    return np.ascontiguousarray(vectors.reshape(-1, 3).T.astype(np.float32))


def rotate(motions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Directions [..., 3] turned by motions [..., 4, 4]."""
    return np.einsum("...ij,...j->...i", motions[..., :3, :3], directions)


def carry(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [..., 3] moved by motions [..., 4, 4]."""
    return rotate(motions, points) + motions[..., :3, 3]
