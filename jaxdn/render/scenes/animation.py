"""Animation files: keys for the camera, keys for shapes, and shapes to insert into a static scene.

One JSON object next to the scene file; every part is optional:

    {"frames": 16,
     "camera": [{"frame": 0, "origin": [0, 1, 5], "target": [0, 1, 0], "fov": 40}, {"frame": 15, ...}],
     "shapes": {"ShortBox": {"pivot": [0.3, 0.3, 0.4],
                             "keys": [{"frame": 0}, {"frame": 15, "translation": [0.2, 0, 0],
                                                     "axis": [0, 1, 0], "angle": 90}]}},
     "inserted": [{"id": "ball", "type": "sphere", "size": 0.4, "color": [0.8, 0.2, 0.1], "roughness": 0.3,
                   "keys": [{"frame": 0, "translation": [0, 0.2, 1]}, ...]}],
     "lights": {"lamp": [{"frame": 0, "scale": 1}, {"frame": 8, "scale": 0}]},
     "materials": {"Oak": {"hue": 120, "saturation": 1.5, "tint": [1, 0.8, 0.6], "roughness": 0.3}},
     "lens": {"aperture_radius": 0.05, "focus_distance": 2.5}, "shutter": 0.5,
     "fog": {"density": 0.1, "albedo": [0.9, 0.9, 0.95]}}

Camera keys have ``origin``, ``target``, ``up`` or a rigid camera-to-world ``matrix``, and ``fov``, the horizontal
field of view in degrees. A shape's keys move it from its place in the scene file: a rotation about its ``pivot``,
then a translation. An inserted shape is a sphere, cube, cylinder (along z) or rectangle (facing +z) that fills a box of
``size`` (one number or its extents) around the origin; its keys place it. Between keys, positions are interpolated
linearly, rotations about one axis linearly in the angle, other rotations spherically; before the first and after the
last key nothing moves. ``lights`` names emitters, or shapes that emit, and scales their radiance: by one number, or by
three for red, green and blue. ``materials`` names BSDFs, or shapes whose BSDF has no id, and changes their colours and
roughness for the whole clip (:func:`jaxdn.render.scenes.material_overrides.override_materials` has the formula).
``lens``, ``shutter`` and ``fog`` are described in :mod:`jaxdn.render.scenes.optics`.
"""

import difflib
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.render.scenes import optics

PRIMITIVES = ("sphere", "cube", "cylinder", "rectangle")
_TOP = ("frames", "camera", "shapes", "inserted", "lights", "materials", *optics.ENTRIES)
_LOOK = ("origin", "target", "up")
_RIGID = ("frame", "translation", "axis", "angle")
_MATERIAL = ("hue", "saturation", "tint", "roughness")
_INSERTED = ("id", "type", "size", "color", "roughness", "metallic", "bsdf", "emission", "keys")


class RigidKeys:
    """The rigid motion that a list of keys describes."""

    def __init__(self, keys: Sequence[Mapping[str, Any]], pivot: np.ndarray) -> None:
        self.frames = np.array([float(key["frame"]) for key in keys])
        self.translations = np.array([key.get("translation", (0.0, 0.0, 0.0)) for key in keys], float)
        self.axes = np.array([_unit(key.get("axis", (0.0, 1.0, 0.0))) for key in keys])
        self.angles = np.array([float(key.get("angle", 0.0)) for key in keys])
        self.pivot = pivot

    def __call__(self, frame: float) -> np.ndarray:
        """[4, 4] float64: rotate about the pivot, then translate."""
        first, second, share = _between(self.frames, frame)
        # No rotation has any axis: it takes that of the other key, so that 0 to 720 degrees are two full turns.
        one, other = (self.axes[key if self.angles[key] else far] for key, far in ((first, second), (second, first)))
        if np.allclose(one, other):
            angle = _mix(self.angles[first], self.angles[second], share)
            rotation = make_rotation(one, angle)
        else:
            ends = [make_rotation(self.axes[end], self.angles[end]) for end in (first, second)]
            rotation = slerp(ends[0], ends[1], share)
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        translation = _mix(self.translations[first], self.translations[second], share)
        matrix[:3, 3] = translation + self.pivot - rotation @ self.pivot
        return matrix


