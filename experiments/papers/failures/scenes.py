"""Clips of what temporal denoisers fail at: something moves for eight frames and rests from then on.

Zeng et al. 2021, sec. 6.4: disocclusion at the border, where dual vectors lead out of the image, and fast things that
come from the dark into the light. Hasselgren et al. 2020, sec. 4: moving shadows, mirrors and transparent things, whose
light does not move as their surface. The camera rests, so that nothing else changes. Metres, y up, 40 pixels a metre at
the distance of the things where the image is 96 pixels wide.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxdn.render.families import shapes, textures
from jaxdn.render.families.staging import (
    Stage,
    furnish_room,
    glass,
    glossy,
    look_at,
    matte,
    metal,
    scale,
    shift,
    turn,
)
from jaxdn.render.scenes.optics import SceneOptics
from jaxdn.render.scenes.scene import Camera

MOVING = 8
"""From this frame on everything rests."""
SPEED = 0.2
"""Metres a frame of what is fast: 8 pixels."""
WIDE = 1.5
"""Radius of the lamp, in metres, where mirrors and glass lead paths to it by chance: each such path is a bright pixel,
the brighter the smaller the lamp."""
_HALF = (4.0, 2.6, 2.4)
_MIRROR = metal((0.9, 0.9, 0.9), 0.03)


def _time(frame: float) -> float:
    return min(frame, float(MOVING))


def _room(name: str, *, lamp: tuple[float, float, float] = (0.8, 2.5, 0.2), size: float = 0.12) -> Stage:
    """A closed room with a papered back wall and a tiled floor, a small lamp, and the camera."""
    stage = Stage(f"failure-{name}", 0, lamp="down")
    rng = stage.rng
    paper = textures.wallpaper(rng, textures.hsv(0.58, 0.2, 0.85), textures.hsv(0.1, 0.4, 0.7))
    tiles = textures.tiles(rng, textures.hsv(0.1, 0.1, 0.85), textures.hsv(0.05, 0.35, 0.55), count=8)
    wall = matte((0.72, 0.7, 0.66))
    back, ceiling = matte(paper, repeat=(3, 1)), matte((0.8, 0.8, 0.8))
    furnish_room(stage, _HALF, floor=matte(tiles, repeat=(3, 2)), wall=wall, back=back, ceiling=ceiling)
    face = shift(*lamp) @ turn("x", 90) @ scale(size)
    stage.add("lamp", "disk", face, matte((0.0, 0.0, 0.0)), glow=np.full(3, 3.0 / size**2))
    stage.view = lambda frame: Camera(look_at((0.0, 1.3, 2.2), (0.0, 0.9, -0.6)), 50.0)
    return stage


def border() -> Stage:
    """Posts march into the image: what each uncovers first lies beside the border it came in over."""
    stage = _room("border")
    for index in range(9):
        begins = -4.2 + 0.45 * index

        def place(frame: float, begins: float = begins) -> np.ndarray:
            return shift(begins + SPEED * _time(frame), 0.8, -0.2) @ scale(0.11, 0.8, 0.05)

        stage.add(f"post_{index}", "cube", place, matte(textures.hsv(0.13 * index, 0.6, 0.8)))
    return stage


def dark_to_light() -> Stage:
    """A box shoots out of the shadow of a board: the last three steps bring it into the light."""
    stage = _room("dark-to-light", lamp=(1.0, 2.45, 0.8), size=0.06)
    stage.add("board", "cube", shift(0.65, 1.95, -0.3) @ scale(0.03, 0.65, 1.4), matte((0.5, 0.45, 0.4)))

    def place(frame: float) -> np.ndarray:
        return shift(-0.9 + SPEED * _time(frame), 0.35, -0.4) @ scale(0.2, 0.3, 0.2)

    stage.add("box", "cube", place, matte(textures.hsv(0.55, 0.5, 0.85)))
    return stage


def shadow() -> Stage:
    """The shadow of a ball that is not seen itself moves over floor and wall."""
    stage = _room("shadow", lamp=(0.0, 2.5, 0.6))

    def place(frame: float) -> np.ndarray:
        return shift(-0.44 + 0.08 * _time(frame), 2.15, 0.2) @ scale(0.13)

    stage.add("ball", "sphere", place, matte((0.5, 0.5, 0.5)))
    return stage


def _reflected_things(stage: Stage) -> None:
    """Bright boxes in front of the mirror and beside the camera's view."""
    for index, x in enumerate((-1.1, -0.4, 0.5, 1.2)):
        place = shift(x, 0.3 + 0.15 * (index % 2), 0.75) @ scale(0.16, 0.3, 0.16)
        stage.add(f"thing_{index}", "cube", place, glossy(textures.hsv(0.22 * index, 0.75, 0.85), 0.5))


