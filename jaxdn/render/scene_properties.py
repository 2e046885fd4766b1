"""Read the properties of an animated scene: its surfaces and lights, and what moves between which frames.

The scene is built once, for its first frame; later changes are read from its poses, its camera and its lights'
brightness.
"""

import itertools
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from jaxdn.core.checks import check_at_least
from jaxdn.planning.scene_properties import Light, Moment, SceneProperties, Surface
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.scene import AnimatedScene, Camera, brightness

_LOOK = 16
"""Height of the inspected image, in pixels."""
_NEAR = 1e-6


def read_scene_properties(
    scene: AnimatedScene, *, width: int, height: int, frames: int | None = None
) -> SceneProperties:
    """Properties of the first ``frames`` frames (default: all) of an animated scene, seen at ``width`` x ``height``.

    Raises ValueError for a size or a number of frames below 1.
    """
    count = scene.frames if frames is None else frames
    check_at_least(1, width=width, height=height, frames=count)
    use_variant()
    # Mitsuba's names exist only after a variant is chosen.
    from jaxdn.render.buffers.gbuffer import list_shape_names, trace_gbuffer

    # A small image of the same aspect ratio is enough to see whether rays leave the scene.
    built = scene.build(0, max(1, round(_LOOK * width / height)), _LOOK)
    shapes = dict(zip(list_shape_names(built), built.shapes(), strict=True))
    surfaces, uncertain = _list_surfaces(built, shapes)
    lights = _list_lights(built, shapes)
    around = frozenset(light.name for light in lights if light.environment)
    if around and not np.any(trace_gbuffer(built).ids < 0):
        uncertain["emission"] = "the environment is not seen in a small image of frame 0, but may be later"
        around = frozenset()

    stage = _ShapePlaces(scene, shapes, (height, width), around)
    return SceneProperties(
        surfaces=tuple(surfaces),
        lights=tuple(lights),
        moments=tuple(stage.describe_moment(frame, lights) for frame in range(count)),
        medium=_is_in_fog(built.sensors()[0]),
        interreflects=_interreflects(stage, shapes, surfaces, lights),
        max_depth=scene.max_depth,
        uncertain=uncertain,
    )


def _list_surfaces(built: Any, shapes: Mapping[str, Any]) -> tuple[list[Surface], dict[str, str]]:
    """The surfaces of a scene, and effect -> why their materials leave it undecided."""
    from jaxdn.render.scenes.materials import NOTHING, describe_material, is_lambertian
    from jaxdn.render.scenes.media import absorbs, list_media
    from jaxdn.render.scenes.plugins import list_children, list_shape_groups

    grouped = [part for group in list_shape_groups(built) for _, part in list_children(group) if hasattr(part, "bsdf")]
    scattering = {name for name, medium in list_media(built) if not absorbs(medium)}
    surfaces: list[Surface] = []
    uncertain: dict[str, str] = {}
    for name, shape in shapes.items():
        members = grouped if shape.class_name() == "Instance" else [shape]
        materials = [NOTHING if part.bsdf() is None else describe_material(part.bsdf()) for part in members]
        for material in materials:
            uncertain |= {effect: f"{name}: {reason}" for effect, reason in material.unsure.items()}
        if shape.class_name() == "Instance" and not members:
            reason = f"{name}: the contents of an instance could not be read"
            uncertain |= dict.fromkeys(("glossy", "mirror", "transmission", "specular", "texture"), reason)
        lobes = frozenset().union(*(material.lobes for material in materials))
        textured = any(material.textured for material in materials)
        specular = any(part.bsdf() is not None and not is_lambertian(part.bsdf()) for part in members)
        surfaces.append(Surface(name, lobes, textured, shape.id() in scattering, specular))
    return surfaces, uncertain


def _is_in_fog(sensor: Any) -> bool:
    """Whether the camera stands in a medium that scatters light."""
    from jaxdn.render.scenes.media import absorbs

    return sensor.get_medium() is not None and not absorbs(sensor.get_medium())


def _list_lights(built: Any, shapes: Mapping[str, Any]) -> list[Light]:
    """The lights of a scene; one that is a shape has the shape's name."""
    lights: list[Light] = []
    by_id = {shape.id(): name for name, shape in shapes.items()}
    for index, emitter in enumerate(built.emitters()):
        owner = emitter.get_shape()
        name = by_id[owner.id()] if owner is not None else emitter.id() or f"light_{index}"
        lights.append(Light(name, bool(emitter.is_environment())))
    return lights


