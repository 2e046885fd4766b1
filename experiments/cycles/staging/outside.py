"""Streets and parks: the sky and its sun, ground, houses, trees, lamp posts, cars, fences."""

import math
from typing import Any

import numpy as np

from experiments.cycles.staging import materials, shapes
from experiments.cycles.staging.stage import Point, Stage


def daylight(stage: Stage, *, low: float = 15.0, high: float = 60.0, strength: float = 0.12) -> None:
    """A clear or hazy sky with its sun, between two heights above the horizon in degrees."""
    tree = stage.world.node_tree
    sky = tree.nodes.new("ShaderNodeTexSky")
    sky.sky_type = "MULTIPLE_SCATTERING"
    sky.sun_elevation = math.radians(stage.between(low, high))
    sky.sun_rotation = stage.between(0, 2 * math.pi)
    sky.sun_size = math.radians(stage.log_between(0.5, 2.0))
    tree.links.new(sky.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    tree.nodes["Background"].inputs["Strength"].default_value = strength * stage.log_between(0.7, 1.4)


def overcast(stage: Stage, strength: float) -> None:
    """A grey sky without sun."""
    stage.light_outside((0.72, 0.8, 0.9), strength)


def ground(stage: Stage, size: float = 160.0) -> None:
    """Grass or earth with low hills far away."""
    shades = [materials.green(stage), materials.brown(stage)]
    made = materials.patterned(stage, "noise", stage.between(0.3, 1.2), shades, roughness=0.95, bump=0.5)
    lift, phase = stage.between(1, 5), stage.between(0, 6)

    def hills(x: Any, y: Any) -> Any:
        away = ((x**2 + y**2) ** 0.5 / (0.5 * size)) ** 3
        return -0.02 + lift * away * (1.2 + np.sin(0.11 * x + phase) + np.cos(0.07 * y + 2 * phase))

    stage.add(shapes.surface(size, size, 40, hills), made, smooth=True)


def street(stage: Stage, width: float, length: float) -> None:
    """A road along y with kerbs, pavements and markings."""
    asphalt = materials.patterned(
        stage, "noise", 25.0, [(0.04, 0.04, 0.045), (0.1, 0.1, 0.1)], roughness=stage.between(0.5, 0.9), bump=0.3
    )
    stone = [materials.pale(stage), materials.color(stage, (0.0, 0.2), (0.15, 0.4))]
    pavement = materials.patterned(stage, "brick", stage.between(0.8, 1.6), stone, roughness=0.85, bump=0.4)
    stage.add(shapes.sheet(width, length), asphalt, (0, length / 2 - 10, 0.0))
    for side in (-1, 1):
        x = side * (width / 2 + 1.6)
        stage.add(shapes.box(3.2, length, 0.14), pavement, (x, length / 2 - 10, 0), bevel=0.02)
    paint = materials.plain(stage, (0.75, 0.75, 0.7), 0.7)
    for i in range(int(length / 5)):
        stage.add(shapes.sheet(0.14, 2.2), paint, (0, 5 * i - 9, 0.004))


def house(
    stage: Stage, at: Point, heading: float, width: float, depth: float, floors: int, *, lit: float = 0.0
) -> None:
    """A house with windows, a door and a roof; its front looks along -y; ``lit`` is the part of windows with light."""
    base = stage.group(at, (0, 0, heading))
    high = 3.0 * floors
    shade = materials.pale(stage) if stage.chance(0.6) else materials.color(stage, (0.3, 0.7), (0.2, 0.6))
    brick = [materials.color(stage, (0.4, 0.6), (0.1, 0.3)), materials.pale(stage)]
    wall = stage.one_of(
        [
            lambda: materials.plain(stage, shade, 0.9),
            lambda: materials.patterned(
                stage, "noise", 6.0, [shade, materials.pale(stage)], roughness=0.9, mix=0.4, bump=0.2
            ),
            lambda: materials.patterned(stage, "cells", 1.2, brick, roughness=0.9, mix=0.5, bump=0.4),
        ]
    )()
    stage.add(shapes.box(width, depth, high), wall, (0, 0, 0), parent=base)
    frame = materials.plain(stage, materials.pale(stage), 0.5)
    pane = materials.plain(stage, (0.03, 0.04, 0.05), 0.03)
    warm = materials.light(stage, materials.warm(stage), stage.log_between(0.6, 2.5))
    columns = max(2, int(width / 2.2))
    for floor in range(floors):
        for column in range(columns):
            x = -width / 2 + (column + 0.5) * width / columns
            z = 3.0 * floor + 1.0
            if floor == 0 and column == columns // 2:
                door = materials.plain(stage)
                stage.add(shapes.box(1.1, 0.1, 2.2), door, (x, -depth / 2, 0), bevel=0.02, parent=base)
                continue
            stage.add(shapes.box(1.15, 0.12, 1.5), frame, (x, -depth / 2, z), bevel=0.01, parent=base)
            shown = warm if stage.chance(lit) else pane
            for side in (-1, 1):
                glass = shapes.box(0.46, 0.02, 1.34)
                stage.add(glass, shown, (x + side * 0.27, -depth / 2 - 0.065, z + 0.08), parent=base)
            stage.add(shapes.box(1.3, 0.22, 0.06), frame, (x, -depth / 2 - 0.06, z - 0.06), parent=base)
    tiles = materials.patterned(stage, "brick", 2.0, brick, roughness=0.8, bump=0.5)
    if stage.chance(0.6):
        rise = stage.between(1.5, 3.0)
        eaves = 0.4
        x, y = width / 2 + eaves, depth / 2 + eaves
        roof = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0), (-x + eaves, 0, rise), (x - eaves, 0, rise)]
        sides = [(0, 1, 5, 4), (2, 3, 4, 5), (1, 2, 5), (3, 0, 4), (3, 2, 1, 0)]
        stage.add((roof, sides), tiles, (0, 0, high), parent=base)
        stage.add(shapes.box(0.6, 0.6, rise + 0.5), wall, (width * 0.25, 0.3, high), parent=base)
    else:
        stage.add(shapes.box(width + 0.4, depth + 0.4, 0.35), frame, (0, 0, high), bevel=0.03, parent=base)


