"""Rooms: walls, floor, windows, and furniture laid out along the walls. The camera's end is y = 0, left free."""

import math
from typing import Any, NamedTuple

from experiments.cycles.staging import furniture, materials, shapes
from experiments.cycles.staging.stage import Point, Stage


class Room(NamedTuple):
    """The size of a room: x from -width/2 to width/2, y from 0 to depth, z from 0 to height; metres."""

    width: float
    depth: float
    height: float

    @property
    def middle(self) -> Point:
        """A point above the middle of the floor's back half: what a camera looks at."""
        return (0.0, 0.62 * self.depth, 0.9)


def shell(stage: Stage, *, floor: Any = None, walls: Any = None) -> Room:
    """Floor, ceiling, four walls and skirting of a room of random size."""
    room = Room(stage.between(4.5, 7.5), stage.between(5.5, 8.5), stage.between(2.5, 3.3))
    w, d, h = room
    made = walls or stage.one_of([_paint, _paint, _paper, _brick])(stage)
    other = made if stage.chance(0.5) else _paint(stage)
    stage.add(shapes.sheet(w, d), floor or _floor(stage), (0, d / 2, 0))
    stage.add(shapes.sheet(w, d), materials.plain(stage, (0.8, 0.8, 0.78), 0.9), (0, d / 2, h), turn=(math.pi, 0, 0))
    stage.add(shapes.sheet(w, h), other, (0, d, h / 2), turn=(math.pi / 2, 0, 0))
    stage.add(shapes.sheet(w, h), made, (0, -0.3, h / 2), turn=(math.pi / 2, 0, math.pi))
    for side in (-1, 1):
        turn = (math.pi / 2, 0, side * math.pi / 2)
        stage.add(shapes.sheet(d + 0.6, h), made, (side * w / 2, d / 2, h / 2), turn=turn)
    board = materials.plain(stage, materials.pale(stage), 0.5)
    stage.add(shapes.box(w, 0.02, 0.09), board, (0, d - 0.01, 0), bevel=0.004)
    for side in (-1, 1):
        stage.add(shapes.box(0.02, d, 0.09), board, (side * (w / 2 - 0.01), d / 2, 0), bevel=0.004)
    return room


def _paint(stage: Stage) -> Any:
    return materials.plain(stage, materials.pale(stage), stage.between(0.6, 0.95))


def _paper(stage: Stage) -> Any:
    shades = [materials.pale(stage), materials.color(stage, (0.1, 0.5), (0.2, 0.7))]
    pattern = stage.one_of(["magic", "checker", "cells"])
    return materials.patterned(stage, pattern, stage.between(3, 9), shades, roughness=0.85, mix=stage.between(0.2, 0.6))


def _brick(stage: Stage) -> Any:
    shades = [materials.color(stage, (0.3, 0.6), (0.15, 0.35)), materials.pale(stage)]
    return materials.patterned(stage, "brick", stage.between(1.5, 3.0), shades, roughness=0.9, bump=0.6)


def _floor(stage: Stage) -> Any:
    tiles = [materials.pale(stage), materials.color(stage, (0.1, 0.5), (0.1, 0.5))]
    return stage.one_of(
        [
            lambda: materials.wood(stage),
            lambda: materials.patterned(
                stage, "checker", stage.between(1, 3), tiles, roughness=stage.between(0.05, 0.4)
            ),
            lambda: materials.patterned(stage, "noise", stage.between(1, 4), tiles, roughness=0.6, wear=True),
        ]
    )()


def furnish(stage: Stage, room: Room, *, crowd: float = 1.0, back: bool = True) -> None:
    """Things along the sides and the back, a group in the middle, pictures on the walls."""
    w, d, h = room
    if back:
        _line_wall(stage, (-w / 2 + 0.3, w / 2 - 0.3), lambda x: ((x, d - 0.28, 0), 0.0), h)
    for side in (-1, 1):
        _line_wall(
            stage,
            (2.6, d - 0.9),
            lambda y, side=side: ((side * (w / 2 - 0.28), y, 0), -side * math.pi / 2),
            h,
        )
    if stage.chance(0.75):
        furniture.rug(stage, (stage.between(-0.3, 0.3), 0.6 * d, 0), stage.between(2, 3), stage.between(1.5, 2.2))
    centre = (stage.between(-0.4, 0.4), stage.between(0.52, 0.62) * d, 0)
    if stage.chance(0.5):
        dining(stage, centre, crowd)
    else:
        lounge(stage, centre, crowd)


def dining(stage: Stage, at: Point, crowd: float = 1.0) -> None:
    """A laid table with chairs."""
    length, depth, height = stage.between(1.2, 1.9), stage.between(0.75, 0.95), 0.74
    x, y, _ = at
    furniture.table(stage, at, length, depth, height)
    wood, seat = materials.wood(stage), materials.cloth(stage)
    for sx in (-0.3, 0.3):
        for sy, heading in ((1, 0.0), (-1, math.pi)):
            if stage.chance(0.85):
                place = (x + sx * length, y + sy * (depth / 2 + stage.between(0.1, 0.35)), 0.0)
                furniture.chair(stage, place, heading + stage.between(-0.3, 0.3), wood, seat)
    for _ in range(int(crowd * stage.count(5, 10))):
        place = (x + stage.between(-0.4, 0.4) * length, y + stage.between(-0.38, 0.38) * depth, height)
        furniture.small_thing(stage, place, largest=0.22)


def lounge(stage: Stage, at: Point, crowd: float = 1.0) -> None:
    """A sofa, an armchair and a low table."""
    x, y, _ = at
    made = materials.cloth(stage)
    furniture.sofa(stage, (x, y + 1.05, 0), stage.between(-0.1, 0.1), stage.between(1.6, 2.3), made)
    side = stage.one_of([-1, 1])
    furniture.sofa(stage, (x + side * 1.5, y, 0), -side * stage.between(1.2, 1.7), 0.95, made)
    furniture.table(stage, (x, y, 0), 1.1, 0.6, 0.42)
    for _ in range(int(crowd * stage.count(4, 8))):
        place = (x + stage.between(-0.45, 0.45), y + stage.between(-0.2, 0.2), 0.42)
        furniture.small_thing(stage, place, largest=0.25)


def _line_wall(stage: Stage, span: tuple[float, float], place: Any, height: float) -> None:
    """Furniture along a wall, from one end of the span to the other."""
    start, end = span
    while start < end - 0.6:
        width = min(stage.between(0.8, 1.6), end - start)
        at, heading = place(start + width / 2)
        kind = stage.one_of(["shelf", "cabinet", "plant", "picture", "empty"])
        if kind == "shelf":
            furniture.shelf(stage, at, heading, width * 0.92, stage.between(1.3, min(2.3, height - 0.3)))
        elif kind == "cabinet":
            furniture.cabinet(stage, at, heading, width * 0.92, stage.between(0.6, 1.0))
        elif kind == "plant":
            furniture.plant_pot(stage, at, stage.between(0.8, 1.7))
        if kind in ("cabinet", "picture", "plant"):
            on_wall = _shifted(at, heading, 0.25)
            size = stage.between(0.35, min(0.8, width * 0.7))
            furniture.picture(
                stage, (*on_wall, stage.between(1.5, 1.75)), heading, size, size * stage.between(0.7, 1.2)
            )
        start += width + 0.05


def _shifted(at: Point, heading: float, back: float) -> tuple[float, float]:
    """A place moved back towards the wall behind it."""
    return at[0] - back * math.sin(heading), at[1] + back * math.cos(heading)
