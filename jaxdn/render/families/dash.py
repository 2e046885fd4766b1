"""From dark to light: fast toys cross a hall of which one half is lit and the other is not.

A history that follows the moving object brings dark values into the light, and the ground it uncovers was lit
differently a frame ago: this tests how fast a temporal filter discards its history.
"""

import numpy as np

from jaxdn.render.families import shapes, textures
from jaxdn.render.families.staging import (
    Finish,
    Stage,
    attached,
    drifting_camera,
    furnish_room,
    glossy,
    hop,
    light_room,
    matte,
    metal,
    scale,
    shift,
    shuttle,
    swing,
    turn,
)


def dash(seed: int, *, lamp: str = "mix") -> Stage:
    """A sled and a ball shoot through the doorway of a partition between a dark half (left) and a lit half (right)."""
    stage = Stage("dash", seed, lamp=lamp)
    rng = stage.rng
    hue = rng.random()
    tiled = textures.tiles(rng, textures.hsv(hue, 0.1, 0.9), textures.hsv(hue + 0.1, 0.3, 0.7), count=8)
    plaster = textures.speckled(rng, textures.hsv(hue + 0.4, 0.15, 0.92), textures.hsv(hue + 0.5, 0.3, 0.8), cells=14)
    brick = textures.bricks(rng, textures.hsv(rng.uniform(0.02, 0.1), 0.4, 0.85), (0.6, 0.58, 0.55))
    wall, back = matte(plaster, repeat=(2, 1)), matte(brick, repeat=(3, 1.5))
    furnish_room(
        stage,
        (3.2, 2.8, 2.4),
        floor=glossy(tiled, 0.35, repeat=(2, 2)),
        wall=wall,
        back=back,
        ceiling=matte((0.8, 0.8, 0.79)),
    )
    light_room(stage, (1.9, float(rng.uniform(-0.6, 0.2))), power=1.1)
    _partition(stage, hue)
    _things(stage, hue)
    _runners(stage)
    drifting_camera(stage, (rng.uniform(-0.2, 0.2), 1.3, 2.1), (0.0, 0.85, -0.8), x_fov=66, reach=0.14)
    return stage


def _partition(stage: Stage, hue: float) -> None:
    """A wall across the middle, open to the front below its lintel, so that the camera sees both halves."""
    paint = matte(textures.speckled(stage.rng, textures.hsv(hue, 0.2, 0.9), textures.hsv(hue, 0.3, 0.8), cells=10))
    stage.add("partition_back", "cube", shift(-0.05, 1.4, -1.9) @ scale(0.06, 1.4, 0.5), paint)
    stage.add("partition_top", "cube", shift(-0.05, 2.1, -0.75) @ scale(0.06, 0.7, 0.65), paint)


def _things(stage: Stage, hue: float) -> None:
    """Crates, vases, rings and a picture in both halves."""
    rng = stage.rng
    plank = glossy(textures.wood(rng, textures.hsv(0.08, 0.5, 0.6), textures.hsv(0.1, 0.4, 0.88), planks=4), 0.4)
    for index, x in enumerate((-2.5, -1.1, 1.1, 2.5)):
        size = rng.uniform(0.24, 0.36)
        place = shift(x + rng.uniform(-0.15, 0.15), size, -1.95) @ turn("y", rng.uniform(-25, 25))
        stage.add(f"crate_{index}", "cube", place @ scale(size), plank)
        color = glossy(textures.hsv(hue + 0.2 * index + 0.1, 0.55, 0.85), rng.uniform(0.2, 0.4))
        if index % 2:
            stage.add(f"ring_{index}", shapes.ring(0.4), place @ shift(0, size + 0.08, 0) @ scale(0.2), color)
        else:
            stage.add(
                f"vase_{index}", shapes.vase(rng.uniform(0.3, 0.5), 0.18), place @ shift(0, size, 0) @ scale(0.5), color
            )
    for index, x in enumerate((-1.8, 1.8)):
        colors = [textures.hsv(shade, 0.55, 0.88) for shade in rng.random(4)]
        stage.add(f"frame_{index}", "cube", shift(x, 1.65, -2.37) @ scale(0.5, 0.4, 0.02), metal((0.8, 0.7, 0.5), 0.35))
        stage.add(
            f"canvas_{index}",
            "rectangle",
            shift(x, 1.65, -2.345) @ scale(0.45, 0.35, 1),
            matte(textures.painting(rng, colors)),
        )


def _runners(stage: Stage) -> None:
    """A sled on rails and a bouncing ball, each from wall to wall and back at 0.2 to 0.35 m a frame."""
    rng = stage.rng
    period, phase = 4 * 2.3 / rng.uniform(0.2, 0.32), rng.random()
    hue = rng.random()

    def sled(frame: float) -> np.ndarray:
        return shift(2.3 * shuttle(frame, period, phase), 0, -1.0)

    parts: dict[str, tuple[str | shapes.Mesh, np.ndarray, Finish]] = {
        "sled": (
            shapes.soft_box(0.3, 0.35),
            shift(0, 0.3, 0) @ scale(0.42, 0.16, 0.24),
            glossy(textures.hsv(hue, 0.7, 0.85), 0.25),
        ),
        "sled_seat": (
            shapes.soft_box(0.4, 0.4),
            shift(-0.08, 0.52, 0) @ scale(0.2, 0.12, 0.2),
            glossy(textures.hsv(hue + 0.4, 0.5, 0.9), 0.4),
        ),
        "sled_rider": ("sphere", shift(-0.08, 0.76, 0) @ scale(0.16), matte(textures.hsv(0.09, 0.35, 0.92))),
        "sled_base": ("cube", shift(0, 0.12, 0) @ scale(0.34, 0.03, 0.2), metal((0.75, 0.72, 0.68), 0.3)),
    }
    for name, (shape, local, material) in parts.items():
        stage.add(name, shape, attached(sled, local), material)
    for index, z in enumerate((-1.14, -0.86)):
        stage.add(f"rail_{index}", "cube", shift(0, 0.045, z) @ scale(2.9, 0.045, 0.02), metal((0.6, 0.58, 0.56), 0.35))
    bands = textures.stripes(
        rng, [textures.hsv(shade, 0.7, 0.88) for shade in rng.random() + np.array([0, 0.3, 0.55])], count=6
    )
    radius, lap, beat, start = rng.uniform(0.18, 0.24), rng.uniform(34, 48), rng.uniform(11, 15), rng.random()

    def ball(frame: float) -> np.ndarray:
        travel = 2.3 * swing(frame, lap, start)
        lift = radius + 0.5 * hop(frame, beat)
        return shift(travel, lift, -0.2) @ turn("z", -np.degrees(travel / radius)) @ turn("x", 30) @ scale(radius)

    stage.add("ball", "sphere", ball, glossy(bands, 0.3))