class CameraKeys:
    """The camera path that a list of keys describes."""

    def __init__(self, keys: Sequence[Mapping[str, Any]]) -> None:
        self.keys = keys
        self.frames = np.array([float(key["frame"]) for key in keys])

    def __call__(self, frame: float) -> np.ndarray:
        """[4, 4] float64 camera to world."""
        first, second, share = _between(self.frames, frame)
        one, other = self.keys[first], self.keys[second]
        if "matrix" in one:
            ends = [np.array(key["matrix"], float).reshape(4, 4) for key in (one, other)]
            matrix = np.eye(4)
            matrix[:3, :3] = slerp(ends[0][:3, :3], ends[1][:3, :3], share)
            matrix[:3, 3] = _mix(ends[0][:3, 3], ends[1][:3, 3], share)
            return matrix
        origin, target, up = (
            _mix(np.array(one.get(name, (0, 1, 0)), float), np.array(other.get(name, (0, 1, 0)), float), share)
            for name in _LOOK
        )
        return look_at(origin, target, up)

    def fov(self, frame: float) -> float | None:
        """Horizontal field of view in degrees; None if only the scene file gives it."""
        if "fov" not in self.keys[0]:
            return None
        return float(np.interp(frame, self.frames, [key["fov"] for key in self.keys]))


def interpolate_light_scale(keys: Sequence[Mapping[str, Any]], frame: float) -> float | tuple[float, ...]:
    """The factor on a light's radiance at one time: a number, or three if they differ."""
    scales = [np.broadcast_to(np.array(key["scale"], float), 3) for key in keys]
    first, second, share = _between(np.array([key["frame"] for key in keys], float), frame)
    red, green, blue = (float(value) for value in _mix(scales[first], scales[second], share))
    return red if red == green == blue else (red, green, blue)


