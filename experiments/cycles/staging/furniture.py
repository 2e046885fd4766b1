"""Furniture and small things for rooms, each a function that puts it at a place on the floor or a table."""

import math
from typing import Any

from experiments.cycles.staging import materials, shapes
from experiments.cycles.staging.stage import Point, Stage


def table(stage: Stage, at: Point, length: float, depth: float, height: float, top: Any = None) -> None:
    """A table with four legs, or a round one with a column."""
    made = top or materials.wood(stage)
    x, y, z = at
    if stage.chance(0.3):
        stage.add(shapes.cylinder(depth / 2 + 0.1, 0.04, 48), made, (x, y, z + height - 0.04), bevel=0.008)
        stage.add(shapes.turned([(0.3, 0), (0.28, 0.03), (0.05, 0.1), (0.04, height - 0.04)]), made, at, smooth=True)
        return
    stage.add(shapes.box(length, depth, 0.04), made, (x, y, z + height - 0.04), bevel=0.006)
    leg = shapes.box(0.05, 0.05, height - 0.04)
    for sx in (-1, 1):
        for sy in (-1, 1):
            stage.add(leg, made, (x + sx * (length / 2 - 0.05), y + sy * (depth / 2 - 0.05), z))


def chair(stage: Stage, at: Point, heading: float, made: Any, seat: Any) -> None:
    """A chair that faces a heading (radians about z; 0 faces -y)."""
    base = stage.group(at, (0, 0, heading))
    for x in (-0.19, 0.19):
        stage.add(shapes.cylinder(0.018, 0.45, 12), made, (x, -0.19, 0), parent=base)
        stage.add(shapes.cylinder(0.018, 0.92, 12), made, (x, 0.19, 0), parent=base)
    stage.add(shapes.box(0.44, 0.42, 0.05), seat, (0, 0, 0.44), bevel=0.015, parent=base)
    for z in (0.6, 0.72, 0.84):
        stage.add(shapes.box(0.38, 0.02, 0.06), made, (0, 0.19, z), bevel=0.005, parent=base)


def sofa(stage: Stage, at: Point, heading: float, length: float, made: Any) -> None:
    """A sofa with cushions."""
    base = stage.group(at, (0, 0, heading))
    stage.add(shapes.box(length, 0.85, 0.3), made, (0, 0, 0.08), bevel=0.04, parent=base)
    stage.add(shapes.box(length, 0.25, 0.75), made, (0, 0.32, 0.1), bevel=0.08, parent=base)
    for side in (-1, 1):
        stage.add(shapes.box(0.2, 0.85, 0.55), made, (side * (length / 2 - 0.08), 0, 0.08), bevel=0.07, parent=base)
    seats = max(1, round((length - 0.4) / 0.7))
    width = (length - 0.36) / seats
    for i in range(seats):
        x = -length / 2 + 0.18 + (i + 0.5) * width
        stage.add(shapes.box(width - 0.02, 0.62, 0.16), made, (x, -0.1, 0.38), bevel=0.05, parent=base)
        if stage.chance(0.7):
            turn = (stage.between(0.9, 1.3), stage.between(-0.3, 0.3), 0)
            pillow = shapes.box(0.42, 0.42, 0.12)
            stage.add(pillow, materials.cloth(stage), (x, 0.05, 0.62), turn=turn, bevel=0.05, parent=base)


def shelf(stage: Stage, at: Point, heading: float, width: float, height: float) -> None:
    """A shelf with books and small things."""
    made = materials.wood(stage)
    base = stage.group(at, (0, 0, heading))
    for x in (-width / 2, width / 2):
        stage.add(shapes.box(0.03, 0.32, height), made, (x, 0, 0), parent=base)
    stage.add(shapes.box(width, 0.01, height), made, (0, 0.16, 0), parent=base)
    floors = max(2, int(height / 0.38))
    covers = [materials.plain(stage) for _ in range(7)]
    for i in range(floors + 1):
        z = i * (height - 0.03) / floors
        stage.add(shapes.box(width, 0.32, 0.03), made, (0, 0, z), parent=base)
        if i < floors:
            _fill_board(stage, base, z + 0.03, width - 0.06, covers)


