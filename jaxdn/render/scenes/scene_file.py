"""Animated Mitsuba scene files: any scene XML, with an animation file of keys next to it.

Mitsuba's own parser and loader are used (:mod:`jaxdn.render.scenes.scene_parser`): static parts are loaded once; for
every frame the camera, the moving shapes with the motion in front of their transform, lights that change and inserted
shapes are loaded in addition.
"""

import difflib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.render.scenes.animation import (
    CameraKeys,
    RigidKeys,
    check_animation,
    interpolate_light_scale,
    read_animation,
    read_extents,
)
from jaxdn.render.scenes.lights import check_lights, list_lights, scale_light
from jaxdn.render.scenes.optics import Lens, describe_optics, read_optics
from jaxdn.render.scenes.scene import Camera
from jaxdn.render.scenes.scene_parser import SceneParser

_DEPTH = 8
"""Path length if the file has unlimited paths or does not specify it."""


class SceneFile:
    """A Mitsuba 3 scene file as an animated scene; see :mod:`jaxdn.render.scenes.animation` for the JSON file.

    Without ``animation_path`` the file ``<scene>.json`` next to the scene is used if there is one, and a scene without
    an animation is static. Shapes and lights without an id are named by the
    :class:`jaxdn.render.scenes.scene_parser.SceneParser`. The camera is the file's first sensor, which must be a
    perspective one or a thin lens; its horizontal field of view is that of the file's own film at every image size.
    Raises ValueError for files that cannot be read and animations that do not match the scene. Warns of what the file
    asks for and rendering leaves out: a crop of the film, lights that are hidden.
    """

    def __init__(self, path: Path | str, animation_path: Path | str | None = None) -> None:
        path = Path(path)
        own = path.with_suffix(".json")
        if animation_path is None and own.is_file():
            animation_path = own
        if animation_path is not None and not Path(animation_path).is_file():
            raise ValueError(f"animation {animation_path}: expected a file, found none.")
        self._open(path, {} if animation_path is None else read_animation(Path(animation_path)))

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "SceneFile":
        """The scene of a clip's record ``{"file": ..., "animation": {...}}``; its path may be relative."""
        scene = cls.__new__(cls)
        scene._open(Path(record["file"]), record.get("animation", {}))
        return scene

    @staticmethod
    def name_of(path: Path | str) -> str:
        """The name of a scene file: that of its folder for ``scene.xml``, else its own."""
        path = Path(path)
        return path.parent.name if path.stem == "scene" and path.parent.name else path.stem

    def _open(self, path: Path, animation: dict[str, Any]) -> None:
        self._parser = parser = SceneParser(path)
        self._shapes = {parser.names[child]: child for child in parser.of_type("Shape")}
        shapes = [name for name, child in self._shapes.items() if parser.plugin(child) != "shapegroup"]
        self._rest, self.near, self._far, self._medium = _read_camera(parser)
        check_animation(animation, shapes, has_camera=self._rest is not None)
        self._optics = read_optics(animation, "animation")
        self.shutter = self._optics.shutter
        if self._rest is None and "camera" not in animation:
            raise ValueError(
                f"scene {path}: expected a perspective sensor or an animation with camera keys, got neither."
            )
        self.name = self.name_of(path)
        self.frames = int(animation.get("frames", 1))
        self.max_depth = _read_path_length(parser)
        self.record = {"file": _shorten(path), "animation": animation}
        self._camera = CameraKeys(animation["camera"]) if "camera" in animation else None
        self._motions = {
            name: RigidKeys(motion["keys"], np.array(motion.get("pivot", (0, 0, 0)), float))
            for name, motion in animation.get("shapes", {}).items()
        }
        self._inserted = {shape["id"]: shape for shape in animation.get("inserted", [])}
        for name, shape in self._inserted.items():
            self._motions[name] = RigidKeys(shape.get("keys", [{"frame": 0}]), np.zeros(3))
        self._known_lights = list_lights(parser)
        self._lights = animation.get("lights", {})
        check_lights(parser, self._known_lights, self._lights)
        self._materials = animation.get("materials", {})
        _check_materials(parser, self._materials)
        changing = {child for name, child in self._shapes.items() if name in self._motions}
        changing |= {self._known_lights[name].emitter for name in self._lights}
        # An emitter that a shape refers to is a part of that shape.
        lamps = set(parser.of_type("Emitter")).difference(*map(parser.references, self._shapes.values()))
        parts = [*self._shapes.values(), *sorted(lamps)]
        self._moving = [child for child in parts if changing & parser.inside(child)]
        self._resting = [child for child in parts if child not in self._moving]
        self._still: tuple[str, list[Any]] | None = None

    def camera(self, frame: float) -> Camera:
        """The camera of one frame."""
        if self._camera is None:
            assert self._rest is not None
            return self._optics.focus(self._rest)
        fov, path = self._camera.fov(frame), self._camera(frame)
        if self._rest is not None:
            return self._optics.focus(
                self._rest._replace(to_world=path, x_fov=self._rest.x_fov if fov is None else fov)
            )
        assert fov is not None
        return self._optics.focus(Camera(path, fov))

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        """Shape id -> [4, 4] motion by the keys, from the shape's place in the file."""
        return {name: motion(frame) for name, motion in self._motions.items()}

    def brightness(self, frame: float) -> dict[str, float | tuple[float, ...]]:
        """Light -> factor on its radiance, one or three for red, green and blue, for lights with keys."""
        return {name: interpolate_light_scale(keys, frame) for name, keys in self._lights.items()}

    def lights(self) -> dict[str, bool]:
        """The lights whose radiance keys can scale -> whether they can scale red, green and blue by themselves."""
        lights = {child: light for light in self._known_lights.values() for child in [light.owner]}
        return {self._parser.names[owner]: lights[owner].colored for owner in sorted(lights) if lights[owner].plain}

    def build(self, frame: float, width: int, height: int) -> Any:
        """The ``mi.Scene`` of one frame; static parts are loaded once and shared by all frames."""
        import mitsuba as mi

        from jaxdn.render.scenes.material_overrides import list_shapes, override_materials
        from jaxdn.render.scenes.plugins import list_shape_groups

        variant = str(mi.variant())
        if self._still is None or self._still[0] != variant:
            still = self._parser.load(self._resting)
            override_materials(list_shapes(still), self._materials)
            # Groups are kept for inspection: instances do not show their contents.
            lamps = [emitter for emitter in still.emitters() if emitter.get_shape() is None]
            self._still = variant, [*still.shapes(), *list_shape_groups(still), *lamps]
        parts = {part.id(): part for part in self._still[1]}
        parts |= {part.id(): part for part in self._load_changed(frame, parts)}
        parts |= {name: _make_primitive(shape, self.pose(frame)[name]) for name, shape in self._inserted.items()}
        parts |= {
            "animation_sensor": self._make_sensor(frame, width, height),
            "animation_integrator": {"type": "path", "max_depth": self.max_depth},
        }
        # A key of this dictionary becomes the object's id. One after the other, so that their numbers, which are a part
        # of kernels, are the same in every frame.
        return mi.load_dict({"type": "scene", **parts}, optimize=False, parallel=False)

    def _load_changed(self, frame: float, still: Mapping[str, Any]) -> list[Any]:
        """The shapes and lamps of the file that move or change, in one frame."""
        import mitsuba as mi

        from jaxdn.render.scenes.material_overrides import override_materials

        poses, lights = self.pose(frame), self.brightness(frame)
        found: dict[int, Any] = {}
        for node in self._moving:
            changes: dict[str, Any] = {}
            pose = poses.get(self._parser.names[node])
            if pose is not None:
                rest = self._parser.values(node).get("to_world")
                own = np.eye(4) if rest is None else np.array(rest.matrix, np.float64).reshape(4, 4)
                changes["to_world"] = mi.ScalarTransform4d(pose @ own)
            found[node] = self._parser.load_node(node, changes, still)
        override_materials([found[node] for node in self._moving if node in self._shapes.values()], self._materials)
        for name, factor in lights.items():
            owner = self._known_lights[name].owner
            emitter = found[owner].emitter() if owner in self._shapes.values() else found[owner]
            scale_light(emitter, np.broadcast_to(factor, 3), name)
        return list(found.values())

    def _make_sensor(self, frame: float, width: int, height: int) -> dict[str, Any]:
        """The camera and film of one frame, as Mitsuba's dict."""
        import mitsuba as mi

        camera = self.camera(frame)
        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        own = {} if self._medium is None else {"medium": self._parser.load_node(self._medium)}
        return {
            **own,
            **describe_optics(camera, self._optics.fog),
            "fov": float(camera.x_fov),
            "fov_axis": "x",
            "near_clip": self.near,
            "far_clip": self._far,
            "to_world": mi.ScalarTransform4d(np.asarray(camera.to_world, np.float64)),
            "sampler": {"type": "independent"},
            "film": {**film, "pixel_format": "rgb", "component_format": "float32"},
        }


