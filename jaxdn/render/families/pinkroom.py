"""A child's room in pinks: a ball bounces through it, a car drives its lap on the rug, the door swings, a top spins."""

import numpy as np

from jaxdn.render.families import shapes, textures
from jaxdn.render.families.staging import (
    RECTANGLE,
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
    swing,
    turn,
)


def pinkroom(seed: int, *, lamp: str = "mix") -> Stage:
    """A furnished room: bed, shelf, mirror, rug, books and toys; a ball, a car, a door and a spinning top move."""
    stage = Stage("pinkroom", seed, lamp=lamp)
    rng = stage.rng
    pink = rng.uniform(-0.09, 0.03)
    paper = textures.wallpaper(rng, textures.hsv(pink, 0.22, 0.95), textures.hsv(pink, 0.42, 0.85), columns=8)
    boards = textures.wood(rng, textures.hsv(0.07, 0.5, 0.6), textures.hsv(0.09, 0.4, 0.88))
    wall = matte(paper, repeat=(2, 1))
    floor = glossy(boards, rng.uniform(0.25, 0.4), repeat=(2, 2))
    furnish_room(stage, (2.6, 2.7, 2.7), floor=floor, wall=wall, back=wall, ceiling=matte((0.84, 0.8, 0.8)))
    light_room(stage, (float(rng.uniform(-0.8, 0.8)), float(rng.uniform(-0.8, 0.8))), power=1.0)
    _furniture(stage, pink)
    _door(stage, pink)
    _toys(stage)
    _ball(stage)
    _car(stage)
    side = rng.uniform(-0.2, 0.7)
    drifting_camera(stage, (side, 1.45, 2.35), (-0.15 + 0.1 * side, 0.72, -0.7), x_fov=62, reach=0.42)
    return stage


def _furniture(stage: Stage, pink: float) -> None:
    rng = stage.rng
    frame = glossy(textures.wood(rng, textures.hsv(0.08, 0.35, 0.75), textures.hsv(0.1, 0.25, 0.92), planks=2), 0.4)
    quilt_colors = [textures.hsv(pink + step, 0.4, 0.85) for step in (0.0, 0.45, 0.12)]
    quilt = matte(textures.stripes(rng, quilt_colors, count=9), repeat=(2, 1))
    soft = shapes.soft_box(0.35, 0.2)
    stage.add("bed", "cube", shift(-1.65, 0.2, -1.6) @ scale(0.85, 0.12, 0.95), frame)
    stage.add("mattress", soft, shift(-1.65, 0.43, -1.55) @ scale(0.82, 0.16, 0.92), quilt)
    stage.add("headboard", shapes.soft_box(0.3, 0.1), shift(-1.65, 0.55, -2.6) @ scale(0.88, 0.5, 0.06), frame)
    pillow = textures.speckled(rng, textures.hsv(pink, 0.06, 0.95), textures.hsv(pink + 0.4, 0.45, 0.8), cells=16)
    for index in range(2):
        tilt = turn("y", rng.uniform(-12, 12)) @ turn("x", 24)
        place = shift(-2.02 + 0.72 * index, 0.7, -2.22) @ tilt @ scale(0.33, 0.12, 0.24)
        stage.add(f"pillow_{index}", shapes.soft_box(0.9, 0.45), place, matte(pillow))
    stage.add("shelf", "cube", shift(0.5, 0.4, -2.45) @ scale(0.75, 0.4, 0.24), frame)
    for index in range(2):
        face = shift(0.14 + 0.72 * index, 0.42, -2.205) @ scale(0.33, 0.32, 0.012)
        stage.add(f"drawer_{index}", "cube", face, glossy(textures.hsv(pink + 0.03 * index, 0.35, 0.88), 0.35))
    mirror = shift(0.5, 1.62, -2.66) @ scale(0.52, 0.5, 0.03)
    stage.add("mirror_frame", "cube", mirror, metal(textures.hsv(0.1, 0.5, 0.85), 0.35))
    stage.add("mirror", RECTANGLE, shift(0.5, 1.62, -2.625) @ scale(0.46, 0.44, 1), metal((0.88, 0.88, 0.88), 0.2))
    rug = textures.tiles(rng, textures.hsv(pink + 0.5, 0.3, 0.8), textures.hsv(pink, 0.5, 0.8), count=12, grout=0.0)
    stage.add("rug", shapes.drum(), shift(0.25, 0.001, -0.45) @ scale(1.3, 0.012, 1.3), matte(rug))
    x = 0.0
    for index in range(4):
        thick, tall = rng.uniform(0.02, 0.04), rng.uniform(0.11, 0.16)
        x += 2 * thick + 0.004
        book = shift(-0.2 + x - thick, 0.8 + tall, -2.5) @ turn("z", -6 if index == 3 else 0) @ scale(thick, tall, 0.1)
        stage.add(f"book_{index}", "cube", book, glossy(textures.hsv(rng.random(), 0.5, 0.75), 0.45))
    glaze = glossy(textures.hsv(rng.random(), 0.4, 0.85), 0.2)
    stage.add("vase", shapes.vase(rng.uniform(0.3, 0.45), 0.18), shift(1.0, 0.8, -2.45) @ scale(0.34), glaze)