class _ShapePlaces:
    """Places of the shapes in each frame, relative to the view."""

    def __init__(
        self, scene: AnimatedScene, shapes: Mapping[str, Any], size: tuple[int, int], around: frozenset[str]
    ) -> None:
        self.scene, self.size, self.around = scene, size, around
        self.pose, self.camera = cache(scene.pose), cache(scene.camera)  # an articulated pose takes milliseconds
        self.rest = {name: np.asarray(pose, np.float64) for name, pose in self.pose(0).items()}
        self.boxes: dict[str, np.ndarray] = {}
        self.squares: dict[str, np.ndarray] = {}
        for name, shape in shapes.items():
            box = shape.bbox()
            self.boxes[name] = _corners(np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel())
            if shape.class_name() == "Rectangle":
                self.squares[name] = _read_to_world(shape)

    def compute_place(self, name: str, pose: Mapping[str, np.ndarray]) -> np.ndarray:
        """The motion of a shape since frame 0, for which it was built."""
        return np.asarray(pose[name]) @ np.linalg.inv(self.rest[name]) if name in pose else np.eye(4)

    def on_screen(self, name: str, frame: float) -> bool:
        """Whether a shape's box may be in view."""
        points = _moved(self.boxes[name], self.compute_place(name, self.pose(frame)))
        return _may_be_seen(points, self.camera(frame), self.size)

    def describe_moment(self, frame: int, lights: Sequence[Light]) -> Moment:
        """The changes between a frame and the one before it."""
        emitting = (light.name for light in lights if light.name in self.boxes)
        shining = self.around.union(name for name in emitting if self.on_screen(name, frame))
        if frame == 0:
            return Moment(shining=shining)
        now, before = self.camera(frame), self.camera(frame - 1)
        camera = now.x_fov != before.x_fov or not np.array_equal(now.to_world, before.to_world)
        pose, last = self.pose(frame), self.pose(frame - 1)
        moving = frozenset(name for name in pose if not (name in last and np.array_equal(pose[name], last[name])))
        seen = frozenset(
            name for name in moving if name in self.boxes and any(self.on_screen(name, at) for at in (frame - 1, frame))
        )
        changing = {light.name for light in lights} & moving
        bright, dim = brightness(self.scene, frame), brightness(self.scene, frame - 1)
        changing |= {name for name in bright if bright[name] != dim[name]}
        reveals = (camera or bool(seen)) and not self._shows_one_flat_surface(frame)
        return Moment(camera, moving, seen, reveals, frozenset(changing), shining)

    def _shows_one_flat_surface(self, frame: int) -> bool:
        """One flat surface fills the image now and before: nothing can be disoccluded."""
        there = {name for name in self.boxes for at in (frame - 1, frame) if self.on_screen(name, at)}
        if len(there) != 1 or not there <= set(self.squares):
            return False
        name = there.pop()
        return all(
            _fills_view(self.compute_place(name, self.pose(at)) @ self.squares[name], self.camera(at), self.size)
            for at in (frame - 1, frame)
        )


def _read_to_world(shape: Any) -> np.ndarray:
    import mitsuba as mi

    matrix = mi.traverse(shape)["to_world"].matrix
    return np.array(matrix, np.float64).reshape(4, 4)


def _interreflects(
    stage: _ShapePlaces, shapes: Mapping[str, Any], surfaces: Sequence[Surface], lights: Sequence[Light]
) -> bool:
    """False if the only reflector is flat, or convex and lit and seen from outside."""
    reflecting = [surface for surface in surfaces if surface.lobes]
    if len(reflecting) != 1 or "transmission" in reflecting[0].lobes:
        return True
    name = reflecting[0].name
    kind = shapes[name].class_name()
    if kind in ("Rectangle", "Disk"):
        return False
    # A point light's position is not known here, and a pose may move the shape anywhere.
    placed = all(light.environment or light.name in shapes for light in lights)
    if kind not in ("Sphere", "Cube") or not placed or stage.rest:
        return True
    low, high = stage.boxes[name].min(axis=0), stage.boxes[name].max(axis=0)
    others = [stage.boxes[light.name] for light in lights if light.name in shapes and light.name != name]
    others += [np.asarray(stage.scene.camera(frame).to_world)[None, :3, 3] for frame in range(stage.scene.frames)]
    return any(np.all(box.max(axis=0) >= low) and np.all(box.min(axis=0) <= high) for box in others)


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The eight corners [8, 3] of a box."""
    return np.array([np.where(pick, high, low) for pick in itertools.product((False, True), repeat=3)])


def _moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points [N, 3] under a [4, 4] motion."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def _may_be_seen(points: np.ndarray, camera: Camera, size: tuple[int, int]) -> bool:
    """Whether the convex hull of points [N, 3] may be in the view of ``size`` (height, width).

    False only where all of them lie on the outer side of one of the view's five planes.
    """
    local = _to_camera(points, camera)
    across, up = _slopes(camera, size)
    x, y, z = local.T
    outside = (z <= _NEAR, x > across * z, -x > across * z, y > up * z, -y > up * z)
    return not any(np.all(side) for side in outside)


def _fills_view(to_world: np.ndarray, camera: Camera, size: tuple[int, int]) -> bool:
    """Whether the square [-1, 1]^2 at z = 0, placed by a [4, 4] matrix, covers the whole image.

    It is convex: if the four corners of the image see it, all pixels do.
    """
    across, up = _slopes(camera, size)
    inverse = np.linalg.inv(to_world) @ np.asarray(camera.to_world, np.float64)
    origin = inverse[:3, 3]
    for x, y in ((across, up), (-across, up), (across, -up), (-across, -up)):
        direction = inverse[:3, :3] @ np.array([x, y, 1.0])
        if abs(direction[2]) < 1e-12:
            return False
        distance = -origin[2] / direction[2]
        point = origin + distance * direction
        if distance <= _NEAR or np.any(np.abs(point[:2]) > 1.0):
            return False
    return True


def _to_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    return _moved(points, np.linalg.inv(np.asarray(camera.to_world, np.float64)))


def _slopes(camera: Camera, size: tuple[int, int]) -> tuple[float, float]:
    """Half width and half height of the view at distance 1."""
    across = float(np.tan(np.radians(camera.x_fov) / 2))
    return across, across * size[0] / size[1]
