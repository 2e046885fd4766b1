"""Moving objects for a randomised scene, as parts of an animation: some of the room move, others are inserted."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdn.render.camera_paths.free_space import FreeSpace, cast_rays, make_view_rays
from jaxdn.render.scenes.scene import Camera

WIDTH = 128
"""Image width that speeds in pixels refer to."""
_SMALL = 0.5
"""Largest diagonal of an object of the room that moves, as a share of the room's reach."""


def compute_focal_length(camera: Camera) -> float:
    """Pixels per unit of x / z in an image ``WIDTH`` wide."""
    return float(WIDTH / 2 / np.tan(np.radians(camera.x_fov) / 2))


def move_shapes(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, count: int, keep: set[str]
) -> dict[str, Any]:
    """An animation's "shapes": up to ``count`` small visible objects of the room slide, or turn about their centre.

    Args:
      space: the room.
      cameras: of every frame.
      rng: random numbers.
      count: number of objects.
      keep: names of shapes that stay where they are.
    """
    camera = cameras[0]
    seen = cast_rays(space.scene, camera.to_world[:3, 3], make_view_rays(camera, 32)).shape
    shapes = space.scene.shapes()
    moved: dict[str, Any] = {}
    for index in rng.permutation(np.unique(seen[seen >= 0])):
        shape = shapes[int(index)]
        box = shape.bbox()
        low, high = (np.array(part, np.float64).ravel() for part in (box.min, box.max))
        center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        away = min(float(np.linalg.norm(center - camera.to_world[:3, 3])) for camera in cameras)
        if len(moved) == count or shape.is_emitter() or shape.id() in keep:
            continue
        if 2 * radius > _SMALL * space.reach or away < radius + 2 * space.near:
            continue
        moved[shape.id()] = {"pivot": center.tolist(), "keys": _make_own_motion(space, cameras, rng, center, radius)}
    return moved


def _make_own_motion(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, center: np.ndarray, radius: float
) -> list[dict[str, Any]]:
    """Keys of an object of the room: it turns about an axis, mostly the vertical one, or slides sideways and back."""
    last = len(cameras) - 1
    if rng.random() < 0.5:
        axis = space.up if rng.random() < 0.7 else _draw_direction(rng)
        angle = float(rng.choice([-1, 1]) * _draw_log_uniform(rng, 1, 15) * last)
        return [{"frame": 0}, {"frame": max(last, 1), "axis": axis.tolist(), "angle": angle}]
    sideways = [_make_horizontal(_draw_direction(rng), space.up) for _ in range(6)]
    # From the edge of its box, as a ray from the centre would meet the object itself.
    free = [space.measure_free_distance(center + 1.05 * radius * one, one, 0.5 * radius) for one in sideways]
    best = int(np.argmax(free))
    speed = _draw_log_uniform(rng, 0.3, 10) * _measure_depth(cameras[0], center) / compute_focal_length(cameras[0])
    path = _bounce_between(0.0, max(free[best], 0.2 * radius), speed, 0.0, last)
    keys = [{"frame": at, "translation": (x * sideways[best]).tolist()} for at, x in path]
    return keys if _keeps_off_cameras(space, cameras, keys, radius, center) else [{"frame": 0}]


def insert_objects(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, count: int, level: float
) -> list[dict[str, Any]]:
    """An animation's "inserted": ``count`` objects or groups of them that are in view at some frame.

    Spheres, cubes and rods that fly, and spheres that roll, at 0.3 to 30 pixels a frame; rails and blinds of thin rods
    and boxes in front of the camera; small glowing lamps. No object comes closer to a camera than twice the near clip.

    Args:
      space: the room.
      cameras: of every frame.
      rng: random numbers.
      count: number of objects.
      level: radiance of the room, for the lamps.
    """
    objects: list[dict[str, Any]] = []
    for number in range(count):
        for _ in range(8):  # a place may have no room for the object
            kind = rng.choice(["fly", "roll", "lamp", "rails"], p=[0.45, 0.2, 0.15, 0.2])
            make = {"fly": _insert_flying, "roll": _insert_rolling, "lamp": _insert_lamp, "rails": _insert_rails}[
                str(kind)
            ]
            made = make(space, cameras, rng, level)
            if made:
                # The ids stand in the records of clips: another prefix would give other records.
                objects += [{"id": f"thrown_{number}_{part}", **shape} for part, shape in enumerate(made)]
                break
    return objects


