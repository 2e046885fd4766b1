"""A laid table with glasses and bottles, and mirrors on the walls."""

import math

from experiments.cycles.staging import cameras, furniture, lamps, materials, rooms, shapes
from experiments.cycles.staging.stage import Point, Stage


def build(stage: Stage) -> None:
    """A room with daylight and a panel; glass on the table, mirrors behind it."""
    room = rooms.shell(stage)
    w, d, _ = room
    rooms.furnish(stage, room, crowd=0.3)
    lamps.window(stage, room, stage.log_between(100, 250))
    lamps.ceiling_panel(stage, room, stage.log_between(50, 150))
    for x in (-0.25 * w, 0.2 * w):
        _mirror(stage, (x + stage.between(-0.2, 0.2), d - 0.05, stage.between(1.4, 1.7)))
    middle = (stage.between(-0.3, 0.3), 2.5, 0)
    furniture.table(stage, middle, 1.7, 0.9, 0.76)
    for _ in range(stage.count(9, 15)):
        x, y = stage.between(-0.7, 0.7), stage.between(-0.36, 0.36)
        stage.one_of([bottle, goblet, goblet, tumbler])(stage, (middle[0] + x, middle[1] + y, 0.76))
    for _ in range(4):
        place = (middle[0] + stage.between(-0.6, 0.6), middle[1] + stage.between(-0.3, 0.3), 0.76)
        furniture.small_thing(stage, place, largest=0.18)
    at = (middle[0] + stage.between(-0.7, 0.7), stage.between(0.6, 1.1), stage.between(1.1, 1.45))
    path = cameras.some_path(stage, at, (middle[0], 2.6, 0.92), stage.between(0.2, 0.7))
    cameras.film(stage, path, lens=stage.between(36, 48))


def _mirror(stage: Stage, at: Point) -> None:
    """A mirror in a frame, round or square."""
    x, y, z = at
    frame = materials.metal(stage, 0.25) if stage.chance(0.5) else materials.wood(stage)
    size = stage.between(0.5, 0.8)
    turn = (math.pi / 2, 0, 0)
    if stage.chance(0.5):
        stage.add(shapes.cylinder(size / 2, 0.01, 64), materials.mirror(stage), (x, y, z), turn=turn)
        stage.add(shapes.ring(size / 2, 0.025, 64), frame, (x, y, z), turn=turn, smooth=True)
    else:
        stage.add(shapes.box(size + 0.1, 0.03, 1.3), frame, (x, y, z - 0.65), bevel=0.01)
        stage.add(shapes.sheet(size, 1.2), materials.mirror(stage), (x, y - 0.02, z), turn=turn)


def bottle(stage: Stage, at: Point) -> None:
    """A bottle of tinted glass with a wall of its own thickness."""
    high, wide = stage.between(0.22, 0.32), stage.between(0.033, 0.045)
    outer = [(0, 0), (wide, 0.005), (wide, 0.6 * high), (0.35 * wide, 0.78 * high), (0.33 * wide, high)]
    inner = [(r - 0.004, max(z, 0.01)) for r, z in reversed(outer[1:])]
    tint = stage.one_of([(0.5, 0.85, 0.55), (0.85, 0.6, 0.3), (0.9, 0.95, 1.0), (0.4, 0.55, 0.9)])
    made = materials.glass(stage, tint, stage.one_of([0.0, 0.0, 0.15]))
    stage.add(shapes.turned([*outer, *inner, (0, 0.01)]), made, at, smooth=True)


def goblet(stage: Stage, at: Point) -> None:
    """A wine glass."""
    high, wide = stage.between(0.16, 0.22), stage.between(0.032, 0.044)
    outer = [
        (0, 0),
        (wide, 0.003),
        (0.005, 0.012),
        (0.004, 0.45 * high),
        (wide * 0.8, 0.55 * high),
        (wide, 0.75 * high),
        (wide * 0.85, high),
    ]
    inner = [(r - 0.0015, z) for r, z in reversed(outer[4:])]
    stage.add(shapes.turned([*outer, *inner, (0, 0.49 * high)]), materials.glass(stage), at, smooth=True)


def tumbler(stage: Stage, at: Point) -> None:
    """A straight glass, tinted or clear, sometimes of metal."""
    high, wide = stage.between(0.08, 0.13), stage.between(0.03, 0.04)
    outer = [(0, 0), (wide * 0.9, 0), (wide, high)]
    inner = [(wide - 0.003, high), (wide * 0.9 - 0.003, 0.012), (0, 0.012)]
    tint = stage.one_of([(1.0, 1.0, 1.0), materials.color(stage, (0.2, 0.7), (0.7, 0.95))])
    made = materials.metal(stage, 0.15) if stage.chance(0.2) else materials.glass(stage, tint)
    stage.add(shapes.turned([*outer, *inner]), made, at, smooth=True)
