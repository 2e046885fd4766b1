"""A scene that Mitsuba has loaded already, as an animated scene for inspection."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.render.scenes.animation import CameraKeys, RigidKeys, check_animation, read_animation
from jaxdn.render.scenes.scene import Camera


class LoadedScene:
    """A loaded ``mi.Scene`` (``optimize=False``) with an animation that is only described, not applied to it.

    For inspection and measuring the path length, not for rendering a clip: it has no record. ``animation`` is
    the path of an animation file or its contents. Raises ValueError for one that does not fit the scene.
    """

    name = "scene"
    max_depth = 8

    def __init__(self, scene: Any, animation: Any = None) -> None:
        keys = read_animation(Path(animation)) if isinstance(animation, str | Path) else dict(animation or {})
        check_animation(keys, [shape.id() for shape in scene.shapes()], has_camera=bool(scene.sensors()))
        if "inserted" in keys or "lights" in keys:
            raise ValueError("animation: inserted shapes and lights need a scene file, this scene is loaded already.")
        self.frames = int(keys.get("frames", 1))
        self.record: dict[str, Any] = {}
        self._scene = scene
        self._camera = CameraKeys(keys["camera"]) if "camera" in keys else None
        self._motions = {
            name: RigidKeys(motion["keys"], np.array(motion.get("pivot", (0, 0, 0)), float))
            for name, motion in keys.get("shapes", {}).items()
        }

    def build(self, frame: float, width: int, height: int) -> Any:
        """The given scene, unchanged."""
        return self._scene

    def camera(self, frame: float) -> Camera:
        """The camera of one frame."""
        import mitsuba as mi

        sensor = self._scene.sensors()[0]
        rest = Camera(
            np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4),
            float(np.ravel(np.array(mi.traverse(sensor)["x_fov"]))[0]),
        )
        if self._camera is None:
            return rest
        fov = self._camera.fov(frame)
        return Camera(self._camera(frame), rest.x_fov if fov is None else fov)

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        """Shape id -> [4, 4] motion by the keys."""
        return {name: motion(frame) for name, motion in self._motions.items()}
