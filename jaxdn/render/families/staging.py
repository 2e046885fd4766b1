"""Building blocks of a family's scenes: transforms, materials, rooms with lamps and windows, and the scene itself.

Metres, y up; a room is centred on x = z = 0 with its floor at y = 0, and the camera looks towards -z.
"""

import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.families import textures
from jaxdn.render.families.shapes import Mesh, boxes, dish, drum, holed_wall, ply_path
from jaxdn.render.scenes.optics import ENTRIES, SceneOptics, describe_optics
from jaxdn.render.scenes.scene import Camera

Motion = Callable[[float], np.ndarray]
"""The world pose [4,4] at a frame: one fixed scale, then rotations and shifts, so that two poses differ rigidly."""


def shift(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def scale(x: float, y: float | None = None, z: float | None = None) -> np.ndarray:
    return np.diag([x, x if y is None else y, x if z is None else z, 1.0])


def turn(axis: str, degrees: float) -> np.ndarray:
    """A right-handed rotation about the axis "x", "y" or "z"."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = cos
    matrix[first, second], matrix[second, first] = -sin, sin
    return matrix


def look_at(origin: Any, target: Any) -> np.ndarray:
    """Camera to world: +z towards the target, +x to the left, y up."""
    forward = np.subtract(target, origin).astype(float)
    forward /= np.linalg.norm(forward)
    left = np.cross((0.0, 1.0, 0.0), forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([left, np.cross(forward, left), forward], axis=1)
    matrix[:3, 3] = origin
    return matrix


def rod(start: Any, end: Any, radius: float) -> np.ndarray:
    """Places the unit drum (y = 0 to 1) as a rod between two points."""
    axis = np.subtract(end, start).astype(float)
    length = float(np.linalg.norm(axis))
    axis /= length
    side = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([side * radius, axis * length, np.cross(side, axis) * radius], axis=1)
    matrix[:3, 3] = start
    return matrix


def attached(joint: Motion, local: np.ndarray) -> Motion:
    """The motion of what is fixed to a joint at the pose `local`."""
    return lambda frame: joint(frame) @ local


def swing(frame: float, period: float, phase: float = 0.0) -> float:
    """A sine in [-1, 1]; periods in frames, phases in turns."""
    return float(np.sin(2 * np.pi * (frame / period + phase)))


def hop(frame: float, period: float, phase: float = 0.0) -> float:
    """The height in [0, 1] of a ball that bounces without loss: one parabola a period."""
    time = (frame / period + phase) % 1.0
    return 4 * time * (1 - time)


def shuttle(frame: float, period: float, phase: float = 0.0) -> float:
    """Back and forth at constant speed in [-1, 1], like a ball between two cushions."""
    time = (frame / period + phase) % 1.0
    return 4 * abs(time - 0.5) - 1


class Finish(NamedTuple):
    """A surface: one colour [3] or a texture [n,n,3], repeated over uv; without roughness it is purely diffuse.

    `normals` [n,n,3] are those of flakes in it, one for each texel, in the frame of the surface. `glass` is Mitsuba's
    name of a kind of glass, which lets light of the colour through; roughness and the rest do not apply to it.
    """

    color: np.ndarray
    roughness: float | None = None
    metallic: float = 0.0
    specular: float = 0.5
    repeat: tuple[float, float] = (1.0, 1.0)
    normals: np.ndarray | None = None
    glass: str | None = None

    def describe(self) -> dict[str, Any]:
        """The dictionary of a Mitsuba BSDF; all but glass look the same from both sides."""
        if self.color.ndim == 1:
            color: dict[str, Any] = {"type": "rgb", "value": [float(value) for value in np.clip(self.color, 0, 0.95)]}
        else:
            color = _bitmap(self.color, self.repeat)
        if self.glass is not None:
            return {"type": self.glass, "specular_transmittance": color}
        if self.roughness is None:
            return {"type": "twosided", "nested": {"type": "diffuse", "reflectance": color}}
        gloss = {"roughness": float(self.roughness), "metallic": float(self.metallic), "specular": float(self.specular)}
        nested: dict[str, Any] = {"type": "principled", "base_color": color, **gloss}
        if self.normals is not None:
            flakes = _bitmap(0.5 + 0.5 * self.normals, self.repeat) | {"filter_type": "nearest"}
            nested = {"type": "normalmap", "normalmap": flakes, "nested": nested}
        return {"type": "twosided", "nested": nested}


def _bitmap(values: np.ndarray, repeat: tuple[float, float] = (1.0, 1.0)) -> dict[str, Any]:
    """The dictionary of a texture [n,n,3] of linear values."""
    import mitsuba as mi

    to_uv = mi.ScalarTransform4f(scale(repeat[0], repeat[1], 1.0))
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values)), "raw": True, "to_uv": to_uv}


def matte(color: Any, *, repeat: tuple[float, float] = (1.0, 1.0)) -> Finish:
    return Finish(np.asarray(color), repeat=repeat)


def glossy(color: Any, roughness: float = 0.35, *, repeat: tuple[float, float] = (1.0, 1.0)) -> Finish:
    return Finish(np.asarray(color), roughness, repeat=repeat)


def metal(color: Any, roughness: float = 0.25) -> Finish:
    return Finish(np.asarray(color), roughness, metallic=1.0)


def glass(color: Any, *, thin: bool = False) -> Finish:
    """Clear glass: of a solid body, or of a `thin` wall that is a single sheet."""
    return Finish(np.asarray(color), glass="thindielectric" if thin else "dielectric")


class Part(NamedTuple):
    """One shape of a stage: a primitive's name or a mesh, where it stands at a frame, what it is made of and emits.

    `glow` is a radiance [3] or a texture of it [n,n,3]; `dimmer` gives the factor on it at a frame.
    """

    shape: str | Mesh
    pose: Motion
    moves: bool
    material: Finish
    glow: np.ndarray | None
    dimmer: Callable[[float], float] | None = None


class Stage:
    """An animated scene that a family fills part by part; its interface is `AnimatedScene`.

    `rng` is seeded by the family's name and the seed: every random choice must be drawn from it while the stage is
    filled, none later, so that a record always gives the same frames.

    Args:
      name: of the family.
      seed: of the scene.
      frames: suggested number of frames.
      max_depth: path length.
      lamp: one of `LAMPS`; "mix" lets the seed choose.
    """

    def __init__(self, name: str, seed: int, *, frames: int = 16, max_depth: int = 5, lamp: str = "mix") -> None:
        if lamp not in LAMPS:
            raise ValueError(f"lamp: expected one of {', '.join(LAMPS)}, got {lamp!r}; 'mix' lets the seed choose.")
        self.name, self.frames, self.max_depth = name, frames, max_depth
        self.record: dict[str, Any] = {"family": name, "seed": int(seed)}
        if lamp != "mix":
            self.record["lamp"] = lamp
        self.rng = np.random.default_rng([int(seed), zlib.crc32(name.encode())])
        draw = self.rng.random()  # always drawn, so that a given lamp does not change the other choices
        self.lamp = lamp if lamp != "mix" else "up" if draw < 0.3 else "down" if draw < 0.65 else "window"
        self.parts: dict[str, Part] = {}
        self.bounds = np.zeros((2, 3))
        self.view: Callable[[float], Camera] = lambda frame: Camera(np.eye(4), 60.0)
        self.optics = SceneOptics()

    def add(
        self,
        name: str,
        shape: str | Mesh,
        pose: np.ndarray | Motion,
        material: Finish,
        *,
        glow: Any = None,
        dimmer: Callable[[float], float] | None = None,
    ) -> None:
        """Add a shape to the scene.

        Args:
          name: a new one.
          shape: a primitive's name or a mesh.
          pose: [4, 4], or a function of the frame for a moving shape.
          material: of the shape.
          glow: radiance [3] that it emits, or a texture of it [n, n, 3].
          dimmer: factor on the radiance at a frame.
        """
        if name in self.parts:
            raise ValueError(f"stage {self.name}: expected a new part, got {name!r} twice; rename one of them.")
        motion: Motion = pose if callable(pose) else lambda frame: pose
        radiance = None if glow is None else np.asarray(glow, float)
        self.parts[name] = Part(shape, motion, callable(pose), material, radiance, dimmer)

    def set_optics(self, optics: SceneOptics) -> None:
        """Give the scene a lens, a shutter and fog; they are in its record."""
        self.optics = optics
        self.record = {name: self.record[name] for name in self.record if name not in ENTRIES} | optics.record()

    @property
    def shutter(self) -> float:
        """Time for which the shutter is open, in frames."""
        return self.optics.shutter

    def camera(self, frame: float) -> Camera:
        return self.optics.focus(self.view(frame))

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        return {name: part.pose(frame) for name, part in self.parts.items() if part.moves}

    def brightness(self, frame: float) -> dict[str, float]:
        """Light -> factor on its radiance, for lights that change."""
        return {name: part.dimmer(frame) for name, part in self.parts.items() if part.dimmer is not None}

    def build(self, frame: float, width: int, height: int) -> Any:
        import mitsuba as mi

        # One object after the other: their numbers are a part of kernels, which another order would compile anew.
        return mi.load_dict(self.describe(frame, width, height), optimize=False, parallel=False)

    def describe(self, frame: float, width: int, height: int) -> dict[str, Any]:
        """Mitsuba's dictionary of one frame; the shapes' keys are the ids that `pose` uses."""
        import mitsuba as mi

        camera, factors = self.camera(frame), self.brightness(frame)
        film: dict[str, Any] = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        film |= {"pixel_format": "rgb", "component_format": "float32"}
        sensor: dict[str, Any] = {
            **describe_optics(camera, self.optics.fog),
            "fov": camera.x_fov,
            "fov_axis": "x",
            "near_clip": 0.02,
            "far_clip": 100.0,
        }
        sensor |= {"to_world": mi.ScalarTransform4f(camera.to_world), "film": film, "sampler": {"type": "independent"}}
        integrator = {"type": "path", "max_depth": self.max_depth, "rr_depth": 1000}
        scene: dict[str, Any] = {"type": "scene", "integrator": integrator, "sensor": sensor}
        for name, part in self.parts.items():
            if isinstance(part.shape, Mesh):
                shape: dict[str, Any] = {"type": "ply", "filename": ply_path(part.shape)}
            else:
                shape = {"type": part.shape}
            shape |= {"to_world": mi.ScalarTransform4f(part.pose(frame)), "bsdf": part.material.describe()}
            if part.glow is not None:
                shape["emitter"] = {"type": "area", "radiance": _radiance(part.glow, factors.get(name))}
            scene[name] = shape
        return scene


def _radiance(glow: np.ndarray, factor: float | None) -> dict[str, Any]:
    """The dictionary of an emitted colour [3] or texture [n,n,3]."""
    emitted = glow if factor is None else factor * glow
    if emitted.ndim == 1:
        return {"type": "rgb", "value": [float(value) for value in emitted]}
    return _bitmap(emitted.astype(np.float32))


LAMPS = ("mix", "up", "down", "window")
RECTANGLE = "rectangle"


def furnish_room(
    stage: Stage,
    half: tuple[float, float, float],
    *,
    floor: Finish,
    wall: Finish,
    back: Finish,
    ceiling: Finish,
) -> None:
    """Floor, ceiling and four walls of a room.

    If the stage's lamp is a window, the right wall has an opening with a cross of bars in front of a bright sky.

    Args:
      stage: gets the shapes.
      half: half width, full height and half length in metres.
      floor: material.
      wall: material of the front and side walls.
      back: material of the back wall.
      ceiling: material.
    """
    width, height, length = half
    stage.bounds = np.array([[-width, 0, -length], [width, height, length]])
    stage.add("floor", RECTANGLE, turn("x", -90) @ scale(width, length, 1), floor)
    stage.add("ceiling", RECTANGLE, shift(0, height, 0) @ turn("x", 90) @ scale(width, length, 1), ceiling)
    stage.add("wall_back", RECTANGLE, shift(0, height / 2, -length) @ scale(width, height / 2, 1), back)
    front = shift(0, height / 2, length) @ turn("y", 180) @ scale(width, height / 2, 1)
    stage.add("wall_front", RECTANGLE, front, wall)
    left = shift(-width, height / 2, 0) @ turn("y", 90) @ scale(length, height / 2, 1)
    stage.add("wall_left", RECTANGLE, left, wall)
    if stage.lamp == "window":
        _window_wall(stage, half, wall)
    else:
        right = shift(width, height / 2, 0) @ turn("y", -90) @ scale(length, height / 2, 1)
        stage.add("wall_right", RECTANGLE, right, wall)


def _window_wall(stage: Stage, half: tuple[float, float, float], wall: Finish) -> None:
    """The right wall with an opening, the bars and the sill of the window in it, and the sky outside."""
    width, height, length = half
    centre = stage.rng.uniform(-0.35, 0.15) * length
    near, far = centre + 0.36 * length, centre - 0.36 * length
    low, high = 0.3 * height, 0.82 * height
    middle, reach, rise = (low + high) / 2, (near - far) / 2, (high - low) / 2
    # The wall's own x runs along +z of the room once it is turned to face inwards.
    opening = (far / length, near / length, 2 * low / height - 1, 2 * high / height - 1)
    pose = shift(width, height / 2, 0) @ turn("y", -90) @ scale(length, height / 2, 1)
    stage.add("wall_right", holed_wall(*opening), pose, wall)
    bars = boxes(
        ((0, 0, 0), (0.03, rise, 0.03)),
        ((0, 0, 0), (0.03, 0.03, reach)),
        ((-0.08, -rise - 0.03, 0), (0.12, 0.03, reach + 0.1)),
    )
    stage.add("window_bars", bars, shift(width, middle, centre), glossy((0.75, 0.73, 0.7), 0.4))
    sky = shift(width + 0.45, middle + 0.25, centre) @ turn("y", -90 + stage.rng.uniform(-6, 6)) @ turn("x", 14)
    stage.add("sky", RECTANGLE, sky @ scale(reach + 0.55, rise + 0.45, 1), matte((0.0, 0.0, 0.0)), glow=(1.0, 1.0, 1.0))


def light_room(stage: Stage, spot: tuple[float, float], *, power: float) -> None:
    """The lamp: `power` scales the light in the room, about alike for the three kinds; `spot` is its (x, z).

    up: a bowl hung under the ceiling that shines only upwards, so that all light in the room is indirect.
    down: a round panel at the ceiling. window: the sky outside.
    """
    rng, (x, z) = stage.rng, spot
    tint = np.array([1.0, 0.86, 0.68]) * (1 - (cool := rng.random())) + np.array([0.82, 0.92, 1.0]) * cool
    area = float(np.prod(stage.bounds[1, [0, 2]] - stage.bounds[0, [0, 2]]))
    strength = power * rng.uniform(0.8, 1.25) * area * tint / tint.mean()
    if stage.lamp == "window":
        sky = stage.parts["sky"]
        face = np.prod(np.sort(np.linalg.norm(sky.pose(0)[:3, :2], axis=0))) * 4
        stage.parts["sky"] = sky._replace(glow=4.5 * strength / face)
        return
    radius = 0.55
    if stage.lamp == "up":
        y = 0.76 * stage.bounds[1, 1]
        facing = shift(x, y, z) @ turn("x", -90)
        stage.add(
            "lamp", "disk", facing @ scale(radius), matte((0.0, 0.0, 0.0)), glow=1.4 * strength / radius**2 / np.pi
        )
        brass = metal(textures.hsv(rng.uniform(0.06, 0.14), 0.5, 0.85), 0.35)
        stage.add("lamp_bowl", dish(0.18), shift(x, y - 0.2, z) @ scale(radius * 1.15), brass)
    else:
        y = stage.bounds[1, 1] - 0.12
        facing = shift(x, y, z) @ turn("x", 90)
        stage.add(
            "lamp", "disk", facing @ scale(radius), matte((0.0, 0.0, 0.0)), glow=1.7 * strength / radius**2 / np.pi
        )
        shade = glossy((0.7, 0.7, 0.7), 0.4)
        stage.add("lamp_bowl", drum(0.8), shift(x, y + 0.005, z) @ scale(radius * 1.12, 0.11, radius * 1.12), shade)


def drifting_camera(
    stage: Stage,
    origin: Any,
    target: Any,
    *,
    x_fov: float,
    reach: float = 0.25,
    period: tuple[float, float] = (45, 90),
) -> None:
    """A camera that always moves on a slow closed path around `origin` and pans around `target`.

    Args:
      stage: gets the camera.
      origin: centre of the path.
      target: centre of the pan.
      x_fov: horizontal field of view in degrees.
      reach: half the sideways travel in metres; the path rises and dollies by less.
      period: range of the periods in frames.
    """
    rng = stage.rng
    times = rng.uniform(*period, 3) * rng.choice([-1, 1], 3)
    phases = rng.random(3)
    phases[2] = phases[0] + 0.25  # rises fastest at the sideways turning points, so that it never rests
    times[2] = times[0]
    spans = np.array([1.0, 0.35, 0.45]) * reach * rng.uniform(0.8, 1.2, 3)
    eye, aim = np.asarray(origin, float), np.asarray(target, float)

    def view(frame: float) -> Camera:
        x, z, y = (swing(frame, time, phase) for time, phase in zip(times, phases, strict=True))
        wander = np.array([0.3 * spans[0] * y, 0.15 * spans[2] * x, 0.0])
        return Camera(look_at(eye + spans[[0, 2, 1]] * np.array([x, y, z]), aim + wander), x_fov)

    stage.view = view
