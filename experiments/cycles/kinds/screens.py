"""A street at night or a control room, lit by screens and signs whose texture shines."""

import math

from experiments.cycles.kinds.sun import row_of_houses
from experiments.cycles.staging import cameras, furniture, lamps, materials, outside, rooms, shapes
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """One of the two."""
    if stage.chance(0.5):
        _night(stage)
    else:
        _control_room(stage)


def sign(stage: Stage, low: float, high: float) -> object:
    """A surface whose pattern shines."""
    pattern = stage.one_of(["noise", "mosaic", "checker", "magic", "brick", "cells"])
    shades = [(0.0, 0.0, 0.0)] + [materials.color(stage, (0.4, 0.95), (0.4, 1.0)) for _ in range(stage.count(2, 4))]
    shine = stage.log_between(low, high)
    return materials.patterned(stage, pattern, stage.log_between(1.5, 9), shades, roughness=0.4, shine=shine)


def _night(stage: Stage) -> None:
    stage.light_outside((0.1, 0.14, 0.3), stage.between(0.02, 0.1))
    row_of_houses(stage, lit=0.35, posts=stage.log_between(100, 400))
    for side in (-1, 1):
        for i in range(stage.count(2, 4)):
            place = (side * stage.between(4.4, 5.2), 3 + 6 * i + stage.between(-1, 1), stage.between(1.6, 3.6))
            turn = (math.pi / 2, 0, -side * math.pi / 2 if stage.chance(0.5) else 0.0)
            stage.add(
                shapes.sheet(stage.between(0.8, 2.2), stage.between(0.6, 1.4)), sign(stage, 2, 8), place, turn=turn
            )
    moving = outside.car(stage, (-1.4, 12, 0), 0.0, lit=True)
    stage.move(moving, lambda t: ((-1.4, 13 - 4 * t, 0), None))
    at = (stage.between(-2, 2), stage.between(-5, -3), stage.between(1.4, 2.2))
    cameras.film(stage, cameras.some_path(stage, at, (0, 12, 2.0), stage.between(0.8, 3.0)))


def _control_room(stage: Stage) -> None:
    room = rooms.shell(stage)
    rooms.furnish(stage, room, back=False)
    w, d, _ = room
    wide = stage.between(1.2, 1.8)
    for column in range(-1, 2):
        for z in (1.25, 2.05):
            at = (column * (wide + 0.08), d - 0.12, z)
            stage.add(
                shapes.box(wide + 0.05, 0.08, 0.75),
                materials.plain(stage, (0.02, 0.02, 0.02), 0.3),
                (at[0], at[1] + 0.02, z - 0.375),
            )
            screen = stage.add(
                shapes.sheet(wide, 0.7), sign(stage, 1.0, 4.0), (at[0], at[1] - 0.03, z), turn=(math.pi / 2, 0, 0)
            )
            if stage.chance(0.6):
                _scroll(stage, screen)
    furniture.table(stage, (0, 0.55 * d, 0), 2.4, 0.8, 0.75)
    for x in (-0.8, 0.0, 0.8):
        at = (x, 0.55 * d, 0.98)
        stage.add(shapes.box(0.56, 0.03, 0.36), materials.plain(stage, (0.03, 0.03, 0.03), 0.4), (x, at[1] + 0.02, 0.8))
        stage.add(shapes.sheet(0.52, 0.32), sign(stage, 1.0, 4.0), (x, at[1] - 0.0, 0.98), turn=(math.pi / 2, 0, 0))
    if stage.chance(0.6):
        lamps.ceiling_panel(stage, room, stage.log_between(4, 20))
    at = (stage.between(-0.25, 0.25) * w, stage.between(0.2, 0.7), stage.between(1.4, 1.8))
    cameras.film(stage, cameras.some_path(stage, at, (0, 0.7 * d, 1.2), stage.between(0.5, 1.4)))


def _scroll(stage: Stage, screen: object) -> None:
    """Let the pattern of a screen move."""
    tree = screen.data.materials[0].node_tree  # type: ignore[attr-defined]
    shift = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeMapping").inputs["Location"]
    start, speed = tuple(shift.default_value), stage.between(-1.5, 1.5)
    for frame in stage.times:
        shift.default_value = (start[0] + speed * frame / stage.frames, *start[1:])
        shift.keyframe_insert("default_value", frame=frame)
