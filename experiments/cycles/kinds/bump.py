"""A courtyard or hall of rough stone: bumped walls, cobbles, leather, hammered metal, in raking light."""

from experiments.cycles.staging import cameras, furniture, lamps, materials, outside, rooms, shapes
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """Bumped surfaces everywhere, lit from the side by a sun (open courtyard) or by spots (hall)."""
    room = (
        rooms.shell(stage, floor=rough_stone(stage, 3, 7), walls=rough_stone(stage, 1.5, 5))
        if stage.chance(0.5)
        else None
    )
    if room is None:
        outside.daylight(stage, low=18, high=40)
        room = rooms.Room(8.0, 8.0, 3.5)
        _courtyard(stage, room)
    else:
        _hall_lamps(stage, room)
    w, d, _ = room
    for _ in range(stage.count(14, 24)):
        x, y = stage.between(-0.36, 0.36) * w, stage.between(0.4, 0.85) * d
        size = stage.between(0.15, 0.4)
        made = rough_stone(stage, 6, 25) if stage.chance(0.6) else hammered(stage)
        kind = stage.one_of(["ball", "block", "vase", "stone", "column"])
        if kind == "ball":
            stage.add(shapes.ball(size), made, (x, y, size), smooth=True)
        elif kind == "block":
            turn = (0, 0, stage.between(0, 3))
            stage.add(shapes.box(size * 1.6, size, size), made, (x, y, 0), turn=turn, bevel=0.02)
        elif kind == "vase":
            furniture.vase(stage, (x, y, 0), 2.5 * size, made)
        elif kind == "stone":
            stage.add(shapes.stone(stage.rng, size * 1.2), made, (x, y, size * 0.7), smooth=True)
        else:
            profile = [(0.22, 0), (0.22, 0.1), (0.15, 0.18), (0.13, 1.5), (0.2, 1.6), (0.2, 1.7), (0, 1.7)]
            stage.add(shapes.turned(profile), made, (x, y, 0), smooth=True)
    at = (stage.between(-0.2, 0.2) * w, stage.between(0.3, 0.9), stage.between(0.9, 1.6))
    cameras.film(stage, cameras.some_path(stage, at, (0, 0.6 * d, 0.7), stage.between(0.5, 1.4)))


def rough_stone(stage: Stage, low: float, high: float) -> object:
    """A stone, plaster or leather that its bump makes rough."""
    shades = [materials.color(stage, (0.05, 0.45), (0.15, 0.6)), materials.color(stage, (0.05, 0.45), (0.15, 0.6))]
    return materials.patterned(
        stage,
        stage.one_of(["noise", "cells"]),
        stage.between(low, high),
        shades,
        roughness=stage.between(0.25, 0.9),
        mix=0.5,
        bump=stage.between(0.5, 1.0),
        bump_pattern=stage.one_of(["cells", "noise", "wood"]),
    )


def hammered(stage: Stage) -> object:
    """A metal with dents."""
    shades = [(0.8, 0.6, 0.35), (0.6, 0.6, 0.6)]
    return materials.patterned(
        stage, "cells", stage.between(10, 30), shades, metallic=1.0, roughness=stage.between(0.15, 0.45), bump=0.8
    )


def _courtyard(stage: Stage, room: rooms.Room) -> None:
    """Walls on three sides under the sky."""
    w, d, h = room
    outside.ground(stage, 60)
    stage.add(shapes.sheet(w + 8, d + 8), rough_stone(stage, 2, 5), (0, d / 2, 0.01))
    wall = rough_stone(stage, 1.5, 4)
    stage.add(shapes.box(w, 0.4, h), wall, (0, d, 0), bevel=0.05)
    for side in (-1, 1):
        stage.add(shapes.box(0.4, d * 0.7, h * stage.between(0.4, 1)), wall, (side * w / 2, 0.65 * d, 0), bevel=0.05)


def _hall_lamps(stage: Stage, room: rooms.Room) -> None:
    """Spots that rake over the walls and a soft panel."""
    w, d, h = room
    for side in (-1, 1):
        at = (side * (w / 2 - 0.35), stage.between(0.35, 0.6) * d, h - 0.3)
        lamps.spot(stage, at, (side * stage.between(0.2, 1.0), d * 0.8, 0.3), stage.log_between(150, 400), 75)
    lamps.ceiling_panel(stage, room, stage.log_between(25, 70))