def look_at(origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Camera to world in Mitsuba's convention: +z towards the target, +x to the left; ValueError if undefined."""
    forward = target - origin
    left = np.cross(up, forward)
    if np.linalg.norm(left) <= 1e-9 * (1 + np.linalg.norm(forward)):
        raise ValueError(
            f"animation camera: expected a target away from the origin and off the up direction, got origin "
            f"{origin.tolist()}, target {target.tolist()}, up {up.tolist()}; move one of them."
        )
    forward, left = forward / np.linalg.norm(forward), left / np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([left, np.cross(forward, left), forward], axis=1)
    matrix[:3, 3] = origin
    return matrix


def make_rotation(axis: np.ndarray, degrees: float) -> np.ndarray:
    """[3, 3] right-handed rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def slerp(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """Spherical interpolation of two rotations at ``share``: first (first^T second)^share."""
    if np.array_equal(first, second):  # exact: rounding must not turn a static shape
        return first
    between = first.T @ second
    cosine = np.clip((np.trace(between) - 1) / 2, -1.0, 1.0)
    angle = np.arccos(cosine)
    if angle < 1e-9:
        return first
    # The axis is the eigenvector of eigenvalue 1; at half a turn the antisymmetric part vanishes, this does not.
    values, vectors = np.linalg.eigh(between + between.T)
    axis = vectors[:, np.argmax(values)]
    twist = np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    if twist @ axis < 0:
        axis = -axis
    return first @ make_rotation(axis, float(np.degrees(angle)) * share)


def read_animation(path: Path) -> dict[str, Any]:
    """The JSON object of an animation file; raises ValueError if it is not one (NaN is not JSON)."""

    def refuse(word: str) -> float:
        raise ValueError(f"expected finite numbers, got {word}")

    try:
        animation = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"animation {path}: expected JSON, got something else ({error}).") from error
    return animation


def check_animation(animation: Any, shape_ids: Iterable[str], *, has_camera: bool = True) -> None:
    """Raise ValueError with the place of the error unless ``animation`` fits a scene with these shapes.

    Whether its lights are lights of the scene is checked when the scene is loaded.
    """
    ids = list(shape_ids)
    _known(animation, _TOP, "animation")
    frames = animation.get("frames", 1)
    if isinstance(frames, bool) or not isinstance(frames, int) or frames < 1:
        raise ValueError(f"animation frames: expected a whole number >= 1, got {frames!r}.")
    if "camera" in animation:
        _check_camera(animation["camera"], has_camera)
    shapes = animation.get("shapes", {})
    if not isinstance(shapes, Mapping):
        raise ValueError(f"animation shapes: expected an object of shape id to keys, got {shapes!r}.")
    for name, motion in shapes.items():
        if name not in ids:
            near = difflib.get_close_matches(name, ids, 5, 0.4) or ids[:8]
            raise ValueError(f"animation shapes: the scene has no shape {name!r}; near: {', '.join(near) or 'none'}.")
        place = f"animation shapes {name!r}"
        _known(motion, ("pivot", "keys"), place)
        _numbers(motion.get("pivot", (0, 0, 0)), 3, f"{place} pivot")
        _check_rigid(motion.get("keys"), place)
    inserted = animation.get("inserted", [])
    if not isinstance(inserted, list):
        raise ValueError(f"animation inserted: expected a list of shapes, got {inserted!r}.")
    for index, shape in enumerate(inserted):
        place = f"animation inserted[{index}]"
        _known(shape, _INSERTED, place)
        name = shape.get("id")
        if not isinstance(name, str) or not name or name in ids:
            raise ValueError(
                f"{place} id: expected a new name for the shape, got {name!r}; the scene has it or it is none."
            )
        ids.append(name)
        _check_inserted(shape, place)
    lights = animation.get("lights", {})
    if not isinstance(lights, Mapping):
        raise ValueError(f"animation lights: expected an object of light to keys, got {lights!r}.")
    for name, keys in lights.items():
        _check_frames(keys, f"animation lights {name!r}")
        for index, key in enumerate(keys):
            at = f"animation lights {name!r}[{index}]"
            _known(key, ("frame", "scale"), at)
            scale = key.get("scale")
            colored = isinstance(scale, Sequence)
            if (_numbers(scale if colored else [scale], 3 if colored else 1, f"{at} scale") < 0).any():
                raise ValueError(f"{at} scale: expected a factor >= 0, got {scale!r}.")
    _check_materials(animation.get("materials", {}))
    optics.read_optics(animation, "animation")


def _check_materials(materials: Any) -> None:
    if not isinstance(materials, Mapping):
        raise ValueError(f"animation materials: expected an object of material to changes, got {materials!r}.")
    for name, changes in materials.items():
        place = f"animation materials {name!r}"
        _known(changes, _MATERIAL, place)
        for key, value in changes.items():
            values = _numbers(value if key == "tint" else [value], 3 if key == "tint" else 1, f"{place} {key}")
            if key != "hue" and (values < 0).any():
                raise ValueError(f"{place} {key}: expected no number below 0, got {value!r}.")
            if key in ("tint", "roughness") and (values > 1).any():
                raise ValueError(f"{place} {key}: expected no number above 1, got {value!r}.")


def _check_camera(keys: Any, has_camera: bool) -> None:
    place = "animation camera"
    _check_frames(keys, place)
    for index, key in enumerate(keys):
        at = f"{place}[{index}]"
        if ("matrix" in key) != ("matrix" in keys[0]) or ("fov" in key) != ("fov" in keys[0]):
            raise ValueError(f"{at}: expected the same kind of key as the first (matrix or origin and target; fov).")
        _known(key, ("frame", "fov", *(("matrix",) if "matrix" in key else _LOOK)), at)
        if "matrix" in key:
            matrix = _numbers(np.ravel(np.array(key["matrix"], object)).tolist(), 16, f"{at} matrix").reshape(4, 4)
            rotation = matrix[:3, :3]
            if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) or not np.allclose(matrix[3], (0, 0, 0, 1)):
                raise ValueError(f"{at} matrix: expected a rotation and a translation, got {matrix.tolist()}.")
        else:
            for name in _LOOK[:2]:
                _numbers(key.get(name), 3, f"{at} {name}")
            _numbers(key.get("up", (0, 1, 0)), 3, f"{at} up")
            CameraKeys([key])(0.0)
        if "fov" in key and not 0 < _numbers([key["fov"]], 1, f"{at} fov")[0] < 180:
            raise ValueError(f"{at} fov: expected degrees between 0 and 180, got {key['fov']!r}.")
        if "fov" not in key and not has_camera:
            raise ValueError(f"{at}: expected a fov, as the scene file has no perspective sensor to take it from.")


def _check_rigid(keys: Any, place: str) -> None:
    _check_frames(keys, place)
    for index, key in enumerate(keys):
        at = f"{place} keys[{index}]"
        _known(key, _RIGID, at)
        _numbers(key.get("translation", (0, 0, 0)), 3, f"{at} translation")
        _numbers([key.get("angle", 0)], 1, f"{at} angle")
        axis = _numbers(key.get("axis", (0, 1, 0)), 3, f"{at} axis")
        if np.linalg.norm(axis) < 1e-9:
            raise ValueError(f"{at} axis: expected a direction, got {key['axis']!r}.")


def _check_inserted(shape: Mapping[str, Any], place: str) -> None:
    kind = shape.get("type")
    if kind not in PRIMITIVES:
        raise ValueError(f"{place} type: expected one of {', '.join(PRIMITIVES)}, got {kind!r}.")
    size = read_extents(shape, place)
    if not (size > 0).all() or (kind == "sphere" and np.ptp(size) > 0):
        raise ValueError(f"{place} size: expected extents > 0 (for a sphere all the same), got {shape.get('size')!r}.")
    for name, top in (("color", 1.0), ("emission", np.inf)):
        if name in shape:
            values = _numbers(shape[name], 3, f"{place} {name}")
            if not ((values >= 0) & (values <= top)).all():
                raise ValueError(f"{place} {name}: expected three numbers from 0 to {top:g}, got {shape[name]!r}.")
    for name in ("roughness", "metallic"):
        if name in shape and not 0 <= _numbers([shape[name]], 1, f"{place} {name}")[0] <= 1:
            raise ValueError(f"{place} {name}: expected a number from 0 to 1, got {shape[name]!r}.")
    if "bsdf" in shape:
        if not isinstance(shape["bsdf"], Mapping) or "type" not in shape["bsdf"]:
            raise ValueError(f"{place} bsdf: expected an object with a type, got {shape['bsdf']!r}.")
        if {"color", "roughness", "metallic"} & set(shape):
            raise ValueError(f"{place}: expected either a bsdf or a color with roughness and metallic, got both.")
    _check_rigid(shape.get("keys", [{"frame": 0}]), place)


def read_extents(shape: Mapping[str, Any], place: str = "size") -> np.ndarray:
    """[3] extents of an inserted shape; a rectangle's third is 1."""
    size = shape.get("size", 1.0)
    if isinstance(size, int | float) and not isinstance(size, bool):
        return np.repeat(_numbers([size], 1, place), 3)
    if shape.get("type") == "rectangle":
        return np.append(_numbers(size, 2, f"{place} size"), 1.0)
    return _numbers(size, 3, f"{place} size")


def _check_frames(keys: Any, place: str) -> None:
    if not isinstance(keys, list) or not keys:
        raise ValueError(f"{place}: expected a list of at least one key, got {keys!r}.")
    last = -np.inf
    for index, key in enumerate(keys):
        if not isinstance(key, Mapping) or "frame" not in key:
            raise ValueError(f"{place}[{index}]: expected an object with a frame, got {key!r}.")
        frame = _numbers([key["frame"]], 1, f"{place}[{index}] frame")[0]
        if frame <= last:
            raise ValueError(
                f"{place}[{index}] frame: expected a later one than {last:g}, got {frame:g}; sort the keys."
            )
        last = frame


def _known(value: Any, names: Sequence[str], place: str) -> None:
    if not isinstance(value, Mapping):
        raise ValueError(f"{place}: expected an object, got {value!r}.")
    for name in value:
        if name not in names:
            raise ValueError(f"{place}: unknown key {name!r}; expected some of {', '.join(names)}.")


def _numbers(value: Any, count: int, place: str) -> np.ndarray:
    valid = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == count
    # Compared and not asked whether it is finite: a whole number may be larger than any float.
    if not valid or not all(
        isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= sys.float_info.max for x in value
    ):
        raise ValueError(f"{place}: expected {count} finite number{'s' * (count > 1)}, got {value!r}.")
    return np.array(value, float)


def _mix(first: Any, second: Any, share: float) -> Any:
    """Linear interpolation, exact where both are equal, so that resting objects do not jitter."""
    return first + share * (second - first)


def _unit(axis: Any) -> np.ndarray:
    vector = np.array(axis, float)
    return vector / np.linalg.norm(vector)


def _between(frames: np.ndarray, frame: float) -> tuple[int, int, float]:
    """The keys before and after a frame and the share of the later one."""
    after = int(np.searchsorted(frames, frame, side="right"))
    if after == 0:
        return 0, 0, 0.0
    if after == len(frames):
        return len(frames) - 1, len(frames) - 1, 0.0
    return after - 1, after, float((frame - frames[after - 1]) / (frames[after] - frames[after - 1]))
