"""Fast things with the shutter open: cars, a fan, thrown balls, a camera that whips round."""

import math

from experiments.cycles.kinds.sun import row_of_houses
from experiments.cycles.staging import cameras, lamps, materials, outside, rooms, shapes
from experiments.cycles.staging.stage import Point, Stage


def build(stage: Stage) -> None:
    """A street with fast cars or a room with a fan and bouncing balls; motion blur on, so no vectors are written."""
    stage.scene.render.use_motion_blur = True
    stage.scene.render.motion_blur_shutter = stage.one_of([0.3, 0.5, 0.5, 0.8])
    if stage.chance(0.5):
        _street(stage)
    else:
        _room(stage)


def _street(stage: Stage) -> None:
    outside.daylight(stage)
    row_of_houses(stage)
    for lane, heading in ((-1.4, 0.0), (1.4, math.pi)):
        start, speed = stage.between(5, 14), stage.between(6, 14)
        moving = outside.car(stage, (lane, start, 0), heading)
        step = speed if heading else -speed
        stage.move(moving, lambda t, x=lane, y=start, s=step: ((x, y + s * (t - 0.4), 0), None))  # type: ignore[misc]
    at = (stage.between(-2.5, 2.5), stage.between(-5, -3), stage.between(1.4, 2.2))
    cameras.film(stage, cameras.some_path(stage, at, (0, 12, 1.6), stage.between(1.0, 3.0)))


def _room(stage: Stage) -> None:
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    w, d, h = room
    lamps.ceiling_panel(stage, room, stage.log_between(40, 120))
    lamps.window(stage, room, stage.log_between(50, 130))
    fan(stage, (stage.between(-0.8, 0.8), 0.5 * d, h - 0.5), h)
    for _ in range(stage.count(3, 5)):
        _bouncing(stage, (stage.between(-1.5, 1.5), stage.between(0.4, 0.7) * d, 0))
    at = (stage.between(-0.25, 0.25) * w, stage.between(0.2, 0.6), stage.between(1.3, 1.7))
    cameras.film(stage, cameras.some_path(stage, at, room.middle, stage.between(0.6, 1.6)), lens=stage.between(18, 24))


def fan(stage: Stage, at: Point, ceiling: float) -> None:
    """A ceiling fan that turns."""
    base = stage.group(at)
    z = at[2]
    made = materials.wood(stage)
    stage.add(shapes.cylinder(0.02, ceiling - z, 10), materials.metal(stage, 0.3), at)
    stage.add(shapes.cylinder(0.12, 0.1, 28), materials.metal(stage, 0.3), parent=base, bevel=0.02)
    for i in range(4):
        blade = shapes.joined([(shapes.box(0.62, 0.14, 0.012), (0.42, 0, 0.04))])
        stage.add(blade, made, turn=(0.2, 0, i * math.pi / 2), parent=base)
    speed = stage.between(8, 20)
    stage.move(base, lambda t: (None, (0, 0, speed * t)))


def _bouncing(stage: Stage, at: Point) -> None:
    """A ball that bounces across."""
    x, y, _ = at
    radius = stage.between(0.09, 0.2)
    pattern = stage.one_of(["checker", "mosaic", "magic"])
    shades = [materials.color(stage) for _ in range(3)]
    made = materials.patterned(stage, pattern, stage.between(4, 9), shades, roughness=0.3)
    body = stage.add(shapes.ball(radius), made, at, smooth=True)
    speed, high, rate, phase = (
        stage.between(-2.5, 2.5),
        stage.between(0.4, 1.4),
        stage.between(1, 3),
        stage.between(0, 1),
    )

    def path(t: float) -> tuple[Point, Point]:
        part = (rate * t + phase) % 1.0
        return (x + speed * (t - 0.5), y, radius + high * 4 * part * (1 - part)), (speed * 5 * t, 3 * t, 0)

    stage.move(body, path)
