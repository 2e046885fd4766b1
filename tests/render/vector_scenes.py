"""Animated scenes of few shapes with known places, for the tests of shadow and glossy vectors."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import jaxdn
from jaxdn import effects
from jaxdn.core.frame import GUIDES
from jaxdn.render.frame import RenderedFrame, render_frame
from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.scenes.scene import Camera
from jaxdn.render.settings import RenderSettings
from tests.render.render_scenes import grey

WIDTH, HEIGHT = 48, 32
FAST = choose_variant().variant
READER = jaxdn.denoisers.svgf()._replace(reads=frozenset(GUIDES))
"""Reads every buffer."""
Place = Callable[[float], np.ndarray]


def look(origin: Any, target: Any) -> np.ndarray:
    """The pose of a camera; +x is to the left of its image."""
    origin, target = np.array(origin, float), np.array(target, float)
    forward = (target - origin) / np.linalg.norm(target - origin)
    left = np.cross([0.0, 1.0, 0.0], forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([left, np.cross(forward, left), forward], axis=1)
    matrix[:3, 3] = origin
    return matrix


FLOOR = np.array([[20.0, 0, 0, 0], [0, 0, 20, 0], [0, -20, 0, 0], [0, 0, 0, 1]])
"""A square of 40 x 40 at y = 0 that looks up."""


class Places:
    """Shapes whose dictionaries have a ``place``, a [4, 4] matrix or a function of the frame."""

    name = "places"
    frames = 2
    max_depth = 4

    def __init__(self, shapes: Mapping[str, dict[str, Any]], camera: Place) -> None:
        self._shapes, self._camera = shapes, camera
        self.record: dict[str, Any] = {"places": 1}

    def camera(self, frame: float) -> Camera:
        return Camera(self._camera(frame), 60.0)

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        placed = ((name, shape.get("place")) for name, shape in self._shapes.items())
        return {name: place(frame) for name, place in placed if callable(place)}

    def build(self, frame: float, width: int, height: int) -> Any:
        import mitsuba as mi

        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        scene: dict[str, Any] = {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 60.0,
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f(self._camera(frame)),
                "film": film | {"pixel_format": "rgb", "component_format": "float32"},
            },
        }
        for name, shape in self._shapes.items():
            place = shape.get("place")
            own = {key: value for key, value in shape.items() if key != "place"}
            if place is not None:
                own["to_world"] = mi.ScalarTransform4f(place(frame) if callable(place) else place)
            scene[name] = own
        return mi.load_dict(scene, optimize=False)


def floor(bsdf: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"type": "rectangle", "place": FLOOR, "bsdf": bsdf or grey(0.6)}


def rendered(
    scene: Any, frame: int = 1, *, light: Any = "reflected", previous: Any = None, **options: Any
) -> RenderedFrame:
    plan = effects.plan(effects.choose_all_effects(frame + 1), READER, light=light)
    settings: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "light": light, "plan": plan, "variant": FAST}
    return render_frame(scene, frame, RenderSettings(**settings | options), previous=previous)
