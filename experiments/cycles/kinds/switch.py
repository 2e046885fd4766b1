"""A room in which a light is switched on, off, or flickers."""

from typing import Any

from experiments.cycles.kinds.lamps import view
from experiments.cycles.staging import lamps, rooms
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """Two lamps that stay and one that switches about the middle of the clip; a second one may flicker."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    w, d, h = room
    if stage.chance(0.5):
        lamps.ceiling_panel(stage, room, stage.log_between(20, 60))
    else:
        lamps.window(stage, room, stage.log_between(50, 130))
    steady = (-w / 2 + 0.7, stage.between(0.6, 0.85) * d, 0)
    lamps.standing(stage, steady, 1.4, stage.log_between(25, 60))
    switched = lamps.hanging(stage, (stage.between(-0.5, 0.5), 0.55 * d, h - 0.8), stage.log_between(60, 160), h)
    change = stage.count(2 * stage.frames // 5, 3 * stage.frames // 5)
    first = stage.chance(0.5)
    switch(stage, switched.data, lambda frame: (frame >= change) != first)
    if stage.chance(0.4):
        other = lamps.spot(stage, (w / 2 - 0.5, 0.4 * d, h - 0.3), (0.5, 0.7 * d, 0.0), stage.log_between(150, 400))
        pattern = stage.rng.random(stage.frames + 8) < 0.7
        switch(stage, other.data, lambda frame: bool(pattern[frame + 2]))
    view(stage, room)


def switch(stage: Stage, light: Any, shines: Any) -> None:
    """Let a lamp shine in the frames for which ``shines(frame)`` is true."""
    watts = light.energy
    stage.vary(light, "energy", lambda frame: watts if shines(frame) else 0.0)
    for curve in curves(light):
        for key in curve.keyframe_points:
            key.interpolation = "CONSTANT"


def curves(owner: Any) -> Any:
    """The animation curves of a thing."""
    action = owner.animation_data.action
    return action.layers[0].strips[0].channelbags[0].fcurves
