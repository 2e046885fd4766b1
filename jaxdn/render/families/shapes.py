"""Meshes made from formulas, and the PLY files through which Mitsuba reads them.

A mesh carries its own smooth normals; its faces wind counter-clockwise seen from outside. Y is up.
"""

import functools
import hashlib
import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.render.families.textures import noise

TIP = 1e-4  # the radius that stands for 0 at a pole, where a surface of revolution would lose its normal


class Mesh(NamedTuple):
    """Triangles: vertices [V,3], unit normals [V,3], uv [V,2], faces [F,3] int."""

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


def join(*meshes: Mesh) -> Mesh:
    """One mesh out of several; nothing is welded, so creases between them stay sharp."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    vertices, normals, uv = (np.concatenate([mesh[i] for mesh in meshes]) for i in range(3))
    return Mesh(vertices, normals, uv, faces)


def placed(mesh: Mesh, offset: tuple[float, float, float], stretch: float | tuple[float, float, float] = 1.0) -> Mesh:
    """The mesh stretched along the axes by positive factors, then moved."""
    factors = np.broadcast_to(np.asarray(stretch, float), 3)
    normals = mesh.normals / factors
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return Mesh(mesh.vertices * factors + np.asarray(offset), normals, mesh.uv, mesh.faces)


def sheet(points: np.ndarray, *, closed: bool = False) -> Mesh:
    """The smooth surface through points [n,m,3]; its outside is d/dn x d/dm. `closed`: the last column is the first."""
    rows, columns = points.shape[:2]
    down = np.gradient(points, axis=0)
    if closed:
        ring = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
        across = ring[:, 2:] - ring[:, :-2]
    else:
        across = np.gradient(points, axis=1)
    normals = np.cross(down, across)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    right, below = corner + 1, corner + columns
    faces = np.concatenate([np.stack([corner, below, right], -1), np.stack([right, below, below + 1], -1)])
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces)


def lathe(*pieces: np.ndarray | list[tuple[float, float]], segments: int = 48) -> Mesh:
    """The surface of revolution about y of profiles (radius, height), with a crease between two pieces.

    Profiles run anticlockwise seen with the axis at the left: from the bottom up along the outside.
    """
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    meshes = []
    for piece in pieces:
        radius, height = np.asarray(piece, float).T
        radius = np.maximum(radius, TIP)[:, None]
        rings = (radius * np.cos(angle), np.repeat(height[:, None], segments + 1, 1), radius * np.sin(angle))
        meshes.append(sheet(np.stack(rings, -1), closed=True))
    return join(*meshes)


def drum(top: float = 1.0) -> Mesh:
    """A capped cylinder of radius 1 from y = 0 to y = 1; `top` is its upper radius (0.0: a cone)."""
    side: list[tuple[float, float]] = [(1, 0), (top, 1)]
    caps = [[(0.0, 0.0), (1.0, 0.0)]] + ([[(top, 1.0), (0.0, 1.0)]] if top > 0 else [])
    return lathe(side, *caps)


def soft_box(vertical: float = 0.3, horizontal: float = 0.3, *, rows: int = 28, columns: int = 48) -> Mesh:
    """A superellipsoid in [-1,1]^3: exponents 1 give a sphere, small ones a box with rounded edges (Barr 1981)."""
    latitude = np.linspace(-np.pi / 2 + 1e-3, np.pi / 2 - 1e-3, rows)[:, None]
    longitude = np.linspace(0, 2 * np.pi, columns + 1)[None]

    def power(value: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(value) * np.abs(value) ** exponent

    def shell(first: float, second: float) -> np.ndarray:
        ring, rise = power(np.cos(latitude), first), power(np.sin(latitude), first)
        x, z = ring * power(np.cos(longitude), second), ring * power(np.sin(longitude), second)
        return np.stack([x, np.broadcast_to(rise, x.shape), z], -1)

    normals = shell(2 - vertical, 2 - horizontal).reshape(-1, 3)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return sheet(shell(vertical, horizontal), closed=True)._replace(normals=normals)


def ring(thickness: float = 0.3) -> Mesh:
    """A torus about y of radius 1."""
    turn = np.linspace(-np.pi, np.pi, 25)
    return lathe(np.stack([1 + thickness * np.cos(turn), thickness * np.sin(turn)], -1))


def flat(vertices: np.ndarray | list[tuple[float, float, float]], faces: list[tuple[int, int, int]]) -> Mesh:
    """A faceted mesh: every face has its own vertices and normal."""
    corners = np.asarray(vertices, float)[np.asarray(faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), 3, axis=0)
    points = corners.reshape(-1, 3)
    uv = 0.5 + 0.5 * np.stack([points[:, 0] + points[:, 2], points[:, 1]], -1)
    return Mesh(points, normals, uv, np.arange(len(points)).reshape(-1, 3))


def boxes(*spans: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """Faceted boxes as one mesh, each given as (centre, half size)."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return join(*(flat(corners * np.asarray(half) + np.asarray(centre), faces) for centre, half in spans))


