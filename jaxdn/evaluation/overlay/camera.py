"""Motion that follows from depth and the camera alone, where the headers say where the camera is."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import FAR


class CameraMatrices(NamedTuple):
    """Of one frame, for row vectors as OpenEXR has them: (x, y, z, 1) times the matrix."""

    to_camera: np.ndarray
    """[4, 4] from the world to the camera's axes."""
    to_screen: np.ndarray
    """[4, 4] from the world to (x, y, z, w), where x / w and y / w are -1 to 1 over the picture, y up."""


def read_camera(header: Mapping[str, Any]) -> CameraMatrices | None:
    """The camera of a header with ``worldToCamera`` and ``worldToNDC``; None where one is missing or says nothing.

    Some programs write the transpose. A ``worldToNDC`` without perspective is no camera's.
    """
    to_camera, to_screen = _matrix(header.get("worldToCamera")), _matrix(header.get("worldToNDC"))
    if to_camera is None or to_screen is None:
        return None
    if not np.allclose(to_camera[:, 3], (0, 0, 0, 1)):
        to_camera, to_screen = to_camera.T, to_screen.T
    sound = np.allclose(to_camera[:, 3], (0, 0, 0, 1)) and abs(np.linalg.det(to_camera)) > 1e-12
    perspective = np.abs(to_screen[:3, 3]).max() > 1e-9
    return CameraMatrices(to_camera, to_screen) if sound and perspective else None


def camera_motion(depth: np.ndarray, now: CameraMatrices, before: CameraMatrices) -> np.ndarray:
    """[H, W, 2] the vectors of a still world, previous minus current, in pixels, y down; NaN where nothing was hit.

    The point p of a pixel at the screen position (x, y) with the depth d along the optical axis solves three linear
    equations: p X = x p W, p Y = y p W, and p Z = d or -d, where X, Y, W are columns of ``to_screen`` and Z that of
    ``to_camera``; the sign is the one for which w > 0.

    Args:
      depth: [H, W, 1] along the optical axis.
      now: the camera of this frame.
      before: that of the frame before.
    """
    height, width = depth.shape[:2]
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    x, y = (2 * columns + 1) / width - 1, 1 - (2 * rows + 1) / height
    screen = now.to_screen
    first = screen[:, 0] - x[..., None] * screen[:, 3]
    second = screen[:, 1] - y[..., None] * screen[:, 3]
    third = np.broadcast_to(now.to_camera[:, 2], first.shape)
    equations = np.stack([first[..., :3], second[..., :3], third[..., :3]], axis=-2)
    hit = depth[..., 0] < FAR
    distance = np.where(hit, depth[..., 0], 1.0).astype(np.float64)
    best = np.full((height, width, 2), np.nan)
    for sign in (1.0, -1.0):
        right = -np.stack([first[..., 3], second[..., 3], third[..., 3] - sign * distance], axis=-1)
        try:
            points = np.linalg.solve(equations, right[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return best
        points = np.concatenate([points, np.ones((height, width, 1))], axis=-1)
        there = points @ before.to_screen
        ahead = hit & (points @ screen[:, 3] > 0) & (there[..., 3] > 0)
        w = np.where(ahead, there[..., 3], 1.0)
        column = ((there[..., 0] / w + 1) * width - 1) / 2
        row = ((1 - there[..., 1] / w) * height - 1) / 2
        best = np.where(ahead[..., None], np.stack([column - columns, row - rows], axis=-1), best)
    return best.astype(np.float32)


def _matrix(value: Any) -> np.ndarray | None:
    """[4, 4] float64, or None."""
    if value is None or np.shape(value) != (4, 4):
        return None
    matrix = np.asarray(value, np.float64)
    return matrix if np.isfinite(matrix).all() else None
