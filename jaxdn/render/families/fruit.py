"""A moving still life: fruit rolls over a laid table, a stand of oranges turns, a lemon hops."""

import numpy as np

from jaxdn.render.families import shapes, textures
from jaxdn.render.families.shapes import Mesh
from jaxdn.render.families.staging import (
    RECTANGLE,
    Finish,
    Motion,
    Stage,
    attached,
    drifting_camera,
    furnish_room,
    glossy,
    hop,
    light_room,
    matte,
    metal,
    rod,
    scale,
    shift,
    swing,
    turn,
)

TOP = 0.8  # height of the table
CLOTH = 0.006  # how far the cloth's surface lies above it


def fruit(seed: int, *, lamp: str = "mix") -> Stage:
    """Apples, an orange and a lemon roll on a table with a cloth, a turning fruit stand, a pear, a vase and books."""
    stage = Stage("fruit", seed, lamp=lamp)
    moving_still_life(stage)
    return stage


def moving_still_life(stage: Stage) -> None:
    """Fill a stage with all of it: room, lamp, table, fruit and camera."""
    rng = stage.rng
    hue = rng.random()
    floor = glossy(textures.wood(rng, textures.hsv(0.07, 0.6, 0.5), textures.hsv(0.09, 0.5, 0.8)), 0.4, repeat=(2, 2))
    wall = matte(
        textures.wallpaper(rng, textures.hsv(hue, 0.25, 0.9), textures.hsv(hue + 0.06, 0.4, 0.75)), repeat=(2, 1)
    )
    furnish_room(stage, (2.6, 2.7, 2.6), floor=floor, wall=wall, back=wall, ceiling=matte((0.8, 0.8, 0.78)))
    light_room(stage, (float(rng.uniform(-0.7, 0.7)), float(rng.uniform(-0.6, 0.6))), power=1.0)
    _table(stage)
    _still_life(stage, hue)
    _rolling_fruit(stage)
    side = rng.uniform(-0.35, 0.35)
    drifting_camera(stage, (side, 1.38, 1.62), (0.1 * side, 0.86, -0.1), x_fov=54, reach=0.24)


def _table(stage: Stage) -> None:
    """The table top on turned legs, and a cloth that hangs over its front edge."""
    rng = stage.rng
    tone = rng.uniform(0.04, 0.1)
    grain = textures.wood(rng, textures.hsv(tone, 0.7, 0.5), textures.hsv(tone, 0.55, 0.85), planks=3)
    stage.add("table", "cube", shift(0, TOP - 0.03, 0) @ scale(1.0, 0.03, 0.6), glossy(grain, 0.3))
    rise = np.linspace(0, 1, 60)
    leg = shapes.lathe(np.stack([0.035 + 0.012 * np.sin(rise * 25) * np.sin(np.pi * rise), rise], -1), segments=24)
    for index, (x, z) in enumerate([(-0.88, -0.48), (0.88, -0.48), (-0.88, 0.48), (0.88, 0.48)]):
        stage.add(
            f"leg_{index}", leg, shift(x, 0, z) @ scale(1.3, TOP - 0.06, 1.3), matte(textures.hsv(tone, 0.65, 0.5))
        )
    hue = rng.random()
    plaid = textures.plaid(
        rng, textures.hsv(hue, 0.1, 0.95), textures.hsv(hue, 0.6, 0.75), textures.hsv(hue + 0.4, 0.6, 0.6)
    )
    cloth = shapes.runner(1.15, 0.61, rng.uniform(0.2, 0.35), rng)
    stage.add("cloth", cloth, shift(rng.uniform(-0.15, 0.15), TOP + CLOTH, 0), matte(plaid, repeat=(1.5, 1.2)))


def _still_life(stage: Stage, hue: float) -> None:
    """What stands on the back half of the table, and the picture on the wall."""
    rng = stage.rng
    x = -0.6
    glaze = glossy(textures.hsv(rng.random(), 0.55, 0.7), rng.uniform(0.15, 0.3))
    stage.add("vase", shapes.vase(rng.uniform(0.3, 0.42), 0.15), shift(x, TOP, -0.33) @ scale(0.38), glaze)
    petals = textures.hsv(rng.random(), 0.7, 0.9)
    for index in range(3):
        tip = np.array([x, TOP + 0.62, -0.33]) + rng.uniform((-0.2, -0.08, -0.1), (0.2, 0.1, 0.12))
        stage.add(
            f"stem_{index}", shapes.drum(), rod((x, TOP + 0.2, -0.33), tip, 0.006), matte(textures.hsv(0.3, 0.6, 0.5))
        )
        bloom = shift(*tip) @ turn("y", rng.uniform(0, 90)) @ turn("x", rng.uniform(-30, 60)) @ scale(0.075)
        stage.add(f"bloom_{index}", shapes.star(7, inner=0.55), bloom, matte(petals))
    for index in range(2):
        cover = glossy(textures.hsv(hue + 0.45 + 0.2 * index, 0.6, 0.65), 0.5)
        place = shift(-0.12, TOP + 0.025 + 0.05 * index, -0.4) @ turn("y", rng.uniform(-25, 25))
        stage.add(f"book_{index}", "cube", place @ scale(0.16, 0.024, 0.11), cover)
    skin = glossy(textures.apple_skin(rng, textures.hsv(0.16, 0.7, 0.75), textures.hsv(0.22, 0.6, 0.75)), 0.35)
    rate, rock = rng.choice([-1, 1]) * rng.uniform(50, 90), rng.uniform(4, 9)

    def pear(frame: float) -> np.ndarray:  # a wobbling pear: its belly rolls where it stands on the books
        lean = turn("z", rock * swing(frame, rate)) @ turn("y", 2 * rock * swing(frame, rate, 0.25))
        return shift(-0.12, TOP + 0.1 + 0.092, -0.4) @ lean @ scale(0.092)

    stage.add("pear", shapes.pear(), pear, skin)
    colors = [
        textures.hsv(hue + step, 0.5, value) for step, value in ((0.5, 0.4), (0.55, 0.7), (0.1, 0.8), (0.15, 0.95))
    ]
    spot = shift(rng.uniform(-0.5, 0.5), 1.7, -2.57)
    stage.add("picture_frame", "cube", spot @ scale(0.56, 0.42, 0.02), metal(textures.hsv(0.11, 0.55, 0.8), 0.35))
    stage.add(
        "picture",
        RECTANGLE,
        spot @ shift(0, 0, 0.022) @ scale(0.5, 0.36, 1),
        glossy(textures.painting(rng, colors), 0.5),
    )
    _stand(stage)