def holed_wall(left: float, right: float, low: float, high: float) -> Mesh:
    """The square [-1,1]^2 facing +z without the opening given; uv run over the whole square."""
    pieces = [(-1, left, -1, 1), (right, 1, -1, 1), (left, right, -1, low), (left, right, high, 1)]
    corners = np.array([(x, y, 0) for x0, x1, y0, y1 in pieces for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])
    faces = [(4 * i + a, 4 * i + b, 4 * i + c) for i in range(4) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    mesh = flat(corners, faces)
    return mesh._replace(uv=0.5 + 0.5 * mesh.vertices[:, :2])


def roof() -> Mesh:
    """A saddle roof over [-1,1]^2 with its ridge along z at y = 1."""
    corners = [
        (-1.0, 0.0, -1.0),
        (1.0, 0.0, -1.0),
        (1.0, 0.0, 1.0),
        (-1.0, 0.0, 1.0),
        (0.0, 1.0, -1.0),
        (0.0, 1.0, 1.0),
    ]
    faces = [(0, 3, 5), (0, 5, 4), (1, 4, 5), (1, 5, 2), (0, 4, 1), (3, 2, 5), (0, 1, 2), (0, 2, 3)]
    return flat(corners, faces)


def star(points: int = 5, *, inner: float = 0.45, depth: float = 0.25) -> Mesh:
    """A faceted star in the xy plane, radius 1."""
    angle = np.pi / 2 + np.arange(2 * points) * np.pi / points
    radius = np.where(np.arange(2 * points) % 2 == 0, 1.0, inner)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], -1)
    count = 2 * points
    after = [(i + 1) % count for i in range(count)]
    faces = [(i, after[i], count) for i in range(count)] + [(after[i], i, count + 1) for i in range(count)]
    return flat(np.concatenate([rim, [[0, 0, depth], [0, 0, -depth]]]), faces)


def apple() -> Mesh:
    """A round apple of height about 2, with dimples and a short stalk."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 48)
    radius = np.cos(turn) * (1 + 0.1 * np.sin(turn))
    height = 0.92 * np.sin(turn) - np.sign(turn) * np.where(turn > 0, 0.3, 0.16) * np.exp(-((radius / 0.3) ** 2))
    stalk = placed(lathe([(0.05, 0), (0.04, 0.4), (0.06, 0.5)], [(0.06, 0.5), (0, 0.5)], segments=12), (0, 0.5, 0))
    return join(lathe(np.stack([radius, height], -1)), stalk)


def pear() -> Mesh:
    """A pear of height about 2.6 whose belly has radius 1 and its centre at the origin."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 56)
    rise = np.clip((np.sin(turn) + 0.1) / 1.1, 0, 1)
    radius = np.cos(turn) * (1 - 0.38 * rise**0.8)
    stalk = placed(lathe([(0.05, 0), (0.04, 0.3), (0.06, 0.4)], [(0.06, 0.4), (0, 0.4)], segments=12), (0, 1.6, 0))
    return join(lathe(np.stack([radius, np.sin(turn) * (1 + 0.7 * rise)], -1)), stalk)


