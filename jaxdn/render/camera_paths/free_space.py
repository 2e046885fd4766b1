"""The free space of a scene, found by rays: where a camera may be, what it sees there, and how far objects can move."""

import itertools
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.buffers.gbuffer import check_scene
from jaxdn.render.scenes.scene import Camera
from jaxdn.render.scenes.scene_file import SceneFile

_GRID = 16
"""Rays across and down a view that is scored."""
_CLEAR = 0.05
"""Free distance around every place, as a share of the room's."""
_NEAR = 2.5
"""The same in near-clip distances of the scene's camera."""
_OPEN = 0.5
"""Largest share of directions that leave the scene at a place that counts as inside."""
_WANTED = 24
"""Fewer places than this are no room to move in."""


class RayHits(NamedTuple):
    """What rays meet first."""

    distance: np.ndarray
    """[N] float64, infinite where a ray leaves the scene."""
    shape: np.ndarray
    """[N] int64 index in the scene's shapes, -1 where a ray leaves the scene."""


def cast_rays(scene: Any, origins: np.ndarray, directions: np.ndarray) -> RayHits:
    """The first hits of rays [N, 3] with unit directions, with the current variant. Instances count as no shape."""
    origins, directions = (np.broadcast_to(part, np.shape(directions)) for part in (origins, directions))
    numbers = {_number_shape(shape): index for index, shape in enumerate(scene.shapes())}
    if str(mi.variant()).startswith("scalar"):
        distance, shape = np.full(len(directions), np.inf), np.full(len(directions), -1)
        for index, (origin, direction) in enumerate(zip(origins.tolist(), directions.tolist(), strict=True)):
            hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), False)
            if hit.is_valid():
                distance[index], shape[index] = hit.t, numbers.get(_number_shape(hit.shape), -1)
        return RayHits(distance, shape)
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
    hit = scene.ray_intersect_preliminary(ray, coherent=False)
    reinterpret: Any = dr.reinterpret_array
    found, number = dr.select(hit.is_valid(), hit.t, dr.inf), reinterpret(mi.UInt32, hit.shape)
    dr.eval(found, number)
    values, inverse = np.unique(np.array(number), return_inverse=True)
    distance = np.array(found, np.float64)
    shape = np.array([numbers.get(int(value), -1) for value in values])[inverse]
    return RayHits(distance, np.where(np.isfinite(distance), shape, -1))


def _number_shape(shape: Any) -> Any:
    """What tells a shape from the others: its name, or its number in a vectorised variant."""
    if str(mi.variant()).startswith("scalar"):
        return shape.id()
    reinterpret: Any = dr.reinterpret_array
    return int(reinterpret(mi.UInt32, mi.ShapePtr(shape))[0])


def make_sphere_directions(count: int) -> np.ndarray:
    """[count, 3] unit directions, evenly spread (a Fibonacci lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - 5**0.5) * np.arange(count)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)


def make_view_rays(camera: Camera, grid: int = _GRID) -> np.ndarray:
    """[grid * grid, 3] unit directions through a square view, from its upper left corner in rows."""
    x, y = np.meshgrid(*2 * [(np.arange(grid) + 0.5) / grid * 2 - 1])
    slope = np.tan(np.radians(camera.x_fov) / 2)
    local = np.stack([-slope * x, -slope * y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return _normalise(local) @ np.asarray(camera.to_world)[:3, :3].T


class ViewScores(NamedTuple):
    """What K square views show; every entry [K]."""

    empty: np.ndarray
    """Share of the rays that leave the scene."""
    close: np.ndarray
    """Share of the rays that end within a quarter of the room's reach."""
    nearest: np.ndarray
    """The shortest distance."""
    middle: np.ndarray
    """The median distance."""
    spread: np.ndarray
    """Logarithm of the ratio of the distances at 90 and 10 % of the rays."""
    largest: np.ndarray
    """Share of the shape that fills most of the view."""
    shapes: np.ndarray
    """Number of different shapes."""


