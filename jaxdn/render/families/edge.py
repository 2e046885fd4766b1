"""Disocclusion at the image's border: a tall painted screen slides out of the image and back.

What it uncovers lies next to the border, where a dual motion vector may point outside the previous image: the case
in which Zeng et al. 2021 (their fig. 11) have no history to reuse either.
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
    light_room,
    matte,
    metal,
    scale,
    shift,
    swing,
    turn,
)


def edge(seed: int, *, lamp: str = "mix") -> Stage:
    """A wheeled screen leaves over the left or right border before a shelf of vases; a globe turns in the middle."""
    stage = Stage("edge", seed, lamp=lamp)
    rng = stage.rng
    hue = rng.random()
    papered = textures.wallpaper(rng, textures.hsv(hue, 0.2, 0.9), textures.hsv(hue + 0.1, 0.45, 0.75))
    boards = textures.wood(rng, textures.hsv(0.07, 0.55, 0.55), textures.hsv(0.09, 0.45, 0.85))
    wall = matte(papered, repeat=(3, 1.5))
    floor = glossy(boards, 0.35, repeat=(2, 2))
    furnish_room(stage, (3.2, 2.8, 2.8), floor=floor, wall=wall, back=wall, ceiling=matte((0.8, 0.8, 0.79)))
    light_room(stage, (float(rng.uniform(-0.5, 0.5)), float(rng.uniform(0.0, 0.6))), power=1.0)
    _background(stage, hue)
    _screen(stage)
    drifting_camera(stage, (rng.uniform(-0.15, 0.15), 1.35, 2.3), (0.0, 1.0, -1.0), x_fov=56, reach=0.12)
    return stage


def _background(stage: Stage, hue: float) -> None:
    """A long sideboard with things on it at the back wall, and a turning globe."""
    rng = stage.rng
    oak = textures.wood(rng, textures.hsv(0.08, 0.5, 0.6), textures.hsv(0.1, 0.4, 0.85), planks=3)
    stage.add("sideboard", "cube", shift(0, 0.42, -2.4) @ scale(2.4, 0.42, 0.28), glossy(oak, 0.35))
    for index, x in enumerate(np.linspace(-2.0, 2.0, 6)):
        color = glossy(textures.hsv(hue + 0.17 * index, 0.55, 0.8), rng.uniform(0.2, 0.45))
        place = shift(x + rng.uniform(-0.12, 0.12), 0.84, -2.4)
        if index % 2:
            stage.add(
                f"vase_{index}", shapes.vase(rng.uniform(0.3, 0.5), 0.18), place @ scale(rng.uniform(0.4, 0.6)), color
            )
        else:
            size = rng.uniform(0.14, 0.2)
            box = place @ shift(0, size, 0) @ turn("y", rng.uniform(0, 90)) @ scale(size)
            stage.add(f"box_{index}", shapes.soft_box(0.15, 0.15), box, color)
    for index, x in enumerate((-1.5, 0.0, 1.5)):
        colors = [textures.hsv(shade, 0.5, 0.85) for shade in rng.random(4)]
        place = shift(x, 1.9, -2.77)
        stage.add(f"frame_{index}", "cube", place @ scale(0.46, 0.36, 0.02), metal(textures.hsv(0.1, 0.4, 0.8), 0.35))
        canvas = place @ shift(0, 0, 0.022) @ scale(0.41, 0.31, 1)
        stage.add(f"canvas_{index}", "rectangle", canvas, matte(textures.painting(rng, colors)))
    bands = textures.stripes(rng, [textures.hsv(shade, 0.65, 0.85) for shade in rng.random(3)], count=9, slant=0.5)
    rate = rng.choice([-1, 1]) * rng.uniform(3, 6)
    stage.add("stand", shapes.drum(0.5), shift(0.1, 0, -1.1) @ scale(0.22, 0.6, 0.22), metal((0.75, 0.7, 0.62), 0.3))
    pose = shift(0.1, 0.88, -1.1) @ turn("z", 20)
    stage.add(
        "globe",
        "sphere",
        lambda frame: pose @ turn("y", rate * frame) @ turn("x", -90) @ scale(0.3),
        glossy(bands, 0.3),
    )


def _screen(stage: Stage) -> None:
    """The screen on its wheels: out over the border and back, 2 to 5 pixels a frame at 128 px."""
    rng = stage.rng
    side, period = rng.choice([-1, 1]), rng.uniform(46, 70)
    phase = 0.75 + rng.uniform(-0.05, 0.1)
    picture = textures.painting(rng, [textures.hsv(shade, 0.5, 0.85) for shade in rng.random(4)])

    def screen(frame: float) -> np.ndarray:
        return shift(side * (1.45 + 0.85 * swing(frame, period, phase)), 0, -0.35)

    parts: dict[str, tuple[str | shapes.Mesh, np.ndarray, Finish]] = {
        "screen": ("cube", shift(0, 1.0, 0) @ scale(0.6, 0.88, 0.03), glossy(picture, 0.4)),
        "screen_foot": ("cube", shift(0, 0.1, 0) @ scale(0.6, 0.03, 0.16), metal((0.7, 0.68, 0.64), 0.35)),
        "screen_top": (
            shapes.soft_box(0.3, 0.3),
            shift(0, 1.9, 0) @ scale(0.64, 0.05, 0.06),
            glossy((0.5, 0.3, 0.15), 0.3),
        ),
    }
    for name, (shape, local, material) in parts.items():
        stage.add(name, shape, attached(screen, local), material)
    for index, (x, z) in enumerate([(-0.5, 0.12), (0.5, 0.12), (-0.5, -0.12), (0.5, -0.12)]):
        hub = shift(x, 0.06, z)

        def wheel(frame: float, hub: np.ndarray = hub) -> np.ndarray:
            roll = -np.degrees(screen(frame)[0, 3] / 0.06)
            return screen(frame) @ hub @ turn("z", roll) @ scale(0.06)

        stage.add(f"screen_wheel_{index}", "sphere", wheel, glossy((0.1, 0.1, 0.11), 0.4))