def _door(stage: Stage, pink: float) -> None:
    """A door at the back wall that swings on its hinge as if in a draught; its knob and its panel go with it."""
    rng = stage.rng
    period, reach = rng.uniform(60, 100), rng.uniform(16, 26)
    phase = rng.random()
    paint = glossy(textures.hsv(pink + 0.02, rng.uniform(0.05, 0.25), 0.92), 0.35)

    def hinge(frame: float) -> np.ndarray:
        return shift(2.44, 0, -2.62) @ turn("y", 34 + reach * swing(frame, period, phase))

    panel, knob = shift(-0.42, 1.25, 0) @ scale(0.28, 0.45, 0.04), shift(-0.74, 0.95, 0) @ scale(0.07)
    stage.add("door", "cube", lambda frame: hinge(frame) @ shift(-0.42, 1.0, 0) @ scale(0.42, 0.99, 0.025), paint)
    stage.add("door_knob", "sphere", lambda frame: hinge(frame) @ knob, metal(textures.hsv(0.12, 0.5, 0.9), 0.25))
    stage.add("door_panel", "cube", lambda frame: hinge(frame) @ panel, glossy(textures.hsv(pink, 0.45, 0.8), 0.35))


def _toys(stage: Stage) -> None:
    """A stacking tower, building blocks and a spinning top."""
    rng = stage.rng
    hue = rng.random()
    stage.add(
        "tower_rod", shapes.drum(0.8), shift(1.55, 0, -1.55) @ scale(0.05, 0.75, 0.05), glossy((0.8, 0.7, 0.5), 0.4)
    )
    height = 0.0
    for index in range(4):
        radius = 0.25 - 0.04 * index
        paint = glossy(textures.hsv(hue + 0.17 * index, 0.65, 0.85), 0.3)
        thick = 0.42 * radius
        stage.add(f"tower_{index}", shapes.ring(0.42), shift(1.55, height + thick, -1.55) @ scale(radius), paint)
        height += 2 * thick
    for index, (x, y, z) in enumerate([(-0.75, 0.13, 0.35), (-1.02, 0.13, 0.2), (-0.87, 0.39, 0.28)]):
        cube = shift(x, y, z) @ turn("y", rng.uniform(-10, 25)) @ scale(0.125)
        print_ = textures.painting(rng, [textures.hsv(shade, 0.55, 0.85) for shade in rng.random(3)])
        stage.add(f"block_{index}", shapes.soft_box(0.1, 0.1) if index == 2 else "cube", cube, glossy(print_, 0.4))
    bands = textures.stripes(rng, [textures.hsv(shade, 0.65, 0.85) for shade in rng.random(4)], count=8)
    body = shapes.lathe(
        [(0, 0), (0.06, 0.1), (0.5, 0.55), (0.56, 0.68), (0.5, 0.78), (0.1, 0.9), (0.07, 1.15), (0, 1.2)]
    )
    lap, lean, spin = rng.uniform(24, 38), rng.uniform(7, 12), rng.choice([-1, 1]) * rng.uniform(17, 29)

    def top(frame: float) -> np.ndarray:  # precesses about its tip
        return (
            shift(1.25, 0.013, -0.15)
            @ turn("y", 360 * frame / lap)
            @ turn("z", lean)
            @ turn("y", spin * frame)
            @ scale(0.36)
        )

    stage.add("top", body, top, glossy(bands, 0.22))


