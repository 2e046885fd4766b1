"""A hanging mobile turns over a toy landscape: three arms at three rates, moon, stars, planets, and a train below."""

import numpy as np

from jaxdn.render.families import shapes, textures
from jaxdn.render.families.staging import (
    Finish,
    Motion,
    Stage,
    attached,
    drifting_camera,
    furnish_room,
    glossy,
    light_room,
    matte,
    metal,
    rod,
    scale,
    shift,
    swing,
    turn,
)

CENTRE = (0.0, -0.5)
GROUND = 0.45  # height of the table that carries the landscape
REACH = 0.34  # half the length of the mobile's small arms


def mobile(seed: int, *, lamp: str = "mix") -> Stage:
    """A mobile of two tiers over hills with trees, houses, a pond, a little train and a paper glider."""
    stage = Stage("mobile", seed, lamp=lamp)
    rng = stage.rng
    hue = rng.uniform(0.45, 0.75)
    starry = textures.speckled(
        rng, textures.hsv(hue, 0.22, 0.94), textures.hsv(0.14, 0.25, 0.97), cells=22, amount=0.25
    )
    tiled = textures.tiles(rng, textures.hsv(0.1, 0.2, 0.85), textures.hsv(hue, 0.25, 0.65), count=10)
    wall = matte(starry, repeat=(2, 1))
    floor = glossy(tiled, rng.uniform(0.25, 0.4), repeat=(2, 2))
    furnish_room(stage, (2.7, 2.9, 2.7), floor=floor, wall=wall, back=wall, ceiling=matte((0.8, 0.8, 0.82)))
    light_room(stage, (float(rng.uniform(0.9, 1.3)) * rng.choice([-1, 1]), float(rng.uniform(0.6, 1.0))), power=1.0)
    _landscape(stage)
    _mobile(stage)
    _train(stage)
    _glider(stage)
    side = rng.uniform(-0.5, 0.5)
    drifting_camera(stage, (side, 1.62, 1.9), (0.1 * side, 1.02, -0.6), x_fov=60, reach=0.32)
    return stage


def _on_ground(x: float, y: float, z: float) -> np.ndarray:
    return shift(CENTRE[0] + x, GROUND + y, CENTRE[1] + z)


def _landscape(stage: Stage) -> None:
    """A low table with hills at its rim, and on its level middle trees, houses and a pond."""
    rng = stage.rng
    oak = glossy(textures.wood(rng, textures.hsv(0.07, 0.6, 0.55), textures.hsv(0.09, 0.5, 0.8)), 0.35)
    stage.add("table", shapes.soft_box(0.15, 0.1), _on_ground(0, -0.225, 0) @ scale(1.62, 0.224, 1.32), oak)
    grass = textures.speckled(
        rng, textures.hsv(rng.uniform(0.2, 0.32), 0.55, 0.7), textures.hsv(0.18, 0.55, 0.8), cells=18
    )
    land = shapes.hills(rng, height=rng.uniform(0.25, 0.4), level=0.72)
    stage.add("hills", land, _on_ground(0, 0.003, 0) @ scale(1.5, 1.0, 1.2), matte(grass, repeat=(2, 2)))
    stage.add(
        "pond",
        shapes.drum(0.97),
        _on_ground(0.25, -0.005, 0.4) @ scale(0.26, 0.016, 0.2),
        glossy((0.08, 0.2, 0.32), 0.15),
    )
    leaf = [glossy(textures.hsv(rng.uniform(0.22, 0.4), 0.6, 0.6), 0.5) for _ in range(2)]
    bark = matte(textures.hsv(0.07, 0.6, 0.45))
    tree = shapes.lathe(
        [(0, 0), (1, 0)], [(1, 0), (0.4, 0.8)], [(0.4, 0.8), (0.75, 0.8)], [(0.75, 0.8), (0, 1.9)], segments=24
    )
    spots = [(-0.72, -0.32), (0.78, -0.25), (-0.2, 0.5), (-0.78, 0.3)]
    for index, (x, z) in enumerate(spots):
        x, z, size = x + rng.uniform(-0.05, 0.05), z + rng.uniform(-0.05, 0.05), rng.uniform(0.1, 0.15)
        stage.add(f"trunk_{index}", shapes.drum(0.7), _on_ground(x, 0, z) @ scale(0.035, 0.14, 0.035), bark)
        crown = tree if index % 2 else "sphere"
        rise = 0.1 if index % 2 else 0.12 + 0.8 * size
        stage.add(f"crown_{index}", crown, _on_ground(x, rise, z) @ scale(size), leaf[index % 2])
    for index, (x, z) in enumerate([(-0.42, -0.42), (0.42, -0.5)]):
        wall = matte(textures.bricks(rng, textures.hsv(rng.uniform(0.0, 0.15), 0.3, 0.92), (0.5, 0.45, 0.4)))
        place = _on_ground(x, 0, z) @ turn("y", rng.uniform(-30, 30))
        stage.add(f"house_{index}", "cube", place @ shift(0, 0.11, 0) @ scale(0.15, 0.11, 0.13), wall)
        red = glossy(textures.hsv(rng.uniform(-0.04, 0.07), 0.75, 0.75), 0.45)
        stage.add(f"roof_{index}", shapes.roof(), place @ shift(0, 0.22, 0) @ scale(0.18, 0.15, 0.16), red)


