"""A furnished room at night, lit by several small lamps."""

from experiments.cycles.staging import cameras, furniture, lamps, rooms
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """The room, three to six lamps in it, a camera that moves slowly."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    light_room(stage, room)
    view(stage, room)


def light_room(stage: Stage, room: rooms.Room) -> None:
    """A hanging lamp, lamps that stand about, a few candles."""
    w, d, h = room
    lamps.hanging(
        stage, (stage.between(-0.6, 0.6), 0.58 * d, h - stage.between(0.7, 1.0)), stage.log_between(80, 220), h
    )
    for side in (-1, 1):
        if stage.chance(0.8):
            place = (side * (w / 2 - stage.between(0.6, 0.9)), stage.between(0.45, 0.9) * d, 0)
            lamps.standing(stage, place, stage.between(1.2, 1.6), stage.log_between(25, 80))
    if stage.chance(0.5):
        at = (stage.between(-0.25, 0.25) * w, d - 0.7, 0)
        furniture.cabinet(stage, at, 0.0, 0.7, 0.6)
        lamps.standing(stage, (at[0], at[1], 0.6), 0.35, stage.log_between(15, 50))


def view(stage: Stage, room: rooms.Room) -> None:
    """A camera at the free end of the room."""
    at = (stage.between(-0.3, 0.3) * room.width, stage.between(0.2, 0.9), stage.between(1.2, 1.75))
    x, y, z = room.middle
    aim = (x + stage.between(-0.7, 0.7), y, z + stage.between(-0.2, 0.3))
    cameras.film(stage, cameras.some_path(stage, at, aim, stage.between(0.5, 1.6)), lens=stage.between(20, 30))
