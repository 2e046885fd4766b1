"""Furniture and fittings as meshes with thin members: chairs, shelves, books, plants, blinds, railings, frames.

Metres, y up, standing on y = 0; what belongs to a wall lies in the plane z = 0 and the room is at z > 0. A mesh that
needs several colours takes them from the `PALETTE` x `PALETTE` cells of a small texture.
"""

import numpy as np

from jaxdn.render.families.shapes import Mesh, boxes, drum, join, lathe, placed, sheet, soft_box
from jaxdn.render.families.staging import rod, scale, shift, turn

PALETTE = 8


def moved(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """The mesh under any regular transform [4,4] without reflection."""
    normals = mesh.normals @ np.linalg.inv(matrix[:3, :3])
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return Mesh(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], normals, mesh.uv, mesh.faces)


def in_cell(mesh: Mesh, cell: int) -> Mesh:
    """The mesh in the single colour of one cell of a palette."""
    row, column = divmod(cell, PALETTE)
    centre = (np.array([column, row]) + 0.5) / PALETTE
    return mesh._replace(uv=np.tile(centre, (len(mesh.vertices), 1)))


def stick(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Mesh:
    """A bar of square section between two points."""
    return moved(boxes(((0, 0.5, 0), (1, 0.5, 1))), rod(start, end, radius))


def chair(rng: np.random.Generator) -> Mesh:
    """A chair 0.8 to 1.05 m high that faces +z, with legs 1 to 3 cm thick and a back of rails or spindles."""
    wide, deep, seat = rng.uniform(0.18, 0.23), rng.uniform(0.18, 0.22), rng.uniform(0.42, 0.48)
    leg, spread, high = rng.uniform(0.006, 0.015), rng.uniform(0, 0.05), seat + rng.uniform(0.36, 0.55)
    parts = [boxes(((0, seat, 0), (wide, rng.uniform(0.008, 0.025), deep)))]
    for x in (-wide + leg, wide - leg):
        for z in (-deep + leg, deep - leg):
            parts.append(stick((x + np.sign(x) * spread, 0, z + np.sign(z) * spread), (x, seat, z), leg))
        parts.append(stick((x, seat, -deep + leg), (x, high, -deep - 0.06), leg))
        if rng.random() < 0.5:
            parts.append(stick((x, 0.5 * seat, -deep), (x, 0.5 * seat, deep), 0.6 * leg))
    count = int(rng.integers(2, 7))
    for share in (np.arange(count) + 1.0) / (count + 1):
        if count < 4:  # rails
            y, z = seat + (high - seat) * (0.25 + 0.8 * share), -deep - 0.06 * share
            parts.append(boxes(((0, y, z), (wide, 0.025, 0.006))))
        else:  # spindles
            x = wide * (2 * share - 1)
            parts.append(stick((x, seat, -deep), (x, high, -deep - 0.05), 0.005))
    parts.append(boxes(((0, high, -deep - 0.06), (wide, 0.03, 0.01))))
    return join(*parts)


def table_legs(rng: np.random.Generator, wide: float, deep: float, high: float) -> Mesh:
    """Legs below a table top of half size `wide` x `deep`: four thin ones, two crosses, or a column on a foot.

    Args:
      rng: random numbers.
      wide: half width.
      deep: half depth.
      high: height of the underside.
    """
    kind, thick = rng.integers(3), rng.uniform(0.008, 0.018)
    x, z = 0.88 * wide, 0.86 * deep
    if kind == 0:
        spread = rng.uniform(0.0, 0.06)
        ends = [(a * x, b * z, a, b) for a in (-1, 1) for b in (-1, 1)]
        legs = [stick((px + a * spread, 0, pz + b * spread), (px, high, pz), thick) for px, pz, a, b in ends]
        return join(*legs, boxes(((0, high - 0.03, z), (x, 0.02, 0.006)), ((0, high - 0.03, -z), (x, 0.02, 0.006))))
    if kind == 1:
        bars = [stick((a, 0, b * z), (-a, high, b * z), thick) for a in (-x, x) for b in (-1, 1)]
        return join(*bars, stick((0, high / 2, -z), (0, high / 2, z), thick))
    column = moved(drum(), scale(2 * thick, high, 2 * thick))
    return join(column, moved(drum(0.3), scale(0.5 * min(wide, deep), 0.04, 0.5 * min(wide, deep))))


def bookcase(wide: float, high: float, deep: float, shelves: int) -> Mesh:
    """Boards 2 cm thick, open at the front; its back is at z = 0 and its half width is `wide`.

    Args:
      wide: half width.
      high: height.
      deep: depth.
      shelves: compartments.
    """
    spans = [((side * wide, high / 2, deep / 2), (0.01, high / 2, deep / 2)) for side in (-1, 1)]
    levels = np.linspace(0.03, high - 0.01, shelves + 1)
    spans += [((0, float(y), deep / 2), (wide, 0.01, deep / 2)) for y in levels]
    return boxes(*spans, ((0, high / 2, 0.004), (wide, high / 2, 0.003)))


def books(rng: np.random.Generator, wide: float, high: float, deep: float, shelves: int) -> Mesh:
    """Thin books of many colours in a `bookcase` of the same size, with gaps, and some that lean.

    Args:
      rng: random numbers.
      wide: half width of the bookcase.
      high: its height.
      deep: its depth.
      shelves: its compartments.
    """
    parts: list[Mesh] = []
    levels = np.linspace(0.03, high - 0.01, shelves + 1)
    room = float(levels[1] - levels[0]) - 0.03
    for level in levels[:-1]:
        x = -wide + 0.02
        while x < wide - 0.08 and len(parts) < 120:
            thick, tall = rng.uniform(0.005, 0.024), room * rng.uniform(0.6, 0.95)
            far, lean = min(deep, 0.3) * rng.uniform(0.3, 0.42), rng.random() < 0.1
            x += 2 * thick + (0.2 * tall if lean else 0.001)
            block = boxes(((-thick, tall / 2, 0), (thick, tall / 2, far)))
            place = shift(x, level + 0.012, deep / 2) @ (turn("z", 9) if lean else np.eye(4))
            parts.append(in_cell(moved(block, place), int(rng.integers(PALETTE**2))))
            x += rng.uniform(0.1, 0.4) if rng.random() < 0.06 else 0.0
    return join(*parts)


def plant(rng: np.random.Generator, high: float) -> Mesh:
    """Stems that bend outwards from the origin, with 50 to 200 leaves of two triangles each.

    The last row of the palette colours the stems, the other rows the leaves.
    """
    stems, leaves = int(rng.integers(6, 15)), int(rng.integers(8, 14))
    long, broad, droop = rng.uniform(0.06, 0.22), rng.uniform(0.25, 0.6), rng.uniform(0.1, 0.9)
    parts: list[Mesh] = []
    for _ in range(stems):
        around, reach, rise = rng.uniform(0, 360), high * rng.uniform(0.1, 0.55), high * rng.uniform(0.6, 1.0)
        share = np.linspace(0, 1, leaves + 1)[:, None]
        bend = np.array([1.0, 0.0, 0.0]) * reach * share**2 + np.array([0, 1.0, 0]) * rise * (share - 0.2 * share**3)
        line = bend @ turn("y", around)[:3, :3].T
        for first, second in zip(line[:-1:3], line[3::3], strict=False):
            parts.append(in_cell(stick(tuple(first), tuple(second), 0.004), PALETTE**2 - 1))
        for base in line[1:]:
            out = turn("y", rng.uniform(0, 360)) @ turn("z", 50 - 90 * droop * rng.random())
            parts.append(_leaf(base, out[:3, :3], long * rng.uniform(0.6, 1.2), broad, int(rng.integers(56))))
    return join(*parts)


def _leaf(base: np.ndarray, turned: np.ndarray, long: float, broad: float, cell: int) -> Mesh:
    """A pointed leaf along the x axis of `turned`, folded a little along its middle."""
    half = 0.5 * broad
    points = long * np.array([(0, 0, 0), (0.45, 0.08, half), (1, 0, 0), (0.45, 0.08, -half)]) @ turned.T + base
    corners = points[[0, 1, 2, 0, 2, 3]]
    normals = np.cross(corners[[1, 4]] - corners[[0, 3]], corners[[2, 5]] - corners[[0, 3]])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), 3, axis=0)
    return in_cell(Mesh(corners, normals, np.zeros((6, 2)), np.arange(6).reshape(2, 3)), cell)


