"""The protocol of an animated scene: a camera path, poses, and Mitsuba's scene for each frame.

Mitsuba 3.9 does not support animation, so motion is a new set of transforms for every frame. All users of animations
(the tracers, the motion vectors, the clip writer) only use the protocol below, so a new family of scenes or a loader
for a file format is one new class.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np


class Camera(NamedTuple):
    """A camera in Mitsuba's convention: it looks along its +z axis, +x points LEFT in the image and +y up."""

    to_world: np.ndarray
    """[4, 4] float64 camera to world, rigid."""
    x_fov: float
    """Horizontal field of view in degrees."""
    aperture_radius: float = 0.0
    """Of its lens, in scene units; 0: a pinhole."""
    focus_distance: float = 1.0
    """Along its axis, up to what the lens shows sharp."""


@runtime_checkable
class AnimatedScene(Protocol):
    """A scene as a function of time in frames (a float is allowed); the animation starts at 0."""

    name: str
    """Short name for messages and records."""
    frames: int
    """The suggested number of frames."""
    record: dict[str, Any]
    """Everything needed to build it again, as JSON, with :func:`jaxdn.render.scene_from_record`."""
    max_depth: int
    """Path length in Mitsuba's count: 1 is emission, 2 adds direct light, 3 one indirect bounce."""

    def build(self, frame: float, width: int, height: int) -> Any:
        """The ``mi.Scene`` of one frame, loaded with ``optimize=False``; its film has a box filter, float32, rgb."""
        ...

    def camera(self, frame: float) -> Camera:
        """The camera of one frame, the same as in the scene from ``build``."""
        ...

    def pose(self, frame: float) -> Mapping[str, np.ndarray]:
        """Shape id -> [4, 4] float64 world pose of every shape that may move; other shapes are static.

        Only the ratios ``pose(i)[id] @ inv(pose(i - 1)[id])`` matter.
        """
        ...

    # A scene may also have `brightness(frame)` (see below) and `shutter`, the time for which its shutter is open.


def brightness(scene: AnimatedScene, frame: float) -> Mapping[str, float]:
    """Light -> factor on its radiance, for scenes with a method of this name; empty for others."""
    return getattr(scene, "brightness", lambda frame: {})(frame)