def _choose_anchor(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, shares: tuple[float, float]
) -> tuple[int, np.ndarray, float]:
    """A frame, a free place that its camera sees, and the place's depth; ``shares``: of the free distance."""
    at = int(rng.integers(len(cameras)))
    camera = cameras[at]
    slope = np.tan(np.radians(camera.x_fov) / 2)
    local = np.array([*(rng.uniform(-0.7, 0.7, 2) * slope), 1.0])
    direction = camera.to_world[:3, :3] @ local / np.linalg.norm(local)
    origin = camera.to_world[:3, 3]
    free = min(float(cast_rays(space.scene, origin, direction[None]).distance[0]), 1.5 * space.reach)
    point = origin + direction * max(free * rng.uniform(*shares), 4 * space.near)
    return at, point, _measure_depth(camera, point)


def _insert_flying(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, level: float
) -> list[dict[str, Any]]:
    at, point, depth = _choose_anchor(space, cameras, rng, (0.25, 0.85))
    pixel = depth / compute_focal_length(cameras[at])
    kind = str(rng.choice(["sphere", "cube", "cylinder"], p=[0.35, 0.35, 0.3]))
    size = pixel * _draw_log_uniform(rng, 3, 22)
    extents: Any = size
    if kind == "cylinder":
        extents = [size * rng.uniform(0.1, 0.4)] * 2 + [size * rng.uniform(1, 2.5)]
    elif kind == "cube":
        extents = (size * rng.uniform(0.4, 1.2, 3)).tolist()
    radius = float(np.linalg.norm(np.broadcast_to(extents, 3))) / 2
    speed = pixel * _draw_log_uniform(rng, 0.3, 30)
    direction = _draw_direction_across(cameras[at], rng)
    keys = _make_flight_keys(space, cameras, (at, point, direction), speed, radius, rng)
    return [{"type": kind, "size": extents, **_draw_material(rng), "keys": keys}] if keys else []


def _insert_lamp(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, level: float
) -> list[dict[str, Any]]:
    """A small glowing ball that lights its neighbourhood about as strongly as the room is lit."""
    at, point, depth = _choose_anchor(space, cameras, rng, (0.3, 0.8))
    pixel = depth / compute_focal_length(cameras[at])
    size = pixel * _draw_log_uniform(rng, 3, 9)
    speed = pixel * _draw_log_uniform(rng, 0.2, 20)
    keys = _make_flight_keys(
        space, cameras, (at, point, _draw_direction_across(cameras[at], rng)), speed, size / 2, rng
    )
    glow = level * float(np.clip(_draw_log_uniform(rng, 0.1, 2) * (space.reach / size) ** 2, 3, 2000))
    lamp = {"type": "sphere", "size": size, "color": [0.0] * 3}
    return [{**lamp, "emission": (glow * (0.3 + 0.7 * _draw_color(rng))).tolist(), "keys": keys}] if keys else []