class FreeSpace:
    """Places inside a scene file from which rays show clearance on all sides.

    They lie on rays from the file's own camera and from places found before. ``spots`` [N, 3] are the places, ``reach``
    is the median distance of what surrounds them, ``clear`` the free distance around every place (5 % of the
    reach and 2.5 near-clip distances), ``up`` the axis closest to the camera's up direction. ``scene`` is the loaded
    scene without an animation. The same file always gives the same places. Raises ValueError for a file without
    a camera, for effects that rendering does not support, and for a scene without free space.
    """

    def __init__(self, file: SceneFile) -> None:
        self.file = file
        self.scene = file.build(0, _GRID, _GRID)
        check_scene(self.scene, filtered=True)
        start = np.asarray(file.camera(0).to_world)
        self.near = file.near
        self.up = _find_nearest_axis(start[:3, 1])
        around = cast_rays(self.scene, start[:3, 3], make_sphere_directions(512)).distance
        if np.isfinite(around).sum() < 8:
            raise ValueError(_explain(file, "rays from its camera meet nothing"))
        rng = np.random.default_rng(0)
        self._set_reach(around)
        self.spots = self._find_places(start[None, :3, 3], 1500, rng)
        for _ in range(2):
            if len(self.spots) == 0:
                break
            sources = self.spots[rng.integers(len(self.spots), size=60)]
            # The camera may stand in a corner, or look in from outside: what surrounds the places it sees counts.
            self._set_reach(
                cast_rays(
                    self.scene, np.repeat(sources, 64, axis=0), np.tile(make_sphere_directions(64), (60, 1))
                ).distance
            )
            self.spots = np.concatenate([self.spots, self._find_places(sources, 25, rng)])
            self.spots = self.spots[self.is_clear(self.spots)]
        if len(self.spots) < _WANTED:
            raise ValueError(_explain(file, f"{len(self.spots)} places have {self.clear:.3g} of clearance"))

    def _set_reach(self, distances: np.ndarray) -> None:
        self.reach = float(np.median(distances[np.isfinite(distances)]))
        self.clear = max(_CLEAR * self.reach, _NEAR * self.near)

    def _find_places(self, sources: np.ndarray, rays: int, rng: np.random.Generator) -> np.ndarray:
        """Places on ``rays`` random rays from each source that are clear."""
        origins = np.repeat(sources, rays, axis=0)
        directions = _normalise(rng.normal(size=origins.shape))
        distance = np.minimum(cast_rays(self.scene, origins, directions).distance, 3 * self.reach)
        points = origins + directions * (distance * rng.uniform(0.1, 0.95, len(distance)))[:, None]
        return points[self.is_clear(points)]

    def is_clear(self, points: np.ndarray, radius: float | None = None) -> np.ndarray:
        """[N] whether nothing is within ``radius`` (default: the clearance) of points [N, 3] inside the room."""
        directions = make_sphere_directions(64)
        hits = cast_rays(self.scene, np.repeat(points, 64, axis=0), np.tile(directions, (len(points), 1)))
        distance = hits.distance.reshape(len(points), 64)
        inside = np.mean(~np.isfinite(distance), axis=1) <= _OPEN
        return inside & (distance.min(axis=1, initial=np.inf) > (self.clear if radius is None else radius))

    def is_collision_free(self, points: np.ndarray) -> bool:
        """Whether a camera can move along the polyline through points [N, 3]: every part of it is clear."""
        steps = [points[:1]]
        for first, second in itertools.pairwise(points):
            length = float(np.linalg.norm(second - first))
            share = np.linspace(0, 1, 2 + int(2 * length / self.clear))[1:, None]
            steps.append(first + share * (second - first))
        path = np.concatenate(steps)
        moves = np.diff(path, axis=0)
        lengths = np.linalg.norm(moves, axis=1)
        going = lengths > 1e-9
        blocked = cast_rays(self.scene, path[:-1][going], _normalise(moves[going])).distance < lengths[going]
        return bool(not blocked.any() and self.is_clear(path).all())

    def measure_free_distance(self, start: np.ndarray, direction: np.ndarray, radius: float) -> float:
        """How far a ball can move: the shortest of five parallel rays less its radius, at most the room's reach."""
        side = _normalise(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]))
        other = np.cross(direction, side)
        offsets = radius * np.array([0 * side, side, -side, other, -other])
        distance = cast_rays(self.scene, start + offsets, np.tile(direction, (5, 1))).distance.min()
        return float(np.clip(distance - 1.1 * radius, 0.0, self.reach))

    def score_views(self, cameras: list[Camera], scene: Any = None) -> ViewScores:
        """Score what cameras see in the room, or in another scene that is the room with objects in it."""
        origins = np.repeat([np.asarray(camera.to_world)[:3, 3] for camera in cameras], _GRID**2, axis=0)
        directions = np.concatenate([make_view_rays(camera) for camera in cameras])
        hits = cast_rays(self.scene if scene is None else scene, origins, directions)
        distance = hits.distance.reshape(len(cameras), -1)
        shapes = hits.shape.reshape(len(cameras), -1)
        far = np.minimum(distance, 10 * self.reach)
        low, middle, high = np.quantile(far, (0.1, 0.5, 0.9), axis=1)
        counts = [np.bincount(row[row >= 0], minlength=1) for row in shapes]
        return ViewScores(
            empty=np.mean(~np.isfinite(distance), axis=1),
            close=np.mean(distance < 0.25 * self.reach, axis=1),
            nearest=distance.min(axis=1),
            middle=middle,
            spread=np.log(high / low),
            largest=np.array([count.max() for count in counts]) / _GRID**2,
            shapes=np.array([np.count_nonzero(count) for count in counts]),
        )


def _explain(file: SceneFile, reason: str) -> str:
    return (
        f"tour of {file.name}: expected free space around the scene's camera, found none ({reason}); move the "
        f"camera into the room, or render the scene with an animation of your own."
    )


def _find_nearest_axis(direction: np.ndarray) -> np.ndarray:
    """The coordinate axis, with its sign, that is closest to a direction."""
    index = int(np.argmax(np.abs(direction)))
    axis = np.zeros(3)
    axis[index] = np.sign(direction[index])
    return axis


def _normalise(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
