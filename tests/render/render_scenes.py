"""Small animated scenes with known answers, for the tests of the renderer."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.scenes.scene import Camera

WIDTH, HEIGHT = 24, 16
NEAR = 0.5
SQUARE_Z, WALL_Z = 3.0, 6.0
PIXEL = 2 * SQUARE_Z / WIDTH
"""Size of a pixel at the square's depth, with 90 degrees of view."""


def fast_variants() -> list[str]:
    """scalar_rgb always, and the fast one where it works."""
    return sorted({"scalar_rgb", choose_variant().variant}, reverse=True)


def grey(value: float) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}}


def shift(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def turn(degrees: float) -> np.ndarray:
    """Rotation about +y."""
    angle = np.radians(degrees)
    matrix = np.eye(4)
    matrix[0, 0] = matrix[2, 2] = np.cos(angle)
    matrix[0, 2], matrix[2, 0] = np.sin(angle), -np.sin(angle)
    return matrix


class Stage:
    """A wall, a square in front of it, a light behind the camera. Camera: 90 degrees, at the origin, along +z."""

    name = "stage"
    frames = 3
    max_depth = 4

    def __init__(
        self,
        *,
        square: Callable[[float], np.ndarray] = lambda frame: shift(0, 0, SQUARE_Z),
        camera: Callable[[float], np.ndarray] = lambda frame: np.eye(4),
        wall: bool = True,
        shapes: dict[str, Any] | None = None,
        extra: dict[str, Any] | None = None,
    ) -> None:
        self._square, self._camera, self._wall = square, camera, wall
        self._shapes, self._extra = shapes, extra or {}
        self.record: dict[str, Any] = {"stage": 1}

    def camera(self, frame: float) -> Camera:
        return Camera(self._camera(frame), 90.0)

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        return {"square": self._square(frame)}

    def build(self, frame: float, width: int, height: int) -> Any:
        import mitsuba as mi

        place = mi.ScalarTransform4f
        # Three pixels in each direction; the light is behind the camera with a floor below it, for indirect light.
        small = np.diag([3 * PIXEL, 3 * PIXEL, 1.0, 1.0])
        scene: dict[str, Any] = {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 90.0,
                "fov_axis": "x",
                "near_clip": NEAR,
                "to_world": place(self._camera(frame)),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
            },
            "square": {"type": "rectangle", "to_world": place(self._square(frame) @ small), "bsdf": grey(0.5)},
            "floor": {
                "type": "rectangle",
                "to_world": place(np.array([[20.0, 0, 0, 0], [0, 0, 20.0, -5.0], [0, -20.0, 0, 0], [0, 0, 0, 1.0]])),
                "bsdf": grey(0.8),
            },
            "lamp": {
                "type": "rectangle",
                "to_world": place(shift(0, 3, -2)),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 20.0}},
            },
        }
        if self._wall:
            size = np.diag([40.0, 40.0, 1.0, 1.0])
            scene["wall"] = {"type": "rectangle", "to_world": place(shift(0, 0, WALL_Z) @ size), "bsdf": grey(0.7)}
        scene.update(self._shapes or {})
        scene.update(self._extra)
        return mi.load_dict(scene, optimize=False)
