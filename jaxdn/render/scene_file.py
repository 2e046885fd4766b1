"""Animated Mitsuba scene files: any scene XML, with an animation file of keys next to it.

Mitsuba's own loader is used: static parts are loaded once; for every frame an edited part of the XML (a new camera, the
moving shapes with a matrix appended to their transform, inserted shapes) is loaded in addition. Scenes of the 0.6
format keep that format, so that Mitsuba upgrades them as it would the file.
"""

import copy
import difflib
import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.render.animation import (
    CameraKeys,
    RigidKeys,
    check_animation,
    extents,
    light_scale,
    read_animation,
)
from jaxdn.render.scene import Camera
from jaxdn.render.variant import use_variant

_DEPTH = 8
"""Path length if the file has unlimited paths or does not specify it."""
_TEXTURES = ("bitmap", "checkerboard", "mesh_attribute", "volume")


class SceneFile:
    """A Mitsuba 3 scene file as an animated scene; see :mod:`jaxdn.render.animation` for the JSON file.

    Without ``animation_path`` the file ``<scene>.json`` next to the scene is used if there is one, and a scene without
    an animation is static. Shapes without an id get ``shape_<n>``, counted from 0 in the order of the file, and a dot
    in an id becomes an underscore. The camera is the file's first sensor, which must be a perspective one; its
    horizontal field of view is that of the file's own film at every image size. Raises ValueError for files
    that cannot be read and animations that do not match the scene.
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
        self._tree = _read_xml(path)
        _absolute_files(self._tree, path)
        self._shapes = _name_shapes(self._tree)
        self._rest, self.near, self._far = _rest_camera(self._tree)
        check_animation(animation, self._shapes, has_camera=self._rest is not None)
        if self._rest is None and "camera" not in animation:
            raise ValueError(
                f"scene {path}: expected a perspective sensor or an animation with camera keys, got neither."
            )
        self.name = self.name_of(path)
        self.frames = int(animation.get("frames", 1))
        self.max_depth = _path_length(self._tree)
        near = os.path.relpath(path)
        self.record = {"file": path.resolve().as_posix() if near.startswith("..") else near, "animation": animation}
        self._camera = CameraKeys(animation["camera"]) if "camera" in animation else None
        self._motions = {
            name: RigidKeys(motion["keys"], np.array(motion.get("pivot", (0, 0, 0)), float))
            for name, motion in animation.get("shapes", {}).items()
        }
        self._inserted = {shape["id"]: shape for shape in animation.get("inserted", [])}
        for name, shape in self._inserted.items():
            self._motions[name] = RigidKeys(shape.get("keys", [{"frame": 0}]), np.zeros(3))
        self._lights = animation.get("lights", {})
        _check_lights(self._tree, self._lights, path)
        self._materials = animation.get("materials", {})
        _check_materials(self._tree, self._materials, path)
        self._still: tuple[str, list[Any]] | None = None

    def camera(self, frame: float) -> Camera:
        """The camera of one frame."""
        fov = None if self._camera is None else self._camera.fov(frame)
        if self._camera is None:
            assert self._rest is not None
            return self._rest
        if fov is None:
            assert self._rest is not None
            fov = self._rest.x_fov
        return Camera(self._camera(frame), fov)

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        """Shape id -> [4, 4] motion by the keys, from the shape's place in the file."""
        return {name: motion(frame) for name, motion in self._motions.items()}

    def brightness(self, frame: float) -> dict[str, float | tuple[float, ...]]:
        """Light -> factor on its radiance, one or three for red, green and blue, for lights with keys."""
        return {name: light_scale(keys, frame) for name, keys in self._lights.items()}

    def lights(self) -> dict[str, bool]:
        """The lights whose radiance keys can scale -> whether they can scale red, green and blue by themselves."""
        found = {element.get("id", ""): _light(self._tree, element.get("id", "")) for element in self._tree}
        known = {name: _powers(light) for name, light in found.items() if name and light is not None}
        return {name: all(part.tag == "rgb" for part in parts) for name, parts in known.items() if parts}

    def build(self, frame: float, width: int, height: int) -> Any:
        """The ``mi.Scene`` of one frame; static parts are loaded once and shared by all frames."""
        import mitsuba as mi

        from jaxdn.render.plugins import shape_groups
        from jaxdn.render.repaint import repaint

        variant = str(mi.variant())
        if self._still is None or self._still[0] != variant:
            rests = _kept(self._tree, lambda element: element.get("id") not in {*self._motions, *self._lights})
            still = _load(rests)
            repaint(still, self._materials)
            # Groups are kept for inspection: instances do not show their contents.
            self._still = variant, [*still.shapes(), *shape_groups(still), *_lamps(still)]
        moving = _load(self.describe(frame, width, height))
        repaint(moving, self._materials)
        fresh = [*moving.shapes(), *shape_groups(moving), *_lamps(moving)]
        parts = {part.id(): part for part in [*self._still[1], *fresh]}
        parts |= {"animation_sensor": moving.sensors()[0], "animation_integrator": moving.integrator()}
        # A key of this dictionary becomes the object's id.
        return mi.load_dict({"type": "scene", **parts}, optimize=False)

    def describe(self, frame: float, width: int, height: int) -> ET.Element:
        """The XML of the parts that change per frame: camera, film and moving shapes."""
        poses = self.pose(frame)
        changing = {*poses, *self._lights}
        scene = copy.deepcopy(_kept(self._tree, lambda element: element.get("id") in changing))
        for name, factor in self.brightness(frame).items():
            _scale_light(_light(scene, name), np.broadcast_to(factor, 3))
        for element in scene.findall("shape"):
            if element.get("id") not in poses:
                continue
            transform = _transform(element)
            if transform is None:
                transform = ET.SubElement(element, "transform", name="to_world")
            ET.SubElement(transform, "matrix", value=_matrix(poses[element.get("id", "")]))
        for name, shape in self._inserted.items():
            scene.append(_primitive(shape, poses[name]))
        ET.SubElement(scene, "integrator", type="path").append(_value("max_depth", self.max_depth))
        camera = self.camera(frame)
        sensor = ET.SubElement(scene, "sensor", type="perspective")
        for key, value in {"fov": camera.x_fov, "near_clip": self.near, "far_clip": self._far}.items():
            sensor.append(_value(key, float(value)))
        sensor.append(_value("fov_axis", "x"))
        to_world = ET.SubElement(sensor, "transform", name="to_world")
        ET.SubElement(to_world, "matrix", value=_matrix(camera.to_world))
        ET.SubElement(sensor, "sampler", type="independent")
        film = ET.SubElement(sensor, "film", type="hdrfilm")
        settings = {"width": width, "height": height, "pixel_format": "rgb", "component_format": "float32"}
        for key, setting in settings.items():
            film.append(_value(key, setting))
        ET.SubElement(film, "rfilter", type="box")
        return scene