def _insert_rolling(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, level: float
) -> list[dict[str, Any]]:
    """A ball on the floor, or on whatever lies below a visible place."""
    at, point, depth = _choose_anchor(space, cameras, rng, (0.4, 0.95))
    drop = float(cast_rays(space.scene, point, -space.up[None]).distance[0])
    pixel = depth / compute_focal_length(cameras[at])
    radius = pixel * _draw_log_uniform(rng, 3, 12)
    if not radius < drop < space.reach:
        return []
    start = point - (drop - 1.02 * radius) * space.up
    direction = _make_horizontal(_draw_direction(rng), space.up)
    free = [space.measure_free_distance(start, sign * direction, 0.6 * radius) for sign in (-1, 1)]
    if sum(free) < radius or not _is_visible(space, cameras[at], start):
        return []
    path = _bounce_between(-free[0], free[1], pixel * _draw_log_uniform(rng, 0.3, 20), at, len(cameras) - 1)
    axis = np.cross(space.up, direction)
    keys = [
        {
            "frame": time,
            "translation": (start + x * direction).tolist(),
            "axis": axis.tolist(),
            "angle": float(np.degrees(x / radius)),
        }
        for time, x in path
    ]
    ball = {"type": "sphere", "size": 2 * radius, **_draw_material(rng), "keys": keys}
    return [ball] if _keeps_off_cameras(space, cameras, keys, radius) else []


def _insert_rails(
    space: FreeSpace, cameras: Sequence[Camera], rng: np.random.Generator, level: float
) -> list[dict[str, Any]]:
    """A row of thin rods, or of flat boxes like a blind, close to the camera and slowly moving."""
    at, point, depth = _choose_anchor(space, cameras, rng, (0.15, 0.5))
    pixel = depth / compute_focal_length(cameras[at])
    count = int(rng.integers(3, 8))
    gap, thick, length = (
        pixel * _draw_log_uniform(rng, 6, 16),
        pixel * _draw_log_uniform(rng, 0.7, 3.5),
        pixel * _draw_log_uniform(rng, 30, 110),
    )
    blind = rng.random() < 0.4
    left = _make_horizontal(cameras[at].to_world[:3, 0], space.up)
    axis, angle = _to_axis_angle(np.stack([np.cross(left, space.up), left, space.up], axis=1))
    # A cylinder runs along z, which is turned upwards; the slats of a blind lie along the left direction, y.
    along = space.up if blind else left
    size = [1.5 * thick, length, 0.4 * thick] if blind else [thick, thick, length]
    speed = pixel * _draw_log_uniform(rng, 0.2, 8)
    radius = 0.5 * float(np.hypot(length, count * gap))
    free = [space.measure_free_distance(point, sign * left, thick) for sign in (-1, 1)]
    path = _bounce_between(-free[0] / 2, free[1] / 2, speed, at, len(cameras) - 1)
    look = _draw_material(rng)
    rows = []
    for row in range(count):
        place = point + (row - (count - 1) / 2) * gap * along
        keys = [
            {"frame": time, "translation": (place + x * left).tolist(), "axis": axis.tolist(), "angle": angle}
            for time, x in path
        ]
        rows.append({"type": "cube" if blind else "cylinder", "size": size, **look, "keys": keys})
    near_enough = all(_keeps_off_cameras(space, cameras, rod["keys"], 0.3 * radius) for rod in rows)
    return rows if near_enough else []