def moving_mirror() -> Stage:
    """A standing mirror turns on its axis: its surface hardly moves, what it shows moves fast."""
    stage = _room("moving-mirror", size=WIDE)
    _reflected_things(stage)

    def place(frame: float) -> np.ndarray:
        return shift(0.0, 1.0, -0.9) @ turn("y", -12 + 3 * _time(frame)) @ scale(0.85, 0.75, 0.03)

    stage.add("mirror", "cube", place, _MIRROR)
    return stage


def curved_mirror() -> Stage:
    """A mirror ball that rests; bright boxes below the image pass before it."""
    stage = _room("curved-mirror", size=WIDE)
    stage.add("ball", "sphere", shift(0.0, 0.85, -0.7) @ scale(0.7), _MIRROR)
    for index in range(4):
        begins = -1.9 + 0.6 * index

        def place(frame: float, begins: float = begins) -> np.ndarray:
            return shift(begins + SPEED * _time(frame), 0.25, 0.55) @ scale(0.17, 0.22, 0.2)

        stage.add(f"box_{index}", "cube", place, glossy(textures.hsv(0.02 + 0.27 * index, 0.75, 0.9), 0.5))
    return stage


def transparent() -> Stage:
    """A glass ball rolls past a row of posts: it shows them upside down, and moves otherwise than what it shows."""
    stage = _room("transparent", size=WIDE)
    for index in range(6):
        place = shift(-1.25 + 0.5 * index, 0.7, -1.2) @ scale(0.1, 0.7, 0.1)
        stage.add(f"post_{index}", "cube", place, matte(textures.hsv(0.17 * index, 0.65, 0.85)))

    def ball(frame: float) -> np.ndarray:
        return shift(-0.5 + 0.1 * _time(frame), 0.75, 0.1) @ scale(0.42)

    stage.add("ball", "sphere", ball, glass((0.98, 0.98, 0.98)))
    return stage


def blur() -> Stage:
    """A wheel with spokes crosses the image while the shutter is open for half of the time."""
    stage = _room("blur")
    paint = matte(textures.stripes(stage.rng, [textures.hsv(hue, 0.7, 0.85) for hue in (0.0, 0.15, 0.6)], count=6))

    def drum(frame: float) -> np.ndarray:
        move = SPEED * _time(frame)
        return shift(-0.8 + move, 0.6, -0.3) @ turn("z", -100 * move) @ turn("x", 90) @ scale(0.4, 0.2, 0.4)

    stage.add("drum", shapes.drum(0.9), drum, paint)
    stage.set_optics(SceneOptics(shutter=0.5))
    return stage


SCENES: dict[str, tuple[Callable[[], Stage], dict[str, Any]]] = {
    "border": (border, {}),
    "dark to light": (dark_to_light, {}),
    "shadow": (shadow, {}),
    "moving mirror": (moving_mirror, {}),
    "curved mirror": (curved_mirror, {}),
    "transparent": (transparent, {}),
    "blur": (blur, {"pixel_filter": "blackman-harris"}),
}
"""Name -> the scene, and what its clip is rendered with besides: with motion blur, pixels have to be filtered."""
