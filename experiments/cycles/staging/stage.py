"""The scene that is being built: its random numbers, and the ways to put meshes into it and to move them."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Vector

from experiments.cycles.staging.shapes import Mesh

Point = Sequence[float] | np.ndarray


class Stage:
    """An empty scene of ``frames`` frames and the random numbers of its kind and seed."""

    def __init__(self, kind: str, seed: int, frames: int) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.rng = np.random.default_rng([*kind.encode(), seed])
        self.frames = frames
        self.scene = bpy.context.scene
        self.world = bpy.data.worlds.new("world")
        self.scene.world = self.world
        self.world.use_nodes = True
        self.light_outside((0.0, 0.0, 0.0), 0.0)
        self._things = 0

    # Random choices.

    def between(self, low: float, high: float) -> float:
        """A uniform number."""
        return float(self.rng.uniform(low, high))

    def log_between(self, low: float, high: float) -> float:
        """A number whose logarithm is uniform: sizes and strengths."""
        return math.exp(self.between(math.log(low), math.log(high)))

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.random() < probability)

    def one_of(self, choices: Sequence[Any]) -> Any:
        """One of several."""
        return choices[int(self.rng.integers(len(choices)))]

    def count(self, low: int, high: int) -> int:
        """An integer, both ends included."""
        return int(self.rng.integers(low, high + 1))

    # Things.

    def add(
        self,
        mesh: Mesh,
        material: Any,
        at: Point = (0, 0, 0),
        *,
        turn: Point = (0, 0, 0),
        scale: Point = (1, 1, 1),
        smooth: bool = False,
        bevel: float = 0.0,
        parent: Any = None,
    ) -> Any:
        """Put a mesh in place; ``turn`` in radians about x, y, z; ``bevel`` rounds its edges by so many metres."""
        data = bpy.data.meshes.new("mesh")
        data.from_pydata(*_plain(mesh))
        data.materials.append(material)
        if smooth:
            data.polygons.foreach_set("use_smooth", [True] * len(data.polygons))
            data.set_sharp_from_angle(angle=math.radians(40))
        made = self._put(data, at, turn, scale, parent)
        if bevel:
            modifier = made.modifiers.new("bevel", "BEVEL")
            modifier.width, modifier.segments = bevel, 2
        return made

    def again(self, thing: Any, at: Point, *, turn: Point = (0, 0, 0), scale: Point = (1, 1, 1)) -> Any:
        """An instance of a thing: the same mesh at another place."""
        made = self._put(thing.data, at, turn, scale, None)
        for modifier in thing.modifiers:
            if modifier.type == "BEVEL":
                other = made.modifiers.new("bevel", "BEVEL")
                other.width, other.segments = modifier.width, modifier.segments
        return made

    def group(self, at: Point = (0, 0, 0), turn: Point = (0, 0, 0), parent: Any = None) -> Any:
        """An empty that things can follow."""
        return self._put(None, at, turn, (1, 1, 1), parent)

    def lamp(self, kind: str, at: Point, watts: float, color: Point, **options: Any) -> Any:
        """A lamp of Blender's (``POINT``, ``SPOT``, ``AREA``, ``SUN``); options are its properties.

        It looks at ``aim`` where that is given. A ``seen`` one is seen by the camera: a ball or a panel that shines.
        Such a lamp has far less noise than a mesh that shines, and than one in a shade, whose lit inside is found by
        chance.
        """
        aim, seen = options.pop("aim", None), options.pop("seen", False)
        data = bpy.data.lights.new("lamp", kind)
        data.energy, data.color = watts, tuple(color)
        for name, value in options.items():
            setattr(data, name, value)
        made = self._put(data, at, (0, 0, 0), (1, 1, 1), None)
        made.visible_camera = seen
        if aim is not None:
            made.rotation_euler = look(at, aim)
        return made

    def light_outside(self, color: Point, strength: float) -> None:
        """An even light from everywhere outside."""
        node = self.world.node_tree.nodes["Background"]
        node.inputs["Color"].default_value = (*color, 1.0)
        node.inputs["Strength"].default_value = strength

    def _put(self, data: Any, at: Point, turn: Point, scale: Point, parent: Any) -> Any:
        made = bpy.data.objects.new("thing", data)
        made.location, made.rotation_euler, made.scale = tuple(at), tuple(turn), tuple(scale)
        made.parent = parent
        self._things += 1
        made.pass_index = self._things
        self.scene.collection.objects.link(made)
        return made

    # Motion.

    @property
    def times(self) -> range:
        """The frames that have keys: two more at both ends, for vectors and shutters."""
        return range(-1, self.frames + 3)

    def move(self, thing: Any, path: Callable[[float], tuple[Point | None, Point | None]]) -> None:
        """Set place and turn in every frame; ``path`` takes 0 in the first frame and 1 in the last."""
        for frame in self.times:
            at, turn = path((frame - 1) / max(self.frames - 1, 1))
            if at is not None:
                thing.location = tuple(at)
                thing.keyframe_insert("location", frame=frame)
            if turn is not None:
                thing.rotation_euler = tuple(turn)
                thing.keyframe_insert("rotation_euler", frame=frame)

    def vary(self, owner: Any, name: str, value: Callable[[int], Any]) -> None:
        """Set a property in every frame, by frame number; between frames it keeps its value."""
        for frame in self.times:
            setattr(owner, name, value(frame))
            owner.keyframe_insert(name, frame=frame)


def look(at: Point, aim: Point) -> Euler:
    """The turn of a camera or lamp at a place that looks at another."""
    return (Vector(aim) - Vector(at)).to_track_quat("-Z", "Y").to_euler()


def _plain(mesh: Mesh) -> tuple[list, list, list]:
    vertices, faces = mesh
    return [tuple(map(float, v)) for v in vertices], [], [tuple(map(int, f)) for f in faces]