def _ball(stage: Stage) -> None:
    """A striped ball that bounces on an ellipse over the rug, rolling as it flies."""
    rng = stage.rng
    radius, lap = rng.uniform(0.2, 0.27), rng.uniform(52, 84) * rng.choice([-1, 1])
    beat, leap, phase = rng.uniform(13, 19), rng.uniform(0.35, 0.7), rng.random()
    bands = textures.stripes(
        rng, [textures.hsv(hue, 0.7, 0.88) for hue in rng.random() + np.array([0, 0.3, 0.55])], count=6
    )

    def ball(frame: float) -> np.ndarray:
        x, z = 0.2 + 0.75 * swing(frame, lap, phase), -1.1 + 0.45 * swing(frame, lap, phase + 0.25)
        place = shift(x, radius + 0.013 + leap * hop(frame, beat), z)
        return place @ turn("z", -7.5 * frame) @ turn("x", 30) @ scale(radius)

    stage.add("ball", "sphere", ball, glossy(bands, 0.3))


def _car(stage: Stage) -> None:
    """A toy car on a circular lap round the rug's front, with a driver and four turning wheels."""
    rng = stage.rng
    sense, lap, radius = rng.choice([-1.0, 1.0]), rng.uniform(52, 84), rng.uniform(0.42, 0.52)
    start, hue = rng.uniform(0, 360), rng.random()
    paint, trim = glossy(textures.hsv(hue, 0.75, 0.85), 0.22), glossy(textures.hsv(hue + 0.5, 0.4, 0.9), 0.3)
    rubber = matte(textures.stripes(rng, [np.array((0.06, 0.06, 0.07)), np.array((0.5, 0.5, 0.48))], count=6))

    def chassis(frame: float) -> np.ndarray:
        angle = start + sense * 360 * frame / lap
        x, z = 0.2 + radius * np.sin(np.radians(angle)), 0.3 + 0.8 * radius * np.cos(np.radians(angle))
        heading = np.degrees(np.arctan2(np.cos(np.radians(angle)), -0.8 * np.sin(np.radians(angle)))) + 90 * (sense - 1)
        return shift(x, 0.013, z) @ turn("y", heading)

    body, cabin = shapes.soft_box(0.35, 0.35), shapes.soft_box(0.45, 0.4)
    parts: list[tuple[str, str | shapes.Mesh, np.ndarray, Finish]] = [
        ("car_body", body, shift(0, 0.13, 0) @ scale(0.13, 0.08, 0.24), paint)
    ]
    parts += [("car_cabin", cabin, shift(0, 0.24, -0.05) @ scale(0.1, 0.08, 0.12), trim)]
    driver = matte(textures.hsv(0.09, 0.4, 0.9))
    for name, shape, local, material in [*parts, ("car_driver", "sphere", shift(0, 0.35, -0.04) @ scale(0.07), driver)]:
        stage.add(name, shape, attached(chassis, local), material)
    roll = 360 * 2 * np.pi * radius / lap / (2 * np.pi * 0.07)  # degrees a frame
    for index, (x, z) in enumerate([(-0.14, 0.14), (0.14, 0.14), (-0.14, -0.14), (0.14, -0.14)]):
        hub, tyre = shift(x, 0.07, z), turn("z", 90) @ shift(0, -0.025, 0) @ scale(0.07, 0.05, 0.07)

        def wheel(frame: float, hub: np.ndarray = hub, tyre: np.ndarray = tyre) -> np.ndarray:
            return chassis(frame) @ hub @ turn("x", roll * frame) @ tyre

        stage.add(f"wheel_{index}", shapes.drum(), wheel, rubber)