def _fill_board(stage: Stage, base: Any, z: float, width: float, covers: list[Any]) -> None:
    x = -width / 2
    while x < width / 2 - 0.06:
        if stage.chance(0.1):
            small_thing(stage, (x + 0.08, 0, z), parent=base, largest=0.2)
            x += 0.2
            continue
        thick, high = stage.between(0.02, 0.055), stage.between(0.18, 0.3)
        lean = stage.between(0.1, 0.2) if stage.chance(0.07) else 0.0
        book = shapes.box(thick, stage.between(0.16, 0.24), high)
        stage.add(book, stage.one_of(covers), (x + thick / 2, -0.02, z), turn=(0, lean, 0), parent=base)
        x += thick + 0.003 + 0.3 * lean * high
        if stage.chance(0.05):
            x += stage.between(0.05, 0.2)


def cabinet(stage: Stage, at: Point, heading: float, width: float, height: float) -> None:
    """A cabinet with doors, knobs, and small things on top."""
    made = materials.wood(stage) if stage.chance(0.6) else materials.plain(stage, roughness=stage.between(0.1, 0.5))
    knob = materials.metal(stage, stage.between(0.1, 0.4))
    base = stage.group(at, (0, 0, heading))
    stage.add(shapes.box(width, 0.42, height - 0.08), made, (0, 0, 0.08), bevel=0.01, parent=base)
    doors = max(1, round(width / 0.45))
    for i in range(doors):
        x = -width / 2 + (i + 0.5) * width / doors
        door = shapes.box(width / doors - 0.02, 0.02, height - 0.14)
        stage.add(door, made, (x, -0.22, 0.11), bevel=0.004, parent=base)
        stage.add(shapes.ball(0.016, 16), knob, (x + 0.12, -0.245, height * 0.55), smooth=True, parent=base)
    for _ in range(stage.count(2, 5)):
        place = (stage.between(-0.42, 0.42) * width, stage.between(-0.12, 0.1), height)
        small_thing(stage, place, parent=base, largest=0.4)


def vase(stage: Stage, at: Point, height: float, made: Any, parent: Any = None) -> Any:
    """A turned vase."""
    steps = 18
    wide, phase, waves = stage.between(0.2, 0.4), stage.between(0, 6), stage.between(2, 6)
    profile = [(0.0, 0.0)]
    for i in range(steps + 1):
        t = i / steps
        profile.append((height * wide * (0.62 + 0.38 * math.sin(phase + waves * t)), height * t))
    inner = [(r * 0.9, z) for r, z in reversed(profile[2:])]
    return stage.add(shapes.turned([*profile, *inner], 28), made, at, smooth=True, parent=parent)


def small_thing(stage: Stage, at: Point, parent: Any = None, largest: float = 0.3) -> None:
    """Some small thing that stands on a board: a vase, a ball, a box, a ring, a bowl, a stone."""
    size = stage.between(0.3, 1.0) * largest
    x, y, z = at
    kind = stage.one_of(["vase", "vase", "ball", "box", "bowl", "stone", "candle"])
    made = stage.one_of(
        [
            lambda: materials.plain(stage),
            lambda: materials.plain(stage, roughness=stage.between(0.02, 0.2)),
            lambda: materials.metal(stage, stage.between(0.1, 0.5)),
            lambda: materials.patterned(
                stage,
                stage.one_of(list(materials.PATTERNS)),
                stage.between(8, 40),
                [materials.color(stage)] * 2 + [materials.pale(stage)],
            ),
        ]
    )()
    if kind == "vase":
        vase(stage, at, size, made, parent)
    elif kind == "ball":
        stage.add(shapes.ball(size / 3), made, (x, y, z + size / 3), smooth=True, parent=parent)
    elif kind == "box":
        block = shapes.box(size * stage.between(0.4, 1), size * 0.5, size * stage.between(0.2, 0.9))
        stage.add(block, made, at, turn=(0, 0, stage.between(0, 3)), bevel=0.004, parent=parent)
    elif kind == "bowl":
        r = size / 2
        outer = [(r * math.sin(a), r * 0.6 * (1 - math.cos(a))) for a in (0.3, 0.6, 0.9, 1.2, 1.5)]
        bowl = [(0, 0), *outer, *((0.93 * p, q + 0.004) for p, q in reversed(outer)), (0, 0.02)]
        stage.add(shapes.turned(bowl), made, at, smooth=True, parent=parent)
    elif kind == "stone":
        stage.add(shapes.stone(stage.rng, size / 3), made, (x, y, z + size * 0.22), smooth=True, parent=parent)
    else:
        stage.add(shapes.cylinder(size / 6, size * 0.8, 20), made, at, parent=parent)


