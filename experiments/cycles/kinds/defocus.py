"""Close things through a wide lens: thin depth of field, lights that blur into discs."""

import math

from experiments.cycles.kinds.metal import piece
from experiments.cycles.staging import cameras, furniture, lamps, materials, rooms
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """A table seen from near, candles and strings of lights behind it, a focus that may be pulled."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    h = room.height
    lamps.hanging(stage, (stage.between(-0.5, 0.5), 2.4, stage.between(1.9, 2.1)), stage.log_between(50, 130), h)
    if stage.chance(0.5):
        lamps.window(stage, room, stage.log_between(40, 120))
    _string_of_lights(stage, room)
    middle = (0.0, 2.2, 0.0)
    furniture.table(stage, middle, 2.0, 1.2, 0.75)
    for _ in range(stage.count(18, 28)):
        place = (stage.between(-0.85, 0.85), 2.2 + stage.between(-0.5, 0.5), 0.75)
        if stage.chance(0.45):
            piece(stage, place)
        elif stage.chance(0.2):
            lamps.candle(stage, place)
        else:
            furniture.small_thing(stage, place, largest=0.2)
    at = (stage.between(-0.5, 0.5), stage.between(1.05, 1.3), stage.between(0.9, 1.1))
    aim = (stage.between(-0.2, 0.2), 2.3, 0.83)
    focus = math.dist(at, aim) * stage.between(0.7, 1.0)
    path = cameras.some_path(stage, at, aim, stage.between(0.1, 0.35))
    camera = cameras.film(stage, path, lens=stage.between(40, 70), focus=focus, stop=stage.log_between(0.5, 1.6))
    if stage.chance(0.5):
        reach = stage.between(-0.3, 0.5)
        dof = camera.data.dof
        for frame in stage.times:
            dof.focus_distance = focus * (1 + reach * frame / stage.frames)
            camera.data.keyframe_insert("dof.focus_distance", frame=frame)


def _string_of_lights(stage: Stage, room: rooms.Room) -> None:
    """Small coloured bulbs along the back wall."""
    w, d, h = room
    tints = [materials.warm(stage), materials.warm(stage), materials.color(stage, (0.5, 0.9), (0.9, 1.0))]
    sag = stage.between(0.1, 0.4)
    for row in range(stage.count(1, 3)):
        number = stage.count(9, 16)
        for i in range(number):
            t = i / (number - 1)
            z = h - 0.5 - 0.4 * row - sag * 4 * t * (1 - t)
            place = ((t - 0.5) * w * 0.9, d - 0.3, z)
            watts = stage.log_between(0.3, 1.0)
            stage.lamp("POINT", place, watts, stage.one_of(tints), shadow_soft_size=0.022, seen=True)