def _mobile(stage: Stage) -> None:
    """An arm under the ceiling; from its ends hang smaller arms with two toys each, from its middle a sun."""
    rng = stage.rng
    top, main, hue = stage.bounds[1, 1], 1.95, rng.random()
    sense = rng.choice([-1, 1])
    rate = sense * rng.uniform(3.0, 4.6)
    brass = metal(textures.hsv(0.11, 0.5, 0.88), 0.3)
    x, z = CENTRE

    def boom(frame: float) -> np.ndarray:
        return shift(x, main, z) @ turn("y", rate * frame) @ turn("z", 4 * swing(frame, 47))

    stage.add("cord", shapes.drum(), rod((x, main, z), (x, top, z), 0.012), matte((0.6, 0.58, 0.55)))
    bands = [textures.hsv(hue, 0.6, 0.8), np.array((0.8, 0.78, 0.72))]
    stage.add(
        "boom",
        shapes.drum(),
        lambda frame: boom(frame) @ rod((-0.72, 0, 0), (0.72, 0, 0), 0.025),
        glossy(textures.stripes(rng, bands, count=2), 0.35),
    )
    _toy(stage, "sun", shapes.star(9, inner=0.7), boom, (0, -0.42, 0), 0.17, glossy(textures.hsv(0.13, 0.8, 0.95), 0.3))
    for index, end in enumerate((-0.7, 0.7)):
        arm = _arm(stage, index, boom, end, -sense * rng.uniform(5.0, 9.0), brass)
        for side in (-1, 1):
            number = 2 * index + (side + 1) // 2
            shape, size, material = _toy_kind(stage, number, hue)
            _toy(stage, f"toy_{number}", shape, arm, (side * REACH, -rng.uniform(0.26, 0.42), 0), size, material)


def _arm(stage: Stage, index: int, boom: Motion, end: float, rate: float, brass: Finish) -> Motion:
    """A small arm on a link below the boom's end; returns the joint from which its toys hang.

    Args:
      stage: gets the shapes.
      index: of the arm.
      boom: motion of the large arm.
      end: x of the boom's end.
      rate: of rotation, in degrees per frame.
      brass: the material.
    """
    drop, phase = stage.rng.uniform(0.16, 0.24), stage.rng.uniform(0, 360)
    link, bar = rod((end, 0, 0), (end, -drop, 0), 0.008), rod((-REACH, 0, 0), (REACH, 0, 0), 0.018)

    def arm(frame: float) -> np.ndarray:
        return boom(frame) @ shift(end, -drop, 0) @ turn("y", phase + rate * frame)

    stage.add(f"link_{index}", shapes.drum(), lambda frame: boom(frame) @ link, brass)
    stage.add(f"arm_{index}", shapes.drum(), lambda frame: arm(frame) @ bar, brass)
    return arm


def _toy_kind(stage: Stage, number: int, hue: float) -> tuple[str | shapes.Mesh, float, Finish]:
    """A ringed planet's body, a star, a soft cube or a torus, each in its own finish."""
    rng = stage.rng
    color = textures.hsv(hue + 0.21 * number + 0.1, 0.65, 0.88)
    if number == 0:
        bands = textures.stripes(rng, [color, textures.hsv(hue + 0.5, 0.4, 0.9), color * 0.6], count=6, slant=0.5)
        return "sphere", 0.16, glossy(bands, 0.25)
    if number == 1:
        return shapes.star(5), 0.19, metal(textures.hsv(0.13, 0.5, 0.92), 0.25)
    if number == 2:
        picture = textures.painting(rng, [textures.hsv(shade, 0.6, 0.88) for shade in rng.random(4)])
        return shapes.soft_box(0.3, 0.3), 0.13, glossy(picture, 0.35)
    return shapes.ring(0.38), 0.13, glossy(color, 0.25)


