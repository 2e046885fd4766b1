"""A person walks through a room or along a street."""

from experiments.cycles.kinds.sun import row_of_houses
from experiments.cycles.staging import cameras, figure, lamps, outside, rooms
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """One figure in a room, or several in a street; the camera may follow."""
    if stage.chance(0.6):
        _room(stage)
    else:
        _street(stage)


def _room(stage: Stage) -> None:
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    w, d, h = room
    if stage.chance(0.5):
        lamps.window(stage, room, stage.log_between(60, 180))
        lamps.ceiling_panel(stage, room, stage.log_between(20, 70))
    else:
        lamps.hanging(stage, (0.3, 0.5 * d, h - 0.7), stage.log_between(40, 110), h)
        lamps.ceiling_panel(stage, room, stage.log_between(20, 70))
    side = stage.one_of([-1, 1])
    y = stage.between(2.0, 2.6)
    start, end = (
        (side * stage.between(0.7, 1.1), y, 0),
        (-side * stage.between(0.1, 0.6), y + stage.between(-0.3, 0.6), 0),
    )
    figure.walker(stage, start, end)
    at = (stage.between(-0.15, 0.15) * w, -0.15, stage.between(1.2, 1.6))
    aim = (0.2 * side, 0.5 * d, 0.95)
    cameras.film(stage, cameras.some_path(stage, at, aim, stage.between(0.25, 0.8)), lens=stage.between(18, 23))


def _street(stage: Stage) -> None:
    outside.daylight(stage)
    row_of_houses(stage)
    for i in range(stage.count(2, 4)):
        x, y = stage.between(-3.6, 3.6), 2.5 + 2.5 * i
        way = stage.between(1.0, 1.6)
        if stage.chance(0.5):
            figure.walker(stage, (x, y, 0.14 if abs(x) > 3 else 0), (x, y + way, 0.14 if abs(x) > 3 else 0))
        else:
            x = stage.between(-1.8, 0.6)
            figure.walker(stage, (x, y, 0), (x + way, y, 0))
    at = (stage.between(-1.5, 1.5), stage.between(-3.5, -2), stage.between(1.4, 1.9))
    cameras.film(stage, cameras.some_path(stage, at, (0, 6, 1.2), stage.between(0.5, 1.6)), lens=stage.between(26, 34))
