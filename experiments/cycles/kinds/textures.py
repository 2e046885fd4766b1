"""A gallery of patterned things: posters, tiles, cloths, marble, mosaics, fine and coarse."""

import math

from experiments.cycles.staging import cameras, furniture, lamps, materials, rooms, shapes
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """Patterned walls and floor, plinths with patterned bodies, pictures, soft light."""
    room = rooms.shell(stage, floor=some_pattern(stage, 1.0, 4.0), walls=some_pattern(stage, 1.0, 5.0, mix=0.5))
    w, d, _ = room
    lamps.ceiling_panel(stage, room, stage.log_between(70, 180))
    lamps.ceiling_panel(stage, room, stage.log_between(40, 120))
    for x in (-0.33 * w, 0.0, 0.33 * w):
        furniture.picture(stage, (x, d - 0.05, 1.65), 0.0, stage.between(0.7, 1.1), stage.between(0.7, 1.2))
    for side in (-1, 1):
        for y in (0.45 * d, 0.75 * d):
            heading = -side * math.pi / 2
            furniture.picture(stage, (side * (w / 2 - 0.04), y, 1.6), heading, stage.between(0.7, 1.2), 0.9)
    furniture.rug(stage, (0, 0.6 * d, 0.0), 2.6, 2.0)
    for i in range(stage.count(6, 9)):
        x, y = stage.between(-0.4, 0.4) * w, stage.between(0.4, 0.88) * d
        high = stage.between(0.4, 1.0)
        stage.add(shapes.box(0.5, 0.5, high), some_pattern(stage, 2, 9), (x, y, 0), turn=(0, 0, i * 0.4), bevel=0.01)
        size = stage.between(0.18, 0.26)
        if stage.chance(0.5):
            body = stage.add(shapes.ball(size), some_pattern(stage, 4, 20), (x, y, high + size), smooth=True)
            speed = stage.between(-1.5, 1.5)
            stage.move(body, lambda t, speed=speed: (None, (0, 0, speed * t)))  # type: ignore[misc]
        else:
            furniture.vase(stage, (x, y, high), 2.4 * size, some_pattern(stage, 4, 20))
    at = (stage.between(-0.25, 0.25) * w, stage.between(0.2, 0.8), stage.between(1.3, 1.7))
    cameras.film(stage, cameras.some_path(stage, at, (0, 0.65 * d, 1.0), stage.between(0.5, 1.6)))


def some_pattern(stage: Stage, low: float, high: float, mix: float = 1.0) -> object:
    """A pattern of two to five colours with any gloss."""
    pattern = stage.one_of(list(materials.PATTERNS))
    shades = [materials.color(stage) for _ in range(stage.count(2, 5))]
    rough = stage.one_of([stage.between(0.05, 0.3), stage.between(0.4, 0.9)])
    return materials.patterned(stage, pattern, stage.log_between(low, high), shades, roughness=rough, mix=mix)
