"""Open animated scenes: from a clip's record, a scene file, a family's name, or a scene loaded by Mitsuba."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.render.families import FAMILIES
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.animation import CameraKeys, RigidKeys, check_animation, read_animation
from jaxdn.render.scenes.optics import ENTRIES, Lens, get_shutter, read_optics
from jaxdn.render.scenes.scene import AnimatedScene, Camera, brightness
from jaxdn.render.scenes.scene_file import SceneFile


def scene_from_record(record: Mapping[str, Any]) -> AnimatedScene:
    """Build the scene that a clip's record describes: ``{"family": name, "seed": int, ...}``, or a scene file's.

    Keys other than ``family`` become the keyword arguments of the family's function; ``{"file": ..., "animation":
    ...}`` is an animated scene file. With ``"start": frame`` the scene begins at that frame of either. Raises
    ValueError for a record that names neither, and for an unknown family.
    """
    if "start" in record:
        whole = scene_from_record({key: value for key, value in record.items() if key != "start"})
        return TimeOffsetScene(whole, record["start"])
    if "file" in record:
        return SceneFile.from_record(record)
    if "family" not in record:
        raise ValueError(
            f"scene record: expected a 'family' or a 'file', got {sorted(record)}; see jaxdn.render.families."
        )
    name = record["family"]
    if name not in FAMILIES:
        raise ValueError(f"scene record: unknown family {name!r}; expected one of {', '.join(sorted(FAMILIES))}.")
    options = {key: value for key, value in record.items() if key not in ("family", *ENTRIES)}
    scene = FAMILIES[name](**options)
    if set(record) & set(ENTRIES):
        scene.set_optics(read_optics(record, f"scene record of {name!r}:"))
    return scene


def open_family(name: str, seed: int, animation: Any = None) -> AnimatedScene:
    """A scene of a family. Raises as :func:`check_no_animation` does."""
    check_no_animation(name, animation)
    return scene_from_record({"family": name, "seed": seed})


def check_no_animation(name: str, animation: Any) -> None:
    """Raise ValueError for an animation of a family: it belongs to scene files, and families move already."""
    if animation is not None:
        raise ValueError(
            f"animation {animation}: expected none for the family {name!r}, which moves already; leave it out."
        )


def open_scene(scene: Any, animation: Any = None) -> AnimatedScene:
    """A scene file, a family's name (its seed 0), a loaded ``mi.Scene``, or a scene as Mitsuba's dict, as a scene.

    ``animation`` is an animation file, or its contents, for a scene file or a loaded scene; an animated scene is
    returned unchanged. Raises ValueError for anything else, and for files that cannot be read.
    """
    if isinstance(scene, str | Path):
        return _open_named(scene, animation)
    if isinstance(scene, Mapping):
        use_variant()
        import mitsuba as mi

        return LoadedScene(mi.load_dict(dict(scene), optimize=False), animation)
    if hasattr(scene, "shapes") and hasattr(scene, "sensors"):
        return LoadedScene(scene, animation)
    if not isinstance(scene, AnimatedScene):
        raise ValueError(f"scene: expected a scene file, a family, an mi.Scene or an AnimatedScene, got {type(scene)}.")
    return scene


def _open_named(scene: str | Path, animation: Any) -> AnimatedScene:
    """The scene of a family's name or a file's path."""
    if str(scene) in FAMILIES:
        return open_family(str(scene), 0, animation)
    if Path(scene).suffix != ".xml":
        raise ValueError(
            f"scene {str(scene)!r}: expected a Mitsuba scene (.xml), a folder of frames, or a family "
            f"({', '.join(sorted(FAMILIES))})."
        )
    if isinstance(animation, Mapping):
        return SceneFile.from_record({"file": str(scene), "animation": dict(animation)})
    return SceneFile(scene, animation)


class TimeOffsetScene:
    """An animated scene whose frame 0 is the frame ``start`` of another: further clips of the same scene.

    Its record is that of the other scene with the entry ``start``. Raises ValueError for a start that is no frame.
    """

    def __init__(self, scene: AnimatedScene, start: int) -> None:
        if isinstance(start, bool) or not isinstance(start, int) or start < 0:
            raise ValueError(f"start: expected a frame, a whole number of at least 0, got {start!r}.")
        self.name, self.max_depth = scene.name, scene.max_depth
        self.frames = max(scene.frames - start, 1)
        self.record: dict[str, Any] = {**scene.record, "start": start}
        self.shutter = get_shutter(scene)
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


class LoadedScene:
    """A scene that Mitsuba has loaded already (``optimize=False``); its animation is described, not applied to it.

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
        values = mi.traverse(sensor)
        names = ("x_fov", *(Lens._fields if sensor.needs_aperture_sample() else ()))
        sizes = [float(np.ravel(np.array(values[name]))[0]) for name in names]
        rest = Camera(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4), *sizes)
        if self._camera is None:
            return rest
        fov = self._camera.fov(frame)
        return rest._replace(to_world=self._camera(frame), x_fov=rest.x_fov if fov is None else fov)

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        """Shape id -> [4, 4] motion by the keys."""
        return {name: motion(frame) for name, motion in self._motions.items()}
