"""A workshop: pipes, wheels, tools and sheets of rough, brushed and worn metal."""

import math

from experiments.cycles.staging import cameras, furniture, lamps, materials, rooms, shapes
from experiments.cycles.staging.stage import Point, Stage


def build(stage: Stage) -> None:
    """A bench with metal things, pipes along the walls, a wheel that turns, panels and a window."""
    shade = materials.color(stage, (0.05, 0.3), (0.25, 0.5))
    wall = materials.patterned(stage, "noise", 3.0, [shade, materials.pale(stage)], roughness=0.8, mix=0.5, bump=0.3)
    floor = materials.patterned(stage, "noise", 2.0, [(0.2, 0.2, 0.2), (0.4, 0.39, 0.37)], roughness=0.5, wear=True)
    room = rooms.shell(stage, floor=floor, walls=wall)
    w, d, h = room
    lamps.ceiling_panel(stage, room, stage.log_between(60, 160))
    lamps.window(stage, room, stage.log_between(60, 200))
    for i in range(stage.count(3, 6)):
        _pipe(stage, room, stage.between(0.3, h - 0.3), stage.between(0.03, 0.09), d - 0.15 - 0.08 * i)
    for x in (-0.3 * w, 0.3 * w):
        furniture.shelf(stage, (x, d - 0.3, 0), 0.0, 1.3, stage.between(1.2, 1.9))
    bench = (stage.between(-0.3, 0.3), 0.5 * d, 0)
    furniture.table(stage, bench, 2.2, 0.9, 0.85, top=brushed(stage))
    for _ in range(stage.count(16, 28)):
        place = (bench[0] + stage.between(-1.0, 1.0), bench[1] + stage.between(-0.38, 0.38), 0.85)
        piece(stage, place)
    for _ in range(stage.count(4, 8)):
        _drum(stage, (stage.one_of([-1, 1]) * stage.between(1.5, w / 2 - 0.4), stage.between(0.45, 0.9) * d, 0))
    _wheel(stage, (bench[0] + stage.between(-0.6, 0.6), bench[1] + 0.1, 1.2))
    at = (bench[0] + stage.between(-0.9, 0.9), bench[1] - stage.between(1.7, 2.2), stage.between(1.2, 1.6))
    path = cameras.some_path(stage, at, (bench[0], bench[1] + 0.1, 0.95), stage.between(0.2, 0.6))
    cameras.film(stage, path, lens=stage.between(24, 34))


def brushed(stage: Stage) -> object:
    """Some metal: rough, brushed, or worn in spots."""
    tints = [(0.6, 0.6, 0.62), (0.85, 0.65, 0.3), (0.9, 0.5, 0.35), (0.35, 0.36, 0.38)]
    if stage.chance(0.5):
        return materials.metal(stage, stage.between(0.15, 0.55), anisotropic=stage.one_of([0.0, 0.5, 0.8]))
    shades = [stage.one_of(tints), stage.one_of(tints)]
    pattern = stage.one_of(["noise", "wood", "cells"])
    return materials.patterned(stage, pattern, stage.between(6, 30), shades, metallic=1.0, mix=0.5, bump=0.1, wear=True)


def piece(stage: Stage, at: Point) -> None:
    """A nut, a shaft, a ring, a ball, a block or a cup of metal."""
    made = brushed(stage)
    x, y, z = at
    size = stage.between(0.03, 0.11)
    kind = stage.one_of(["nut", "shaft", "ring", "ball", "block", "cup"])
    turn = (0, 0, stage.between(0, 6))
    if kind == "nut":
        stage.add(shapes.cylinder(size, size * 0.8, 6), made, at, turn=turn, bevel=0.004)
    elif kind == "shaft":
        lying = (math.pi / 2, 0, turn[2])
        stage.add(shapes.cylinder(size / 3, size * 5, 24), made, (x, y, z + size / 3), turn=lying, bevel=0.003)
    elif kind == "ring":
        stage.add(shapes.ring(size, size / 4), made, (x, y, z + size / 4), smooth=True)
    elif kind == "ball":
        stage.add(shapes.ball(size), made, (x, y, z + size), smooth=True)
    elif kind == "block":
        stage.add(shapes.box(2 * size, size, size), made, at, turn=turn, bevel=0.006)
    else:
        furniture.vase(stage, at, 2 * size, made)


def _pipe(stage: Stage, room: rooms.Room, z: float, radius: float, y: float) -> None:
    """A pipe along the back wall that bends up."""
    w, _, h = room
    bend = stage.between(-0.3, 0.3) * w
    points = [
        (-w / 2, y, z),
        (bend - 0.3, y, z),
        (bend - 0.08, y, z),
        (bend, y, z + 0.08),
        (bend, y, z + 0.3),
        (bend, y, h),
    ]
    stage.add(shapes.tube(points, [radius] * len(points), 20), brushed(stage), smooth=True)
    for x in (-0.4 * w, -0.2 * w):
        flange = shapes.cylinder(radius * 1.5, 0.05, 24)
        stage.add(flange, brushed(stage), (x, y, z), turn=(0, math.pi / 2, 0), bevel=0.006)


def _drum(stage: Stage, at: Point) -> None:
    """An oil drum with ribs."""
    r, high = 0.26, stage.between(0.6, 0.9)
    profile = [(0, 0), (r, 0), (r, 0.3 * high), (r + 0.015, 0.33 * high), (r, 0.36 * high), (r, 0.64 * high)]
    profile += [
        (r + 0.015, 0.67 * high),
        (r, 0.7 * high),
        (r, high),
        (r - 0.02, high),
        (r - 0.02, high - 0.02),
        (0, high - 0.02),
    ]
    stage.add(shapes.turned(profile, 40), brushed(stage), at)


def _wheel(stage: Stage, at: Point) -> None:
    """A wheel with spokes on a stand, turning."""
    r = stage.between(0.2, 0.3)
    hub = stage.group(at)
    made = brushed(stage)
    stage.add(shapes.ring(r, 0.03, 40), made, turn=(math.pi / 2, 0, 0), smooth=True, parent=hub)
    for i in range(5):
        spoke = shapes.cylinder(0.015, r, 12)
        stage.add(spoke, made, turn=(0, 2 * math.pi * i / 5, 0), parent=hub)
    stage.add(shapes.cylinder(0.02, at[2] - 0.85, 12), brushed(stage), (at[0], at[1] + 0.06, 0.85))
    speed = stage.between(0.5, 2.5)
    stage.move(hub, lambda t: (None, (0, speed * t, 0)))