def _make_flight_keys(
    space: FreeSpace,
    cameras: Sequence[Camera],
    course: tuple[int, np.ndarray, np.ndarray],
    speed: float,
    radius: float,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Keys of a flight through ``course`` (frame, place, direction), turning about a random axis; [] if blocked."""
    at, point, direction = course
    if not space.is_clear(point[None], 0.8 * radius).all():
        return []
    free = [space.measure_free_distance(point, sign * direction, radius) for sign in (-1, 1)]
    rate, axis = float(rng.choice([0.0, _draw_log_uniform(rng, 1, 25)])), _draw_direction(rng).tolist()
    keys = [
        {"frame": time, "translation": (point + x * direction).tolist(), "axis": axis, "angle": rate * time}
        for time, x in _bounce_between(-free[0], free[1], speed, at, len(cameras) - 1)
    ]
    return keys if _keeps_off_cameras(space, cameras, keys, radius) else []


def _bounce_between(low: float, high: float, speed: float, at: float, last: int) -> list[tuple[float, float]]:
    """Times and positions of a motion to and fro between ``low`` <= 0 and ``high`` >= 0, which is at 0 at time ``at``.

    At most half the distance is covered in a frame.
    """
    length = max(high - low, 1e-9)
    speed = min(speed, length / 2)
    first = -low - speed * at  # the phase at time 0; every multiple of the length is a turn
    turns = np.arange(np.ceil(first / length), np.floor((first + speed * last) / length) + 1) * length
    times = np.unique(np.concatenate([[0.0], (turns - first) / max(speed, 1e-12), [float(max(last, 1))]]))
    times = times[np.concatenate([[True], np.diff(times) > 1e-6])]
    phases = np.mod(first + speed * times, 2 * length)
    positions = low + length - np.abs(phases - length)
    return list(zip(times.tolist(), positions.tolist(), strict=True))


def _keeps_off_cameras(
    space: FreeSpace, cameras: Sequence[Camera], keys: Sequence[dict[str, Any]], radius: float, center: Any = 0.0
) -> bool:
    """Whether an object of this radius, whose ``center`` the keys move, stays off every camera."""
    frames = [key["frame"] for key in keys]
    places = center + np.array([key["translation"] for key in keys])
    path = np.stack([np.interp(np.arange(len(cameras)), frames, places[:, axis]) for axis in range(3)], axis=-1)
    away = np.linalg.norm(path - np.array([camera.to_world[:3, 3] for camera in cameras]), axis=1)
    return bool(away.min() > radius + max(2 * space.near, 0.5 * space.clear))


def _is_visible(space: FreeSpace, camera: Camera, point: np.ndarray) -> bool:
    """Whether nothing of the room lies between a camera and a point."""
    ray = point - camera.to_world[:3, 3]
    length = float(np.linalg.norm(ray))
    return float(cast_rays(space.scene, camera.to_world[:3, 3], ray[None] / length).distance[0]) > 0.98 * length


def _draw_material(rng: np.random.Generator) -> dict[str, Any]:
    """A saturated colour, and metal of any roughness, something glossy, something matte, or now and then glass."""
    kind = rng.choice(["metal", "glossy", "matte", "glass"], p=[0.3, 0.35, 0.3, 0.05])
    if kind == "glass":
        return {"bsdf": {"type": "dielectric"}}
    look: dict[str, Any] = {"color": _draw_color(rng).tolist()}
    if kind == "metal":
        look |= {"roughness": float(rng.uniform(0.05, 0.8)), "metallic": 1.0}
    elif kind == "glossy":
        look |= {"roughness": float(rng.uniform(0.1, 0.6)), "metallic": 0.0}
    return look


def _draw_color(rng: np.random.Generator) -> np.ndarray:
    """[3] a linear reflectance, mostly saturated."""
    hue, saturation, value = rng.random(), 1 - 0.7 * rng.random() ** 2, rng.uniform(0.35, 1.0)
    wheel = np.clip(np.abs(np.mod(6 * hue + np.array([0.0, 4.0, 2.0]), 6) - 3) - 1, 0, 1)
    return (value * (1 - saturation * (1 - wheel))) ** 2.2


def _draw_direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _make_horizontal(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The horizontal part of a direction, of length 1; some horizontal one for a vertical direction."""
    flat = direction - (direction @ up) * up
    if np.linalg.norm(flat) < 1e-3:
        flat = np.roll(up, 1)
    return flat / np.linalg.norm(flat)


def _draw_direction_across(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """A direction that is mostly across the view."""
    local = _draw_direction(rng) * (1.0, 0.7, 0.5)
    return camera.to_world[:3, :3] @ local / np.linalg.norm(local)


def _measure_depth(camera: Camera, point: np.ndarray) -> float:
    return float((point - camera.to_world[:3, 3]) @ camera.to_world[:3, 2])


def _to_axis_angle(rotation: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit axis and degrees of a rotation matrix."""
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    # The sign of the angle about this axis from the antisymmetric part.
    twist = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return axis, float(np.degrees(np.arctan2(twist @ axis, np.trace(rotation) - 1)))


def _draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