def _shorten(path: Path) -> str:
    """The path from the folder where the command runs, if it lies in there; else the whole one."""
    try:
        near = os.path.relpath(path)
    except ValueError:  # on another drive of Windows
        near = ".."
    return path.resolve().as_posix() if near.startswith("..") else near


def _read_camera(parser: SceneParser) -> tuple[Camera | None, float, float, int | None]:
    """The file's own camera with its near and far clip, read by Mitsuba, and the medium around it, as a node.

    No camera where the file has no sensor.
    """
    import mitsuba as mi

    sensors = parser.of_type("Sensor")
    if not sensors:
        return None, 1e-2, 1e4, None
    kind = parser.plugin(sensors[0])
    if kind not in ("perspective", "thinlens"):
        raise ValueError(f"scene sensor: expected a perspective one or a thin lens, got {kind!r}; change its type.")
    loaded = parser.load_node(sensors[0])
    values, film = mi.traverse(loaded), loaded.film()
    offset = [_read_number(values, f"principal_point_offset_{axis}") for axis in "xy" if kind == "perspective"]
    if any(offset):
        raise ValueError(f"scene sensor: expected no principal point offset, got {offset}; remove it.")
    if list(film.crop_size()) != list(film.size()):
        warnings.warn(
            f"scene {parser.path}: its film shows a crop of {'x'.join(map(str, film.crop_size()))} pixels; the whole "
            "image is rendered.",
            stacklevel=5,
        )
    media = [node for node in parser.references(sensors[0]) if parser.type_of(node) == "Medium"]
    fov, near, far = (_read_number(values, key) for key in ("x_fov", "near_clip", "far_clip"))
    matrix = np.array(loaded.world_transform().matrix, np.float64).reshape(4, 4)
    camera = Camera(matrix, fov)
    if kind == "thinlens":
        camera = Lens(*(_read_number(values, name) for name in Lens._fields)).fit(camera)
    return camera, near, far, media[0] if media else None