def _toy(
    stage: Stage,
    name: str,
    shape: str | shapes.Mesh,
    joint: Motion,
    place: tuple[float, float, float],
    size: float,
    material: Finish,
) -> None:
    """A toy on a thread below a joint, slowly turning about its thread.

    Args:
      stage: gets the shapes.
      name: of the toy.
      shape: of the toy.
      joint: motion of the joint.
      place: of the toy below the joint.
      size: scale of the shape.
      material: of the toy.
    """
    rate, tilt = stage.rng.uniform(4, 9) * stage.rng.choice([-1, 1]), stage.rng.uniform(10, 40)
    hang = shift(*place)
    thread = rod((place[0], 0, place[2]), place, 0.007)
    stage.add(f"{name}_thread", shapes.drum(), lambda frame: joint(frame) @ thread, matte((0.7, 0.68, 0.62)))
    lean = turn("x", tilt) if isinstance(shape, str) else turn("x", 90 if name == "toy_3" else 0)
    stage.add(name, shape, lambda frame: joint(frame) @ hang @ turn("y", rate * frame) @ lean @ scale(size), material)


def _train(stage: Stage) -> None:
    """An engine and two wagons on an oval track round the village."""
    rng = stage.rng
    lap, start = rng.uniform(75, 115) * rng.choice([-1, 1]), rng.random()
    wide, deep = 0.98, 0.74
    track = shapes.ring(0.03)
    stage.add("track", track, _on_ground(0, -0.008, 0) @ scale(wide, 0.9, deep), metal((0.6, 0.58, 0.56), 0.4))
    hue = rng.random()
    boxy = shapes.soft_box(0.25, 0.25)

    def carriage(behind: float) -> Motion:
        """The motion of a point of the train that passes everywhere `behind` frames after the engine."""

        def motion(frame: float) -> np.ndarray:
            angle = 2 * np.pi * (start + (frame - behind) / lap)
            heading = np.degrees(np.arctan2(wide * np.cos(angle), -deep * np.sin(angle))) + (0 if lap > 0 else 180)
            return _on_ground(wide * np.sin(angle), 0.02, deep * np.cos(angle)) @ turn("y", heading)

        return motion

    spacing = 0.3 / (2 * np.pi * 0.86) * abs(lap)
    for index, name in enumerate(("engine", "wagon_0", "wagon_1")):
        paint = glossy(textures.hsv(hue + 0.3 * index, 0.7, 0.85), 0.28)
        local = shift(0, 0.1, 0) @ scale(0.075, 0.075, 0.125)
        stage.add(name, boxy, attached(carriage(index * spacing), local), paint)
    chimney = shift(0, 0.16, 0.07) @ scale(0.028, 0.11, 0.028)
    stage.add("chimney", shapes.drum(1.0), attached(carriage(0), chimney), metal((0.8, 0.6, 0.35), 0.3))


def _glider(stage: Stage) -> None:
    """A paper glider that circles outside the mobile and banks into its turn."""
    rng = stage.rng
    lap, phase = rng.uniform(58, 85) * rng.choice([-1, 1]), rng.uniform(0, 360)
    radius, height = rng.uniform(1.3, 1.42), rng.uniform(1.2, 1.5)
    corners = [(0.0, 0.0, 0.6), (-0.45, 0.08, -0.4), (0.45, 0.08, -0.4), (0.0, -0.16, -0.4), (0.0, 0.02, -0.4)]
    paper = shapes.flat(corners, [(0, 1, 4), (0, 4, 2), (0, 3, 1), (0, 2, 3), (1, 3, 4), (4, 3, 2)])
    lines = textures.stripes(rng, [np.array((0.85, 0.84, 0.8)), textures.hsv(rng.random(), 0.5, 0.85)], count=6)

    def glider(frame: float) -> np.ndarray:
        around = turn("y", phase + 360 * frame / lap) @ shift(radius, 0, 0) @ turn("y", 180 if lap > 0 else 0)
        rise = shift(CENTRE[0], height + 0.12 * swing(frame, 0.7 * abs(lap)), CENTRE[1])
        return rise @ around @ turn("z", 25 if lap > 0 else -25) @ scale(0.4)

    stage.add("glider", paper, glider, matte(lines))
