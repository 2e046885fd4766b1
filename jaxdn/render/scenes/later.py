"""A later part of an animation as a scene of its own: other clips of the same scene."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdn.render.scenes.scene import AnimatedScene, Camera, brightness


class Later:
    """An animated scene whose frame 0 is the frame ``start`` of another; its record has ``start`` in addition."""

    def __init__(self, scene: AnimatedScene, start: int) -> None:
        if isinstance(start, bool) or not isinstance(start, int) or start < 0:
            raise ValueError(f"start: expected a frame, a whole number of at least 0, got {start!r}.")
        self.name, self.max_depth = scene.name, scene.max_depth
        self.frames = max(scene.frames - start, 1)
        self.record: dict[str, Any] = {**scene.record, "start": start}
        self._scene, self._start = scene, start

    def build(self, frame: float, width: int, height: int) -> Any:
        """The ``mi.Scene`` of one frame."""
        return self._scene.build(self._start + frame, width, height)

    def camera(self, frame: float) -> Camera:
        """The camera of one frame."""
        return self._scene.camera(self._start + frame)

    def pose(self, frame: float) -> Mapping[str, np.ndarray]:
        """Shape id -> [4, 4] world pose of every shape that may move."""
        return self._scene.pose(self._start + frame)

    def brightness(self, frame: float) -> Mapping[str, Any]:
        """Light -> factor on its radiance."""
        return brightness(self._scene, self._start + frame)
