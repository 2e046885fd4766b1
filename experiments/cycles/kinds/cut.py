"""A shot that is cut: from one camera to another in the same room, or to a closer view."""

from experiments.cycles.staging import cameras, lamps, rooms
from experiments.cycles.staging.stage import Stage


def build(stage: Stage) -> None:
    """A room with lamps and a window; two camera moves with a cut between two frames about the middle."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    w, d, _ = room
    lamps.window(stage, room, stage.log_between(60, 160))
    lamps.ceiling_panel(stage, room, stage.log_between(25, 80))
    views = []
    for side in (-1, 1):
        at = (side * stage.between(0.2, 0.36) * w, stage.between(0.2, 0.9), stage.between(1.1, 1.9))
        aim = (-side * stage.between(0.0, 0.9), stage.between(0.55, 0.8) * d, stage.between(0.7, 1.1))
        views.append(cameras.some_path(stage, at, aim, stage.between(0.5, 1.4)))
    frame = stage.count(2 * stage.frames // 5, 3 * stage.frames // 5)
    cameras.film(stage, cameras.cut(views[0], views[1], (frame - 1.5) / (stage.frames - 1)), lens=stage.between(20, 30))
    for curve in _camera_curves(stage):
        for key in curve.keyframe_points:
            key.interpolation = "CONSTANT"


def _camera_curves(stage: Stage) -> list:
    action = stage.scene.camera.animation_data.action
    return list(action.layers[0].strips[0].channelbags[0].fcurves)
