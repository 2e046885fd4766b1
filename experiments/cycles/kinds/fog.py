"""Fog and smoke: a park at dawn or a hall with shafts of light, the air itself scattering."""

from experiments.cycles.staging import cameras, lamps, materials, outside, rooms, shapes
from experiments.cycles.staging.stage import Point, Stage

import bpy  # isort: skip


def build(stage: Stage) -> None:
    """One of the two, with a camera that moves through it."""
    if stage.chance(0.5):
        park(stage)
    else:
        hall(stage)


def park(stage: Stage) -> None:
    """A path with lamps between trees in the morning's fog."""
    outside.overcast(stage, stage.log_between(0.08, 0.5))
    outside.ground(stage, 100)
    air(stage, (0, 20, 0), (60, 70, 14), stage.log_between(0.015, 0.045))
    for side in (-1, 1):
        for i in range(5):
            outside.tree(
                stage, (side * stage.between(2.6, 5.0), 4 + 5 * i + stage.between(-1, 1), 0), stage.between(4, 7)
            )
        for i in range(3):
            outside.post(stage, (side * 1.8, 5 + 7 * i, 0), stage.log_between(300, 1200))
    outside.street(stage, 2.6, 60)
    if stage.chance(0.6):
        start = stage.between(10, 14)
        moving = outside.car(stage, (0.2, start, 0), 0.0, lit=True)
        stage.move(moving, lambda t: ((0.2, start - 4 * t, 0), None))
    at = (stage.between(-0.8, 0.8), stage.between(-2, 0), stage.between(1.4, 1.9))
    cameras.film(stage, cameras.some_path(stage, at, (0, 12, 1.7), stage.between(0.8, 2.4)))


def hall(stage: Stage) -> None:
    """A furnished room in haze, with spots that sweep."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room)
    w, d, h = room
    air(stage, (0, d / 2, 0.001), (w - 0.02, d - 0.02, h - 0.02), stage.log_between(0.06, 0.2))
    for _ in range(stage.count(2, 4)):
        at = (stage.between(-0.45, 0.45) * w, stage.between(0.5, 0.95) * d, h - 0.25)
        aim = (stage.between(-0.3, 0.3) * w, stage.between(0.4, 0.8) * d, 0.2)
        lamps.spot(stage, at, aim, stage.log_between(200, 700), stage.between(25, 55))
    lamps.ceiling_panel(stage, room, stage.log_between(8, 25))
    at = (stage.between(-0.3, 0.3) * w, stage.between(0.2, 0.6), stage.between(1.2, 1.7))
    cameras.film(stage, cameras.some_path(stage, at, room.middle, stage.between(0.4, 1.4)), lens=stage.between(20, 28))


def air(stage: Stage, at: Point, size: Point, density: float) -> None:
    """A block of even haze."""
    made = bpy.data.materials.new("haze")
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    haze = tree.nodes.new("ShaderNodeVolumeScatter")
    haze.inputs["Color"].default_value = (*materials.color(stage, (0.0, 0.1), (0.85, 0.98)), 1.0)
    haze.inputs["Density"].default_value = density
    haze.inputs["Anisotropy"].default_value = stage.between(0.0, 0.6)
    tree.links.new(haze.outputs["Volume"], tree.nodes["Material Output"].inputs["Volume"])
    stage.add(shapes.box(*size), made, at)
    stage.scene.cycles.volume_bounces = stage.count(0, 2)
