"""Meshes: boxes, turned shapes, tubes, sheets. Vertices in metres; nothing here knows Blender."""

import math
from collections.abc import Callable, Sequence

import numpy as np

Mesh = tuple[Sequence[Sequence[float]], Sequence[Sequence[int]]]
"""Vertices in metres and faces of vertex numbers."""


def box(x: float, y: float, z: float) -> Mesh:
    """A box that stands on z = 0, centred in x and y."""
    corners = [(sx * x / 2, sy * y / 2, sz * z) for sz in (0, 1) for sy in (-1, 1) for sx in (-1, 1)]
    return corners, [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def sheet(x: float, y: float) -> Mesh:
    """A flat sheet in z = 0, centred."""
    return [(-x / 2, -y / 2, 0), (x / 2, -y / 2, 0), (x / 2, y / 2, 0), (-x / 2, y / 2, 0)], [(0, 1, 2, 3)]


def turned(profile: Sequence[tuple[float, float]], sides: int = 32) -> Mesh:
    """A profile of (radius, height) turned about z; a radius of 0 closes the end."""
    angles = 2 * math.pi * np.arange(sides) / sides
    vertices = [(r * math.cos(a), r * math.sin(a), z) for r, z in profile for a in angles]
    faces = [
        (i * sides + j, i * sides + (j + 1) % sides, (i + 1) * sides + (j + 1) % sides, (i + 1) * sides + j)
        for i in range(len(profile) - 1)
        for j in range(sides)
    ]
    return vertices, faces


def cylinder(radius: float, height: float, sides: int = 32) -> Mesh:
    """A closed cylinder that stands on z = 0."""
    vertices, faces = turned([(radius, 0), (radius, height)], sides)
    return vertices, [*faces, tuple(reversed(range(sides))), tuple(range(sides, 2 * sides))]


def ball(radius: float, sides: int = 32) -> Mesh:
    """A sphere about the origin."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, sides // 2 + 1)
    return turned([(radius * math.cos(a), radius * math.sin(a)) for a in angles], sides)


def ring(radius: float, thickness: float, sides: int = 32) -> Mesh:
    """A torus about z."""
    inner = sides // 2
    vertices, faces = [], []
    for i in range(sides):
        a = 2 * math.pi * i / sides
        for j in range(inner):
            b = 2 * math.pi * j / inner
            r = radius + thickness * math.cos(b)
            vertices.append((r * math.cos(a), r * math.sin(a), thickness * math.sin(b)))
            k, m = (i + 1) % sides, (j + 1) % inner
            faces.append((i * inner + j, k * inner + j, k * inner + m, i * inner + m))
    return vertices, faces


def tube(points: Sequence[Sequence[float]], radii: Sequence[float], sides: int = 10) -> Mesh:
    """A tube along points, with a radius at each."""
    path = np.asarray(points, float)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    vertices: list[tuple[float, ...]] = []
    side = np.cross(along[0], (0.31, 0.77, 0.55))
    for point, direction, radius in zip(path, along, radii, strict=True):
        side = side - direction * (side @ direction)
        side /= np.linalg.norm(side)
        other = np.cross(direction, side)
        for j in range(sides):
            a = 2 * math.pi * j / sides
            vertices.append(tuple(point + radius * (math.cos(a) * side + math.sin(a) * other)))
    faces = [
        (i * sides + j, i * sides + (j + 1) % sides, (i + 1) * sides + (j + 1) % sides, (i + 1) * sides + j)
        for i in range(len(path) - 1)
        for j in range(sides)
    ]
    return vertices, faces


def surface(x: float, y: float, cells: int, height: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Mesh:
    """A sheet of ``cells`` by ``cells`` whose height is a function of x and y: hills, cloth, dents."""
    us, vs = np.meshgrid(np.linspace(-x / 2, x / 2, cells + 1), np.linspace(-y / 2, y / 2, cells + 1))
    vertices = list(zip(us.ravel(), vs.ravel(), np.broadcast_to(height(us, vs), us.shape).ravel(), strict=True))
    row = cells + 1
    return vertices, [
        (i * row + j, i * row + j + 1, (i + 1) * row + j + 1, (i + 1) * row + j)
        for i in range(cells)
        for j in range(cells)
    ]


def stone(rng: np.random.Generator, radius: float) -> Mesh:
    """An uneven ball: a stone."""
    vertices, faces = ball(radius, 20)
    bumps = rng.normal(size=(5, 3)) * 2.0
    phases = rng.uniform(0, 2 * math.pi, 5)
    out = []
    for v in np.asarray(vertices):
        swell = 1 + 0.09 * float(np.sum(np.sin(bumps @ (v / radius) + phases)))
        out.append((v[0] * swell, v[1] * swell * 0.9, v[2] * swell * 0.7))
    return out, faces


def joined(parts: Sequence[tuple[Mesh, Sequence[float]]]) -> Mesh:
    """Several meshes as one, each shifted."""
    vertices: list[tuple[float, ...]] = []
    faces: list[tuple[int, ...]] = []
    for (points, cells), shift in parts:
        first = len(vertices)
        vertices += [(p[0] + shift[0], p[1] + shift[1], p[2] + shift[2]) for p in points]
        faces += [tuple(first + i for i in cell) for cell in cells]
    return vertices, faces