def vase(belly: float = 0.5, neck: float = 0.2) -> Mesh:
    """A vase with wall thickness, height 1, standing on y = 0."""
    rise = np.linspace(0, 1, 36)
    swell = np.sin(np.pi * np.clip(rise * 1.15 + 0.08, 0, 1)) ** 1.4
    radius = neck + (belly - neck) * swell + 0.06 * np.exp(-((1 - rise) ** 2) / 0.004)
    outside, inside = np.stack([radius, rise], -1), np.stack([radius[::-1] - 0.03, rise[::-1]], -1)[:32]
    lip = [tuple(outside[-1]), (float(radius[-1]) - 0.015, 1.012), tuple(inside[0])]
    floor = [tuple(inside[-1]), (0.0, float(inside[-1][1]))]
    return lathe([(0, 0), (float(radius[0]), 0)], outside, lip, inside, floor)


def dish(depth: float = 0.2) -> Mesh:
    """A plate or bowl of radius 1: a flat foot of radius 0.5 and a rising rim `depth` high, 0.04 thick."""
    reach = np.linspace(0.5, 1, 20)
    rise = depth * ((reach - 0.5) / 0.5) ** 1.6
    rim = [(1.0, depth), (1.012, depth + 0.02), (1.0, depth + 0.04)]
    return lathe(
        [(0, 0), (0.5, 0)],
        np.stack([reach, rise], -1),
        rim,
        np.stack([reach, rise + 0.04], -1)[::-1],
        [(0.5, 0.04), (0, 0.04)],
    )


def hills(rng: np.random.Generator, *, height: float = 0.3, level: float = 0.45, cells: int = 3) -> Mesh:
    """A landscape over [-1,1]^2: smooth hills outside the radius `level`, level ground at y = 0 within it."""
    z, x = np.meshgrid(np.linspace(-1, 1, 49), np.linspace(-1, 1, 49), indexing="ij")
    relief = noise(rng, cells, size=64, octaves=2)[:49, :49]
    rise = np.clip((np.hypot(x, z) - level) / 0.5, 0, 1)
    points = np.stack([x, height * relief * rise**1.5, z], -1)
    return sheet(points)


def runner(width: float, length: float, drop: float, rng: np.random.Generator) -> Mesh:
    """A cloth [-width/2, width/2] that lies from z = 0 to z = length and hangs `drop` down over the edge there."""
    bend = 0.03
    lying, curve = np.linspace(0, length, 24), np.linspace(0, np.pi / 2, 8)[1:]
    hanging = np.linspace(0, drop, 24)[1:]
    z = np.concatenate([lying, length + bend * np.sin(curve), np.full(23, length + bend)])
    y = np.concatenate([np.zeros(24), bend * (np.cos(curve) - 1), -bend - hanging])
    fall = np.clip(-y / drop, 0, 1)[:, None]
    x = np.linspace(-width / 2, width / 2, 64)[None]
    fold = np.sin(2 * np.pi * (rng.integers(3, 6) * x / width + rng.random())) * 0.5 + 0.5
    return sheet(np.stack([x * (1 - 0.06 * fall), y[:, None] + 0 * x, z[:, None] + 0.06 * fall * fold], -1))


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """This process's own folder of meshes, removed when it ends."""
    return tempfile.TemporaryDirectory(prefix="jaxdn-meshes-")


def ply_path(mesh: Mesh) -> str:
    """The binary PLY file of the mesh, written once in this process; its name is the hash of its contents."""
    columns = np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = "ply\nformat binary_little_endian 1.0\n" + f"element vertex {len(columns)}\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    contents = header.encode() + columns.tobytes() + faces.tobytes()
    path = Path(_folder().name) / f"{hashlib.sha256(contents).hexdigest()[:24]}.ply"
    if not path.exists():
        # Written under another name and renamed, so that another thread never reads an incomplete mesh.
        handle, part = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(contents)
        os.replace(part, path)
    return str(path)