def picture(stage: Stage, at: Point, heading: float, width: float, height: float) -> None:
    """A framed picture on a wall; its motif is a pattern."""
    base = stage.group(at, (0, 0, heading))
    frame = materials.wood(stage) if stage.chance(0.6) else materials.metal(stage, 0.3)
    motif = materials.patterned(
        stage,
        stage.one_of(["noise", "mosaic", "magic", "checker", "wood", "cells"]),
        stage.between(2, 9),
        [materials.color(stage) for _ in range(stage.count(2, 5))],
        roughness=stage.between(0.2, 0.8),
    )
    stage.add(
        shapes.box(width + 0.06, 0.03, height + 0.06), frame, (0, 0, -height / 2 - 0.03), bevel=0.006, parent=base
    )
    stage.add(shapes.sheet(width, height), motif, (0, -0.018, 0), turn=(math.pi / 2, 0, 0), parent=base)


def rug(stage: Stage, at: Point, length: float, depth: float) -> None:
    """A patterned rug."""
    shades = [materials.color(stage) for _ in range(stage.count(2, 4))]
    pattern = stage.one_of(["checker", "magic", "mosaic", "noise"])
    made = materials.patterned(
        stage, pattern, stage.between(3, 8), shades, roughness=0.95, bump=0.3, bump_pattern="noise"
    )
    stage.add(shapes.box(length, depth, 0.012), made, at, turn=(0, 0, stage.between(-0.2, 0.2)))


def plant_pot(stage: Stage, at: Point, height: float) -> None:
    """A potted plant: bent stems with flat leaves of mesh."""
    pot = materials.plain(stage, roughness=stage.between(0.2, 0.9))
    x, y, z = at
    wide = 0.16 * height
    profile = [
        (0, 0),
        (wide * 0.8, 0),
        (wide, 0.3 * height),
        (wide * 0.9, 0.3 * height),
        (wide * 0.85, 0.27 * height),
        (0, 0.27 * height),
    ]
    stage.add(shapes.turned(profile), pot, at, smooth=False)
    leaf = materials.plain(stage, materials.green(stage), stage.between(0.3, 0.7))
    parts = []
    for _ in range(stage.count(14, 30)):
        heading, rise, long = stage.between(0, 6.28), stage.between(0.4, 1.35), height * stage.between(0.35, 0.75)
        parts.append((_blade(heading, rise, long, stage.between(0.03, 0.09) * height), (0, 0, 0.27 * height)))
    stage.add(shapes.joined(parts), leaf, (x, y, z), smooth=True)


def _blade(heading: float, rise: float, long: float, wide: float) -> shapes.Mesh:
    """A leaf that rises and bends over."""
    vertices, faces = [], []
    c, s = math.cos(heading), math.sin(heading)
    steps = 7
    for i in range(steps + 1):
        t = i / steps
        out = long * t * math.cos(rise)
        up = long * (t * math.sin(rise) - 0.45 * t * t)
        w = wide * math.sin(math.pi * min(1.0, 0.08 + 0.92 * t)) * 0.5
        vertices += [(out * c - w * s, out * s + w * c, up), (out * c + w * s, out * s - w * c, up)]
    for i in range(steps):
        faces.append((2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2))
    return vertices, faces