def tree(stage: Stage, at: Point, height: float, *, leaf: Any = None) -> None:
    """A tree of branches with crowns of many small leaves of mesh."""
    x, y, z = at
    bark = materials.patterned(stage, "noise", 8.0, [(0.06, 0.04, 0.03), (0.2, 0.15, 0.1)], roughness=0.95, bump=0.6)
    tips = branches(stage, at, height, bark)
    made = leaf or materials.plain(stage, materials.green(stage), 0.6)
    parts = []
    for tip in tips:
        spread = 0.13 * height
        for _ in range(stage.count(110, 170)):
            shift = stage.rng.normal(size=3) * spread * (0.6, 0.6, 0.45)
            parts.append((small_leaf(stage, height * stage.between(0.035, 0.06)), tuple(tip - (x, y, z) + shift)))
    stage.add(shapes.joined(parts), made, at)


def branches(stage: Stage, at: Point, height: float, bark: Any) -> list[Any]:
    """A trunk and its branches; returns the ends of the branches."""
    root = np.asarray(at, float)
    lean = stage.rng.normal(size=3) * (0.06, 0.06, 0)
    trunk = [root + height * 0.7 * t * (np.array([0, 0, 1.0]) + lean * t) for t in np.linspace(0, 1, 6)]
    radii = [0.035 * height * (1 - 0.75 * t) for t in np.linspace(0, 1, 6)]
    stage.add(shapes.tube(trunk, radii), bark, smooth=True)
    tips = [trunk[-1]]
    for _ in range(stage.count(6, 9)):
        t = stage.between(0.4, 0.95)
        start = root + height * 0.7 * t * (np.array([0, 0, 1.0]) + lean * t)
        heading = stage.between(0, 2 * math.pi)
        out = (
            np.array([math.cos(heading), math.sin(heading), stage.between(0.4, 1.1)])
            * height
            * stage.between(0.2, 0.36)
        )
        points = [start + out * s + np.array([0, 0, 0.06 * height * s * s]) for s in np.linspace(0, 1, 5)]
        stage.add(
            shapes.tube(points, [0.012 * height * (1 - 0.8 * s) for s in np.linspace(0, 1, 5)]), bark, smooth=True
        )
        tips.append(points[-1])
    return tips


