"""Visibility tests of boxes and flat surfaces against the camera's view: conservative, NumPy only."""

import itertools

import numpy as np

from jaxdn.render.scenes.scene import Camera

_NEAR = 1e-6


def corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The eight corners [8, 3] of a box."""
    return np.array([np.where(pick, high, low) for pick in itertools.product((False, True), repeat=3)])


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points [N, 3] under a [4, 4] motion."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def may_be_seen(points: np.ndarray, camera: Camera, size: tuple[int, int]) -> bool:
    """Whether the convex hull of points [N, 3] may be in the view of ``size`` (height, width).

    False only where all of them lie on the outer side of one of the view's five planes.
    """
    local = _to_camera(points, camera)
    across, up = _slopes(camera, size)
    x, y, z = local.T
    outside = (z <= _NEAR, x > across * z, -x > across * z, y > up * z, -y > up * z)
    return not any(np.all(side) for side in outside)


def fills_view(to_world: np.ndarray, camera: Camera, size: tuple[int, int]) -> bool:
    """Whether the square [-1, 1]^2 at z = 0, placed by a [4, 4] matrix, covers the whole image.

    It is convex: if the four corners of the image see it, all pixels do.
    """
    across, up = _slopes(camera, size)
    inverse = np.linalg.inv(to_world) @ np.asarray(camera.to_world, np.float64)
    origin = inverse[:3, 3]
    for x, y in ((across, up), (-across, up), (across, -up), (-across, -up)):
        direction = inverse[:3, :3] @ np.array([x, y, 1.0])
        if abs(direction[2]) < 1e-12:
            return False
        distance = -origin[2] / direction[2]
        point = origin + distance * direction
        if distance <= _NEAR or np.any(np.abs(point[:2]) > 1.0):
            return False
    return True


def _to_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    return moved(points, np.linalg.inv(np.asarray(camera.to_world, np.float64)))


def _slopes(camera: Camera, size: tuple[int, int]) -> tuple[float, float]:
    """Half width and half height of the view at distance 1."""
    across = float(np.tan(np.radians(camera.x_fov) / 2))
    return across, across * size[0] / size[1]