def window_bars(wide: float, high: float, columns: int, rows: int, bar: float) -> Mesh:
    """A window's frame 10 cm deep and its glazing bars, around an opening of half size `wide` x `high`.

    Args:
      wide: half width of the opening.
      high: half height of the opening.
      columns: panes side by side.
      rows: panes above each other.
      bar: half thickness of the bars.
    """
    spans = [((side * wide, 0.0, -0.03), (1.5 * bar, high, 0.05)) for side in (-1, 1)]
    spans += [((0.0, side * high, -0.03), (wide, 1.5 * bar, 0.05)) for side in (-1, 1)]
    spans += [((wide * (2 * i / columns - 1), 0.0, -0.02), (bar, high, bar)) for i in range(1, columns)]
    spans += [((0.0, high * (2 * i / rows - 1), -0.02), (wide, bar, bar)) for i in range(1, rows)]
    return boxes(*spans, ((0, -high - 0.03, 0.06), (wide + 0.08, 0.02, 0.08)))


def blinds(wide: float, drop: float, *, pitch: float, tilt: float, upright: bool) -> Mesh:
    """Slats that hang `drop` down from y = 0, half `wide`, `pitch` apart, each turned by `tilt` degrees."""
    slat = boxes(((0, 0, 0), (wide, 0.0015, 0.48 * pitch)))
    if upright:
        count = max(2, int(2 * wide / pitch))
        slat = boxes(((0, -drop / 2, 0), (0.48 * pitch, drop / 2, 0.0015)))
        places = [shift(wide * ((2 * i + 1) / count - 1), 0, 0) @ turn("y", tilt) for i in range(count)]
    else:
        places = [shift(0, -pitch * (i + 1), 0) @ turn("x", tilt) for i in range(max(2, int(drop / pitch) - 1))]
    cords = boxes(*(((side * 0.7 * wide, -drop / 2, 0), (0.002, drop / 2, 0.002)) for side in (-1, 1)))
    return join(*(moved(slat, place) for place in places), cords, boxes(((0, 0.01, 0), (wide, 0.015, 0.02))))