def _read_number(values: Any, key: str) -> float:
    return float(np.ravel(np.array(values[key]))[0])


def _read_path_length(parser: SceneParser) -> int:
    """max_depth of the file's integrator, also if nested; warns where it hides lights."""
    depths: list[int] = []
    for integrator in parser.of_type("Integrator")[:1]:
        values = [parser.values(node) for node in sorted(parser.inside(integrator))]
        depths = [int(one["max_depth"]) for one in values if int(one.get("max_depth", -1)) > 0]
        if any(one.get("hide_emitters") for one in values):
            warnings.warn(
                f"scene {parser.path}: its integrator hides lights from the camera; they are rendered, as the buffer "
                "'emission' alone: leave it out to hide them.",
                stacklevel=5,
            )
    return depths[0] if depths else _DEPTH


def _check_materials(parser: SceneParser, materials: Mapping[str, Any]) -> None:
    """Raise ValueError for a name that is neither a BSDF of the scene nor a shape whose BSDF has no id."""
    names = [parser.id(node) for node in range(len(parser.nodes)) if parser.type_of(node) == "BSDF" and parser.id(node)]
    for shape in parser.of_type("Shape"):
        inline = [node for node in parser.references(shape) if parser.type_of(node) == "BSDF"]
        names += [parser.names[shape] for node in inline if not parser.id(node)]
    for name in materials:
        if name not in names:
            near = ", ".join(difflib.get_close_matches(name, names, 5, 0.4) or names[:8]) or "none"
            raise ValueError(f"animation materials: the scene {parser.path} has no material {name!r}; near: {near}.")


def _make_primitive(shape: Mapping[str, Any], pose: np.ndarray) -> dict[str, Any]:
    """An inserted shape as Mitsuba's dict: its own primitive, centred, scaled to its box, posed."""
    import mitsuba as mi

    kind, size = shape["type"], read_extents(shape)
    place = np.eye(4)
    if kind == "cylinder":  # Mitsuba's has radius 1 and runs from z = 0 to 1
        place[2, 3] = -0.5
        size = size * (0.5, 0.5, 1.0)
    else:  # the others reach from -1 to 1
        size = size * 0.5
    own: dict[str, Any] = {"type": kind}
    if kind == "sphere":
        own["radius"] = float(size[0])
    else:
        place = np.diag([*size, 1.0]) @ place
    own["to_world"] = mi.ScalarTransform4d(pose @ place)
    bsdf = shape.get("bsdf")
    if bsdf is None:
        color = {"type": "rgb", "value": shape.get("color", (0.5, 0.5, 0.5))}
        if "roughness" in shape or "metallic" in shape:
            gloss = {"roughness": float(shape.get("roughness", 0.5)), "metallic": float(shape.get("metallic", 0.0))}
            inner: dict[str, Any] = {"type": "principled", "base_color": color, **gloss}
        else:
            inner = {"type": "diffuse", "reflectance": color}
        bsdf = {"type": "twosided", "nested": inner}
    own["bsdf"] = _make_plugin(bsdf)
    if "emission" in shape:
        own["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": shape["emission"]}}
    return own


def _make_plugin(value: Any) -> Any:
    """A parameter of an inserted shape's material as Mitsuba's dict: three numbers are a colour."""
    if isinstance(value, Mapping):
        plain = value.get("type") in ("rgb", "spectrum")
        return {key: part if plain else _make_plugin(part) for key, part in value.items()}
    return {"type": "rgb", "value": value} if isinstance(value, list | tuple) else value