def _load(root: ET.Element) -> Any:
    import mitsuba as mi

    if mi.variant() is None:  # a variant may not have been chosen yet
        use_variant()
    return mi.load_string(ET.tostring(root, encoding="unicode"), optimize=False)


def _lamps(scene: Any) -> list[Any]:
    """The emitters of a loaded scene that are not shapes."""
    return [emitter for emitter in scene.emitters() if emitter.get_shape() is None]


def _kept(root: ET.Element, wanted: Callable[[ET.Element], bool]) -> ET.Element:
    """The scene with the chosen top-level shapes and lamps, and what they refer to."""
    named = {element.get("id"): element for element in root if element.get("id")}
    chosen = [element for element in root if element.tag in ("shape", "emitter") and wanted(element)]
    needed = set(map(id, chosen))
    while chosen:
        for reference in chosen.pop().iter("ref"):
            target = named.get(reference.get("id"))
            if target is not None and id(target) not in needed:
                needed.add(id(target))
                chosen.append(target)
    kept = ET.Element("scene", root.attrib)
    kept.extend([element for element in root if element.tag == "default" or id(element) in needed])
    return kept


def _read_xml(path: Path) -> ET.Element:
    """The scene's root with every ``<include>`` expanded."""
    try:
        root = ET.parse(path).getroot()
    except (OSError, ET.ParseError) as error:
        raise ValueError(f"scene {path}: expected a Mitsuba scene (XML), could not read it: {error}.") from error
    if root.tag != "scene":
        raise ValueError(f"scene {path}: expected <scene> as the outermost element, got <{root.tag}>.")
    for parent in list(root.iter()):
        for index, child in reversed(list(enumerate(parent))):
            if child.tag == "include":
                included = _read_xml(path.parent / child.get("filename", ""))
                parent.remove(child)
                for offset, element in enumerate(included):
                    parent.insert(index + offset, element)
    return root


