"""Trees and bushes whose leaves are cut out of sheets by alpha, in a park."""

import math

import numpy as np

from experiments.cycles.staging import cameras, materials, outside, shapes
from experiments.cycles.staging.stage import Point, Stage


def build(stage: Stage) -> None:
    """Trees near and far, bushes, a bench, the sun between the leaves; a breeze moves the nearest branches."""
    outside.daylight(stage, low=25, high=60)
    outside.ground(stage)
    near = [
        (stage.between(-2.6, -1.2), stage.between(4.5, 6.5), 0.0),
        (stage.between(1.2, 2.8), stage.between(5, 8), 0.0),
    ]
    for at in near:
        foliage_tree(stage, at, stage.between(3.2, 4.6), breeze=True)
    for _ in range(stage.count(4, 6)):
        foliage_tree(stage, (stage.between(-9, 9), stage.between(11, 24), 0), stage.between(4, 7))
    for _ in range(stage.count(4, 7)):
        bush(stage, (stage.between(-4, 4), stage.between(3.5, 10), 0), stage.between(0.5, 1.1))
    wood = materials.wood(stage)
    for z, y in ((0.42, 0.0), (0.42, 0.14), (0.42, 0.28), (0.65, 0.4), (0.8, 0.44)):
        stage.add(shapes.box(1.6, 0.11, 0.04), wood, (stage.between(-0.02, 0.02), 6 + y, z), bevel=0.01)
    for x in (-0.7, 0.7):
        stage.add(shapes.box(0.06, 0.45, 0.42), materials.metal(stage, 0.5), (x, 6.15, 0))
    at = (stage.between(-1, 1), stage.between(-0.5, 0.8), stage.between(1.3, 1.8))
    path = cameras.some_path(stage, at, (stage.between(-0.5, 0.5), 7, 1.7), stage.between(0.6, 1.8))
    cameras.film(stage, path, lens=stage.between(24, 34))


def foliage_tree(stage: Stage, at: Point, height: float, *, breeze: bool = False) -> None:
    """A tree with cut-out leaves: every crown's sheets share one mesh and material."""
    bark = materials.patterned(stage, "noise", 8.0, [(0.06, 0.04, 0.03), (0.2, 0.15, 0.1)], roughness=0.95, bump=0.6)
    tips = outside.branches(stage, at, height, bark)
    shade = materials.green(stage)
    for tip in tips:
        crown(stage, tip, 0.15 * height, stage.count(70, 110), shade, breeze=breeze)


def bush(stage: Stage, at: Point, size: float) -> None:
    """A bush of cut-out leaves."""
    x, y, z = at
    shade = materials.green(stage)
    for _ in range(3):
        place = np.array([x, y, z + 0.4 * size]) + stage.rng.normal(size=3) * 0.25 * size
        crown(stage, place, 0.35 * size, stage.count(40, 60), shade)


def crown(
    stage: Stage, middle: Point, spread: float, number: int, shade: materials.Color, *, breeze: bool = False
) -> None:
    """A cloud of leaves about a point; with a breeze the cloud sways."""
    base = stage.group(middle)
    first = None
    for _ in range(number):
        at = stage.rng.normal(size=3) * spread * (0.6, 0.6, 0.45)
        turn = stage.rng.uniform(0, 2 * math.pi, 3)
        size = spread * stage.between(0.3, 0.55)
        if first is None:
            made = materials.cut_out(stage, tuple(min(1.0, c * stage.between(0.7, 1.3)) for c in shade))
            first = stage.add(shapes.sheet(1, 1), made, at, turn=turn, scale=(size,) * 3, parent=base)
        else:
            stage.again(first, at, turn=turn, scale=(size,) * 3).parent = base
    if breeze:
        phase, strength, speed = stage.between(0, 6), stage.between(0.01, 0.05), stage.between(4, 9)
        start = np.asarray(middle, float)

        def sway(t: float) -> tuple[Point, Point]:
            wave = strength * math.sin(speed * t + phase)
            return start + (wave, 0.4 * wave, 0), (0.5 * wave, wave, 0)

        stage.move(base, sway)