def small_leaf(stage: Stage, long: float) -> shapes.Mesh:
    """A leaf of two triangles, turned at random."""
    along = stage.rng.normal(size=3)
    along /= np.linalg.norm(along)
    side = np.cross(along, stage.rng.normal(size=3))
    side *= 0.3 / np.linalg.norm(side)
    points = [(0, 0, 0), tuple(long * (0.5 * along + side)), tuple(long * along), tuple(long * (0.5 * along - side))]
    return points, [(0, 1, 2), (0, 2, 3)]


def post(stage: Stage, at: Point, watts: float = 0.0) -> None:
    """A street lamp; with watts it shines."""
    x, y, z = at
    iron = materials.metal(stage, 0.5, (0.06, 0.07, 0.07))
    stage.add(shapes.turned([(0.09, 0), (0.07, 0.4), (0.035, 0.5), (0.03, 4.2)], 16), iron, at, smooth=True)
    head = (x, y, z + 4.36)
    if watts:
        stage.lamp("POINT", head, watts, materials.warm(stage), shadow_soft_size=0.15, seen=True)
    else:
        stage.add(shapes.ball(0.15, 20), materials.plain(stage, (0.8, 0.8, 0.75), 0.3), head, smooth=True)
    stage.add(shapes.turned([(0.26, 0), (0.03, 0.18)], 20), iron, (x, y, z + 4.48), smooth=True)


def car(stage: Stage, at: Point, heading: float, *, lit: bool = False) -> Any:
    """A car of a rounded body, a cabin of dark glass and four wheels; returns the group that moves it."""
    base = stage.group(at, (0, 0, heading))
    paint = materials.plain(
        stage, materials.color(stage, (0.0, 0.9), (0.05, 0.7)), stage.between(0.1, 0.4), Coat_Weight=1.0
    )
    glass = materials.plain(stage, (0.02, 0.025, 0.03), 0.03)
    black = materials.plain(stage, (0.015, 0.015, 0.015), 0.8)
    rim = materials.metal(stage, 0.25, (0.6, 0.6, 0.62))
    long = stage.between(3.6, 4.6)
    stage.add(shapes.box(1.7, long, 0.55), paint, (0, 0, 0.32), bevel=0.16, parent=base)
    stage.add(shapes.box(1.5, long * 0.5, 0.55), glass, (0, 0.1 * long, 0.8), bevel=0.22, parent=base)
    stage.add(shapes.box(1.3, long * 0.4, 0.06), paint, (0, 0.1 * long, 1.32), bevel=0.03, parent=base)
    for sx in (-1, 1):
        for sy in (-1, 1):
            wheel = (sx * 0.78 - 0.1, sy * 0.31 * long, 0.32)
            turn = (0, math.pi / 2, 0)
            stage.add(shapes.cylinder(0.32, 0.2, 28), black, wheel, turn=turn, bevel=0.03, parent=base)
            stage.add(shapes.cylinder(0.2, 0.22, 7), rim, (wheel[0] - 0.01, *wheel[1:]), turn=turn, parent=base)
        white = materials.light(stage, (1.0, 0.9, 0.75), 25.0) if lit else materials.plain(stage, (0.9, 0.9, 0.9), 0.1)
        red = materials.light(stage, (1.0, 0.03, 0.02), 6.0) if lit else materials.plain(stage, (0.5, 0.02, 0.02), 0.2)
        stage.add(shapes.ball(0.1, 14), white, (sx * 0.6, -long / 2 + 0.03, 0.6), smooth=True, parent=base)
        stage.add(shapes.box(0.3, 0.06, 0.1), red, (sx * 0.6, long / 2, 0.6), parent=base)
    return base


def fence(stage: Stage, start: Point, end: Point) -> None:
    """A fence of pickets."""
    made = materials.plain(stage, materials.pale(stage), 0.7) if stage.chance(0.5) else materials.wood(stage)
    long = math.dist(start, end)
    heading = math.atan2(end[1] - start[1], end[0] - start[0])
    picket = None
    count = int(long / 0.16)
    for i in range(count):
        t = i / count
        place = tuple(a + t * (b - a) for a, b in zip(start, end, strict=True))
        if picket is None:
            picket = stage.add(
                shapes.box(0.08, 0.02, stage.between(0.8, 1.2)), made, place, turn=(0, 0, heading), bevel=0.005
            )
        else:
            stage.again(picket, place, turn=(0, 0, heading))
    middle = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
    for z in (0.25, 0.65):
        stage.add(shapes.box(long, 0.03, 0.07), made, (middle[0], middle[1], z), turn=(0, 0, heading))