def railing(wide: float, high: float, gap: float) -> Mesh:
    """A handrail on thin uprights `gap` apart, of half width `wide`."""
    count = max(2, int(2 * wide / gap))
    spans = [((wide * (2 * i / count - 1), high / 2, 0.0), (0.007, high / 2, 0.007)) for i in range(count + 1)]
    return boxes(*spans, ((0, high, 0), (wide, 0.02, 0.025)), ((0, 0.08, 0), (wide, 0.012, 0.012)))


def curtain(rng: np.random.Generator, wide: float, drop: float) -> Mesh:
    """A cloth in folds that hangs `drop` down from y = 0, from x = 0 to `wide`."""
    x, y = np.linspace(0, 1, 96)[None], np.linspace(0, 1, 12)[:, None]
    folds, depth = rng.integers(4, 10), rng.uniform(0.02, 0.05)
    z = depth * np.sin(2 * np.pi * (folds * x + 0.1 * np.sin(5 * y))) * (0.6 + 0.4 * y)
    return sheet(np.stack([wide * x + 0 * y, -drop * y + 0 * x, z], -1))


def sofa(rng: np.random.Generator, wide: float) -> Mesh:
    """Cushions between two arms, facing +z, with its back at z = 0; `wide` is half its width."""
    pad, seat, back = soft_box(0.25, 0.2, rows=16, columns=32), rng.uniform(0.36, 0.44), rng.uniform(0.65, 0.95)
    parts = [placed(pad, (0, 0.5 * seat, 0.42), (wide, 0.5 * seat - 0.06, 0.4))]
    parts.append(placed(pad, (0, 0.5 * back + 0.1, 0.12), (wide, 0.5 * back - 0.06, 0.11)))
    parts += [placed(pad, (side * (wide + 0.06), 0.33, 0.42), (0.08, 0.24, 0.42)) for side in (-1, 1)]
    parts += [placed(pad, (side * 0.48 * wide, seat + 0.03, 0.5), (0.47 * wide, 0.08, 0.33)) for side in (-1, 1)]
    feet = [((x, 0.04, z), (0.012, 0.05, 0.012)) for x in (-0.9 * wide, 0.9 * wide) for z in (0.1, 0.75)]
    return join(*parts, boxes(*feet))


def picture_frame(wide: float, high: float, bar: float) -> Mesh:
    """Four bars around a picture of half size `wide` x `high`, 3 cm deep."""
    spans = [((side * wide, 0.0, 0.015), (bar, high + bar, 0.015)) for side in (-1, 1)]
    return boxes(*spans, *(((0.0, side * high, 0.015), (wide, bar, 0.015)) for side in (-1, 1)))


def lamp_stand(high: float) -> Mesh:
    """A thin pole on a round foot."""
    return join(moved(drum(), scale(0.011, high, 0.011)), moved(drum(0.8), scale(0.13, 0.02, 0.13)))


def lamp_shade(low: float, top: float, high: float) -> Mesh:
    """A single sheet open at both ends, from radius `low` at y = 0 to `top` at y = `high`."""
    return lathe([(low, 0.0), (top, high)], segments=32)


def fan(blades: int) -> Mesh:
    """The hub and the blades of a ceiling fan of radius 1, which turn about y."""
    blade = moved(boxes(((0.57, 0, 0), (0.43, 0.006, 0.1))), turn("x", 12))
    turned = [moved(blade, turn("y", 360 * i / blades)) for i in range(blades)]
    return join(*turned, moved(drum(), shift(0, -0.06, 0) @ scale(0.16, 0.12, 0.16)))


def goblet(rng: np.random.Generator) -> Mesh:
    """A drinking glass of height 1 as a single sheet."""
    foot, bowl, stem = rng.uniform(0.2, 0.3), rng.uniform(0.22, 0.38), rng.uniform(0.0, 0.5)
    if stem < 0.15:  # a tumbler
        return lathe([(0, 0.01), (0.8 * bowl, 0.01), (bowl, 1.0)], segments=32)
    return lathe([(foot, 0), (0.03, 0.04), (0.03, stem), (bowl, stem + 0.3), (0.85 * bowl, 1.0)], segments=32)
