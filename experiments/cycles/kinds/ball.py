"""A ball that rolls over a floor: its shading, its highlight and its contact shadow move with it."""

import math

from experiments.cycles.staging import cameras, furniture, lamps, materials, rooms, shapes
from experiments.cycles.staging.stage import Point, Stage


def build(stage: Stage) -> None:
    """A ball and a smaller one in a room with lamps of all sizes; the camera stays or follows."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room, crowd=0.6)
    _, d, h = room
    if stage.chance(0.5):
        lamps.ceiling_panel(stage, room, stage.log_between(50, 150))
    else:
        lamps.hanging(stage, (stage.between(-0.6, 0.6), 0.45 * d, h - 0.6), stage.log_between(100, 260), h)
    if stage.chance(0.6):
        lamps.window(stage, room, stage.log_between(30, 120))
    y = stage.between(1.9, 2.5)
    side = stage.one_of([-1, 1])
    way = stage.between(0.9, 1.8)
    rolling(stage, (-side * way / 2, y, 0), (side * way / 2, y + stage.between(-0.2, 0.4), 0), stage.between(0.22, 0.4))
    if stage.chance(0.6):
        start, end = (stage.between(0.4, 1.0), y + 0.6, 0), (stage.between(-1.0, -0.3), y - 0.5, 0)
        rolling(stage, start, end, stage.between(0.1, 0.16))
    for x in (-1.3, 1.4):
        furniture.small_thing(stage, (x, y + stage.between(0.1, 0.6), 0), largest=0.6)
    at = (stage.between(-0.3, 0.3), stage.between(0.0, 0.2), stage.between(0.9, 1.5))
    aim = (0.0, y + 0.3, 0.3)
    if stage.chance(0.4):
        path = cameras.dolly(stage, at, aim, 0.0)
    else:
        path = cameras.some_path(stage, at, aim, stage.between(0.25, 0.8))
    cameras.film(stage, path, lens=stage.between(22, 30))


def rolling(stage: Stage, start: Point, end: Point, radius: float) -> None:
    """A ball that rolls from one place to another without slipping."""
    kind = stage.one_of(["plain", "glossy", "metal", "pattern"])
    shades = [materials.color(stage) for _ in range(3)]
    made = {
        "plain": lambda: materials.plain(stage),
        "glossy": lambda: materials.plain(stage, roughness=stage.between(0.05, 0.25), Coat_Weight=1.0),
        "metal": lambda: materials.metal(stage, stage.between(0.1, 0.4)),
        "pattern": lambda: materials.patterned(stage, "checker", 1.5 / radius, shades, roughness=0.4),
    }[kind]()
    body = stage.add(shapes.ball(radius, 48), made, start, smooth=True)
    way = math.dist(start, end)
    heading = math.atan2(end[1] - start[1], end[0] - start[0])

    def path(t: float) -> tuple[Point, Point]:
        x, y = (a + t * (b - a) for a, b in zip(start[:2], end[:2], strict=True))
        return (x, y, radius), (0.0, t * way / radius, heading)

    stage.move(body, path)