def _absolute_files(root: ET.Element, path: Path) -> None:
    """Make the names of the files that the scene uses absolute; raises ValueError for a missing one."""
    folders = [path.parent, *(path.parent / element.get("value", "") for element in root.findall("path"))]
    for element in root.iter("string"):
        name = element.get("value", "")
        if element.get("name") != "filename" or "$" in name:
            continue
        found = [folder / name for folder in folders if (folder / name).is_file()]
        if not found:
            raise ValueError(f"scene {path}: it uses the file {name!r}, which is not there; put it next to the scene.")
        element.set("value", str(found[0].resolve()))


def _name_shapes(root: ET.Element) -> list[str]:
    """The ids of the top-level shapes, after adding the missing ones, also those of emitters."""
    taken = {element.get("id") for element in root.iter() if element.get("id")}
    for index, element in enumerate(root.findall("shape")):
        name = element.get("id") or f"shape_{index}"
        while element.get("id") is None and name in taken:
            name += "_"
        element.set("id", name if element.get("type") == "shapegroup" else name.replace(".", "_"))
    for index, element in enumerate(root.findall("emitter")):
        if element.get("id") is None and f"light_{index}" not in taken:
            element.set("id", f"light_{index}")
    return [element.get("id", "") for element in root.findall("shape") if element.get("type") != "shapegroup"]


def _rest_camera(root: ET.Element) -> tuple[Camera | None, float, float]:
    """The file's own camera with its near and far clip, read by Mitsuba; None where the file has no sensor."""
    sensor = root.find("sensor")
    if sensor is None:
        return None, 1e-2, 1e4
    if sensor.get("type") != "perspective":
        raise ValueError(f"scene sensor: expected a perspective one, got {sensor.get('type')!r}; change its type.")
    import mitsuba as mi

    alone = ET.Element("scene", root.attrib)
    alone.extend([*root.findall("default"), sensor])
    loaded = _load(alone).sensors()[0]
    values = mi.traverse(loaded)
    offset = [float(np.ravel(np.array(values[f"principal_point_offset_{axis}"]))[0]) for axis in "xy"]
    if any(offset):
        raise ValueError(f"scene sensor: expected no principal point offset, got {offset}; remove it.")
    fov, near, far = (float(np.ravel(np.array(values[key]))[0]) for key in ("x_fov", "near_clip", "far_clip"))
    matrix = np.array(loaded.world_transform().matrix, np.float64).reshape(4, 4)
    return Camera(matrix, fov), near, far


def _path_length(root: ET.Element) -> int:
    """max_depth of the file's integrator, also if nested."""
    integrator = root.find("integrator")
    if integrator is not None:
        for element in integrator.iter("integer"):
            value = element.get("value", "")
            if element.get("name") in ("max_depth", "maxDepth") and value.isdigit() and int(value) > 0:
                return int(value)
    return _DEPTH


def _light(root: ET.Element, name: str) -> ET.Element | None:
    """The emitter of this name, or the one of the shape of this name."""
    for element in root:
        if element.get("id") == name:
            return element if element.tag == "emitter" else element.find("emitter")
    return None


def _check_lights(root: ET.Element, keys: Mapping[str, Any], path: Path) -> None:
    """Raise ValueError for a name that is not a light of the scene, or a light whose radiance is not a number."""
    for name in keys:
        emitter = _light(root, name)
        if emitter is None:
            ids = [element.get("id", "") for element in root]
            lights = ", ".join(one for one in ids if one and _light(root, one) is not None) or "none with an id"
            raise ValueError(f"animation lights: the scene {path} has no light {name!r}; it has {lights}.")
        if not _powers(emitter) and emitter.get("type") != "envmap":
            raise ValueError(f"animation lights: {name!r} has no colour or number to scale; give it one in the scene.")
        colored = any(np.ptp(np.broadcast_to(key["scale"], 3)) > 0 for key in keys[name])
        if colored and (not _powers(emitter) or any(part.tag != "rgb" for part in _powers(emitter))):
            raise ValueError(
                f"animation lights: {name!r} is not given in red, green and blue; expected one number as its scale."
            )


def _check_materials(root: ET.Element, materials: Mapping[str, Any], path: Path) -> None:
    """Raise ValueError for a name that is neither a BSDF of the scene nor a shape with one of its own."""
    inline = [shape.get("id", "") for shape in root.findall("shape") if shape.find("bsdf") is not None]
    names = [element.get("id", "") for element in root.iter("bsdf") if element.get("id")] + inline
    for name in materials:
        if name not in names:
            near = ", ".join(difflib.get_close_matches(name, names, 5, 0.4) or names[:8]) or "none"
            raise ValueError(f"animation materials: the scene {path} has no material {name!r}; near: {near}.")


