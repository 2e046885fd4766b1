"""Lamps in rooms and daylight through windows, with strengths drawn by the seed."""

import math
from typing import Any

from mathutils import Vector

from experiments.cycles.staging import materials, shapes
from experiments.cycles.staging.rooms import Room
from experiments.cycles.staging.stage import Point, Stage


def hanging(stage: Stage, at: Point, watts: float, ceiling: float) -> Any:
    """A glowing ball of five to eleven centimetres' radius on a cord. Returns Blender's lamp."""
    x, y, z = at
    radius = stage.between(0.05, 0.11)
    cord, collar = materials.plain(stage, (0.02, 0.02, 0.02)), materials.metal(stage, stage.between(0.2, 0.5))
    stage.add(shapes.cylinder(0.005, ceiling - z - radius, 8), cord, (x, y, z + radius))
    stage.add(shapes.cylinder(0.02, 0.06, 16), collar, (x, y, z + radius))
    return stage.lamp("POINT", at, watts, materials.warm(stage), shadow_soft_size=radius, seen=True)


def standing(stage: Stage, at: Point, height: float, watts: float) -> Any:
    """A floor or table lamp: a glowing ball on a foot. Returns Blender's lamp."""
    x, y, z = at
    foot = materials.metal(stage, stage.between(0.1, 0.5)) if stage.chance(0.6) else materials.wood(stage)
    radius = stage.between(0.06, 0.13)
    stage.add(shapes.cylinder(0.12, 0.02, 24), foot, at, bevel=0.005)
    stage.add(shapes.cylinder(0.012, height - radius, 12), foot, at)
    place = (x, y, z + height)
    return stage.lamp("POINT", place, watts, materials.warm(stage), shadow_soft_size=radius, seen=True)


def candle(stage: Stage, at: Point) -> Any:
    """A candle with a small flame. Returns Blender's lamp."""
    x, y, z = at
    height = stage.between(0.08, 0.22)
    stage.add(shapes.cylinder(0.022, height, 16), materials.plain(stage, (0.85, 0.8, 0.65), 0.5), at, bevel=0.004)
    stage.add(shapes.cylinder(0.001, 0.012, 6), materials.plain(stage, (0.01, 0.01, 0.01)), (x, y, z + height))
    place = (x, y, z + height + 0.02)
    tint = (1.0, stage.between(0.4, 0.6), 0.15)
    return stage.lamp("POINT", place, stage.log_between(0.3, 1.2), tint, shadow_soft_size=0.01, seen=True)


def window(stage: Stage, room: Room, watts: float, *, side: int | None = None) -> Any:
    """A bright window in a side wall: a lit pane of area light behind a cross of wood. Returns Blender's lamp."""
    sign = side or stage.one_of([-1, 1])
    wide, tall = stage.between(1.0, 2.0), stage.between(1.1, 1.6)
    x, y, z = sign * (room.width / 2 - 0.03), stage.between(0.4, 0.7) * room.depth, 1.55
    sky = (0.75, 0.87, 1.0) if stage.chance(0.6) else (1.0, 0.85, 0.65)
    turn = (math.pi / 2, 0, -sign * math.pi / 2)
    stage.add(shapes.sheet(wide, tall), materials.light(stage, sky, watts / 60), (x, y, z), turn=turn)
    frame = materials.plain(stage, (0.8, 0.8, 0.78), 0.4)
    inward = x - sign * 0.02
    for shift in (-0.5, 0.0, 0.5):
        stage.add(shapes.box(0.05, 0.06, tall + 0.06), frame, (inward, y + shift * wide, z - tall / 2 - 0.03))
        stage.add(shapes.box(0.05, wide + 0.06, 0.06), frame, (inward, y, z + shift * tall - 0.03))
    aim = (0.0, y, 0.6)
    lamp = stage.lamp("AREA", (x - sign * 0.06, y, z), watts, sky, shape="RECTANGLE", size=wide, size_y=tall, aim=aim)
    lamp.rotation_euler = (0, sign * math.pi / 2, 0)
    return lamp


def ceiling_panel(stage: Stage, room: Room, watts: float, color: materials.Color = (1.0, 0.95, 0.88)) -> Any:
    """A soft panel below the ceiling. Returns Blender's lamp."""
    at = (stage.between(-0.8, 0.8), stage.between(0.45, 0.65) * room.depth, room.height - 0.06)
    side = stage.between(0.3, 1.2)
    stage.add(shapes.box(side + 0.04, side + 0.04, 0.04), materials.metal(stage, 0.4), (*at[:2], at[2] + 0.01))
    return stage.lamp("AREA", at, watts, color, size=side, seen=True)


def spot(stage: Stage, at: Point, aim: Point, watts: float, degrees: float = 45.0) -> Any:
    """A spotlight with a housing. Returns Blender's lamp."""
    made = stage.lamp(
        "SPOT",
        at,
        watts,
        materials.warm(stage),
        aim=aim,
        spot_size=math.radians(degrees),
        spot_blend=0.4,
        shadow_soft_size=0.03,
    )
    housing = stage.add(shapes.cylinder(0.07, 0.16, 20), materials.metal(stage, 0.3, (0.1, 0.1, 0.1)), at)
    housing.rotation_euler = made.rotation_euler
    housing.location = Vector(at) + made.rotation_euler.to_matrix() @ Vector((0, 0, 0.03))
    return made