def _stand(stage: Stage) -> None:
    """A turning dish on a foot with three fruits in it."""
    rng = stage.rng
    x, z, height, rate = 0.55, -0.26, 0.14, rng.choice([-1, 1]) * rng.uniform(2.0, 4.0)
    ceramic = textures.stripes(rng, [textures.hsv(rng.random(), 0.5, 0.7), np.array((0.8, 0.79, 0.75))], count=24)

    def spin(frame: float) -> np.ndarray:
        return shift(x, TOP + height, z) @ turn("y", rate * frame)

    stage.add("stand_foot", shapes.drum(0.35), shift(x, TOP, z) @ scale(0.1, height, 0.1), metal((0.8, 0.72, 0.6), 0.3))
    stage.add("stand_dish", shapes.dish(0.22), lambda frame: spin(frame) @ scale(0.27), glossy(ceramic, 0.2))
    for index, (mesh, skin) in enumerate((_orange(rng), _apple(rng), _orange(rng))):
        radius = rng.uniform(0.085, 0.1)
        place = (
            turn("y", 120 * index) @ shift(0.115, 0.012 + radius, 0) @ turn("x", rng.uniform(-40, 40)) @ scale(radius)
        )
        stage.add(f"stand_fruit_{index}", mesh, attached(spin, place), skin)


def _rolling_fruit(stage: Stage) -> None:
    """One fruit a lane in front of the still life: two roll back and forth, the third (lemon or orange) hops."""
    rng = stage.rng
    lanes = rng.permutation(np.array([0.06, 0.28, 0.47]))
    kinds = [_apple(rng), _apple(rng) if rng.random() < 0.5 else _orange(rng), _orange(rng, rng.random() < 0.6)]
    for index, (mesh, skin) in enumerate(kinds):
        radius = rng.uniform(0.085, 0.105)
        reach, centre = rng.uniform(0.35, 0.55), rng.uniform(-0.1, 0.1)
        period, phase = 2 * np.pi * reach / rng.uniform(0.035, 0.085), rng.random()
        leap = rng.uniform(0.1, 0.22) if index == 2 else 0.0
        beat = rng.uniform(11, 17)
        attitude = turn("x", rng.uniform(60, 120)) @ turn("y", rng.uniform(0, 360)) @ scale(radius)
        motion = _rolling(lanes[index], radius, reach, centre, period, phase, leap, beat, attitude)
        stage.add(f"rolling_{index}", mesh, motion, skin)


def _rolling(
    z: float,
    radius: float,
    reach: float,
    centre: float,
    period: float,
    phase: float,
    leap: float,
    beat: float,
    attitude: np.ndarray,
) -> Motion:
    """Rolling back and forth along x without slipping, with hops.

    Args:
      z: place of the lane.
      radius: of the fruit.
      reach: half the travel.
      centre: its middle in x.
      period: of the travel, in frames.
      phase: of the travel, in periods.
      leap: height of the hops.
      beat: frames between two hops.
      attitude: [4, 4] the fruit's own orientation and scale.
    """

    def motion(frame: float) -> np.ndarray:
        travel = reach * swing(frame, period, phase)
        lift = TOP + CLOTH + radius + leap * hop(frame, beat)
        return shift(centre + travel, lift, z) @ turn("z", -np.degrees(travel / radius)) @ attitude

    return motion


def _apple(rng: np.random.Generator) -> tuple[Mesh, Finish]:
    ripe = textures.hsv(rng.uniform(-0.02, 0.03), 0.9, 0.78)
    unripe = textures.hsv(rng.uniform(0.08, 0.22), 0.7, 0.85)
    return shapes.apple(), glossy(textures.apple_skin(rng, ripe, unripe), rng.uniform(0.25, 0.4))


def _orange(rng: np.random.Generator, lemon: bool = False) -> tuple[Mesh, Finish]:
    hue = 0.145 if lemon else rng.uniform(0.06, 0.085)
    peel = textures.speckled(rng, textures.hsv(hue, 0.88, 0.95), textures.hsv(hue + 0.02, 0.8, 0.8), cells=20)
    turned = np.linspace(-np.pi / 2, np.pi / 2, 40)
    pole = 0.22 * np.sin(turned) ** 9 if lemon else 0.0
    body = np.stack([np.cos(turned) * (1.0 if not lemon else 0.97), np.sin(turned) + pole], -1)
    return shapes.lathe(body), glossy(peel, rng.uniform(0.35, 0.5))