def _powers(emitter: ET.Element) -> list[ET.Element]:
    """The elements that define an emitter's brightness."""
    names = ("radiance", "intensity", "irradiance", "power")
    return [part for part in emitter if part.get("name") in names and part.tag in ("rgb", "spectrum", "float")]


def _scale_light(emitter: ET.Element | None, factors: np.ndarray) -> None:
    """Multiply an emitter's brightness by three factors, which are equal for one that is not red, green and blue."""
    assert emitter is not None  # _check_lights has checked it
    if emitter.get("type") == "envmap":
        own = next((part for part in emitter if part.get("name") == "scale"), None)
        if own is None:
            own = ET.SubElement(emitter, "float", name="scale", value="1")
        own.set("value", repr(float(own.get("value", "1")) * float(factors[0])))
    for part in _powers(emitter):
        numbers = part.get("value", "0").replace(",", " ").split()
        if part.tag == "rgb":
            values = np.broadcast_to([float(number) for number in numbers], 3) * factors
            part.set("value", " ".join(repr(float(value)) for value in values))
            continue
        # "wavelength:value" pairs of a spectrum scale in their values.
        pairs = [number.rpartition(":") for number in numbers]
        part.set(
            "value", " ".join(f"{head}{colon}{float(value) * float(factors[0])!r}" for head, colon, value in pairs)
        )


def _transform(shape: ET.Element) -> ET.Element | None:
    for element in shape.findall("transform"):
        if element.get("name") in ("to_world", "toWorld"):
            return element
    return None


def _matrix(matrix: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(matrix))


def _value(name: str, value: Any) -> ET.Element:
    """One parameter of a plugin as XML: numbers, truth values, strings, colours and nested plugins."""
    if isinstance(value, Mapping):
        if value.get("type") in ("rgb", "spectrum") and "value" in value:
            return ET.Element(value["type"], name=name, value=" ".join(map(str, np.ravel(value["value"]))))
        element = ET.Element(
            "texture" if value.get("type") in _TEXTURES else "bsdf", name=name, type=str(value["type"])
        )
        element.extend(_value(key, part) for key, part in value.items() if key != "type")
        return element
    if isinstance(value, bool):
        return ET.Element("boolean", name=name, value=str(value).lower())
    if isinstance(value, int | float):
        return ET.Element("integer" if isinstance(value, int) else "float", name=name, value=repr(value))
    if isinstance(value, str):
        return ET.Element("string", name=name, value=value)
    return ET.Element("rgb", name=name, value=" ".join(map(str, value)))


def _primitive(shape: Mapping[str, Any], pose: np.ndarray) -> ET.Element:
    """An inserted shape: Mitsuba's own primitive, centred, scaled to its box, posed."""
    kind = shape["type"]
    element = ET.Element("shape", type=kind, id=shape["id"])
    transform = ET.SubElement(element, "transform", name="to_world")
    size = extents(shape)
    if kind == "cylinder":  # Mitsuba's has radius 1 and runs from z = 0 to 1
        ET.SubElement(transform, "translate", z="-0.5")
        size = size * (0.5, 0.5, 1.0)
    else:  # the others reach from -1 to 1
        size = size * 0.5
    if kind == "sphere":
        element.append(_value("radius", float(size[0])))
    else:
        ET.SubElement(transform, "scale", x=repr(float(size[0])), y=repr(float(size[1])), z=repr(float(size[2])))
    ET.SubElement(transform, "matrix", value=_matrix(pose))
    bsdf = shape.get("bsdf")
    if bsdf is None:
        color = {"type": "rgb", "value": shape.get("color", (0.5, 0.5, 0.5))}
        if "roughness" in shape or "metallic" in shape:
            gloss = {"roughness": float(shape.get("roughness", 0.5)), "metallic": float(shape.get("metallic", 0.0))}
            inner: dict[str, Any] = {"type": "principled", "base_color": color, **gloss}
        else:
            inner = {"type": "diffuse", "reflectance": color}
        bsdf = {"type": "twosided", "nested": inner}
    element.append(_value("bsdf", bsdf))
    if "emission" in shape:
        emitter = ET.SubElement(element, "emitter", type="area")
        emitter.append(_value("radiance", {"type": "rgb", "value": shape["emission"]}))
    return element
