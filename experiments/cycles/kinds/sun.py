"""A street of houses under sun and sky."""

from experiments.cycles.staging import cameras, outside
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """Two rows of houses, trees, cars, one of them driving, a camera that moves along."""
    outside.daylight(stage)
    row_of_houses(stage)
    road = 6.0
    for i in range(stage.count(2, 4)):
        side = stage.one_of([-1, 1])
        outside.car(stage, (side * (road / 2 - 1.1), 4 + 6 * i + stage.between(-1, 1), 0), 0.0 if side < 0 else 3.1416)
    moving = outside.car(stage, (1.2, 14, 0), 3.1416)
    start, way = stage.between(6, 16), stage.between(-6, 6)
    stage.move(moving, lambda t: ((0.4, start + way * t, 0), None))
    at = (stage.between(-2.5, 2.5), stage.between(-5, -2), stage.between(1.4, 2.4))
    aim = (stage.between(-3, 3), 14.0, stage.between(1.5, 3.5))
    cameras.film(stage, cameras.some_path(stage, at, aim, stage.between(0.8, 3.0)))


def row_of_houses(stage: Stage, *, lit: float = 0.0, posts: float = 0.0) -> None:
    """A street with houses on both sides, trees, posts and fences."""
    outside.ground(stage)
    road = 6.0
    outside.street(stage, road, 70)
    for side in (-1, 1):
        y = stage.between(-4, 1)
        while y < 38:
            width = stage.between(6, 10)
            x = side * (road / 2 + 3.4 + stage.between(3.0, 5.0))
            outside.house(stage, (x, y + width / 2, 0), -side * 1.5708, width, 7.0, stage.count(1, 3), lit=lit)
            y += width + stage.between(0.5, 3.5)
        for i in range(stage.count(2, 4)):
            place = (side * (road / 2 + stage.between(1.6, 2.8)), 4 + 7 * i + stage.between(-1.5, 1.5), 0.1)
            outside.tree(stage, place, stage.between(3.5, 6.0))
        for i in range(4):
            outside.post(stage, (side * (road / 2 + 0.4), 1 + 9 * i, 0.1), posts)
        if stage.chance(0.6):
            outside.fence(stage, (side * 6.4, 0, 0.1), (side * 6.4, stage.between(8, 16), 0.1))
