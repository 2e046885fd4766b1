"""A robot on its round: it walks a circle in a hall of columns and crates while a small drone circles around it."""

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
    scale,
    shift,
    swing,
    turn,
)

THIGH, SHIN, SOLE = 0.42, 0.42, 0.1  # hip to knee, knee to ankle, ankle to ground


def robot(seed: int, *, lamp: str = "mix") -> Stage:
    """An articulated robot (21 parts) walking in a tiled hall with columns, crates, a striped globe and a drone."""
    stage = Stage("robot", seed, lamp=lamp)
    rng = stage.rng
    hue = rng.random()
    tiled = textures.tiles(rng, textures.hsv(hue, 0.1, 0.85), textures.hsv(hue + 0.1, 0.35, 0.55), count=8)
    bricks = textures.bricks(rng, textures.hsv(rng.uniform(0.02, 0.12), rng.uniform(0.2, 0.5), 0.85), (0.6, 0.58, 0.55))
    plaster = textures.speckled(rng, textures.hsv(hue + 0.5, 0.12, 0.9), textures.hsv(hue + 0.5, 0.25, 0.8), cells=12)
    wall, back = matte(plaster, repeat=(2, 1)), matte(bricks, repeat=(2.5, 1.5))
    if rng.random() < 0.5:
        wall, back = back, wall
    floor = glossy(tiled, rng.uniform(0.2, 0.4), repeat=(2, 2))
    furnish_room(stage, (3.3, 3.3, 3.6), floor=floor, wall=wall, back=back, ceiling=matte((0.78, 0.78, 0.76)))
    light_room(stage, (float(rng.uniform(-1, 1)), float(rng.uniform(-0.6, 0.8))), power=1.0)
    _hall(stage)
    _walk(stage)
    _drone(stage)
    side = rng.uniform(-0.7, 0.7)
    drifting_camera(stage, (side, 1.5, 3.05), (0.15 * side, 1.05, -0.7), x_fov=58, reach=0.5)
    return stage


def _hall(stage: Stage) -> None:
    """Columns at the back, crates between them, a globe on a stand: none within the robot's circle."""
    rng = stage.rng
    rise = np.linspace(0, 1, 40)
    waist = 0.23 - 0.03 * rise
    base = [(0.0, 0.0), (0.34, 0.0)], [(0.34, 0.0), (0.34, 0.05)], [(0.34, 0.05), (0.24, 0.09)]
    shaft = np.stack([waist[2:-2], 0.06 + 0.88 * rise[2:-2]], -1)
    column = shapes.lathe(*base, shaft, [(0.2, 0.91), (0.32, 0.96)], [(0.32, 0.96), (0.32, 1.0)])
    height = stage.bounds[1, 1]
    veined = matte(textures.marble(rng, textures.hsv(rng.random(), 0.08, 0.9), textures.hsv(rng.random(), 0.3, 0.5)))
    for index, x in enumerate((-2.3, 2.3)):
        stage.add(f"column_{index}", column, shift(x, 0, -2.4) @ scale(1, height, 1), veined._replace(roughness=0.35))
    plank = textures.wood(rng, textures.hsv(0.08, 0.6, 0.55), textures.hsv(0.1, 0.45, 0.85), planks=4)
    for index, x in enumerate((-1.2, -0.35, 0.9)):
        size = rng.uniform(0.22, 0.38)
        place = shift(x + rng.uniform(-0.15, 0.15), size, -2.9 + rng.uniform(-0.1, 0.1)) @ turn(
            "y", rng.uniform(-25, 25)
        )
        surface = matte(plank) if index != 1 else glossy(textures.hsv(rng.random(), 0.6, 0.75), 0.4)
        stage.add(f"crate_{index}", "cube", place @ scale(size), surface)
        if index == 0:
            upper = shift(0.03, size + 0.2, 0) @ turn("y", rng.uniform(20, 60)) @ scale(0.2)
            stage.add(
                "crate_top",
                shapes.soft_box(0.12, 0.12),
                place @ upper,
                glossy(textures.hsv(rng.random(), 0.55, 0.8), 0.3),
            )
    drums = textures.stripes(rng, [textures.hsv(rng.random(), 0.6, 0.75), np.array((0.75, 0.73, 0.7))], count=2)
    stage.add("barrel", shapes.drum(), shift(-2.45, 0, -0.6) @ scale(0.33, 0.9, 0.33), glossy(drums, 0.35))
    bands = textures.stripes(rng, [textures.hsv(hue, 0.65, 0.85) for hue in rng.random(3)], count=9, slant=0.5)
    rate = rng.choice([-1, 1]) * rng.uniform(3, 7)
    stage.add(
        "globe_stand", shapes.drum(0.6), shift(2.35, 0, -0.7) @ scale(0.26, 0.55, 0.26), metal((0.75, 0.72, 0.68), 0.3)
    )
    tilt = shift(2.35, 0.9, -0.7) @ turn("z", 23)
    stage.add(
        "globe",
        "sphere",
        lambda frame: tilt @ turn("y", rate * frame) @ turn("x", -90) @ scale(0.36),
        glossy(bands, 0.3),
    )


def _stride(frame: float, period: float, phase: float) -> tuple[float, float]:
    """Degrees (hip forwards, knee backwards) of one leg: the knee bends while the leg swings forwards."""
    return 24 * swing(frame, period, phase), 6 + 44 * max(0.0, swing(frame, period, phase + 0.25)) ** 1.5


def _leg_length(hip: float, knee: float) -> float:
    """How far below the hip the sole is; the foot stays level."""
    return float(THIGH * np.cos(np.radians(hip)) + SHIN * np.cos(np.radians(hip - knee)) + SOLE)


def _walk(stage: Stage) -> None:
    """The robot: pelvis on a circle, its height such that the lower foot stands on the ground; limbs hang from it."""
    rng = stage.rng
    sense = rng.choice([-1.0, 1.0])
    radius, lap, stride = rng.uniform(0.75, 1.0), rng.uniform(60, 95), rng.uniform(15, 22)
    start = rng.uniform(0, 360)
    centre = np.array([rng.uniform(-0.2, 0.2), -0.9])
    first, second, third = (
        textures.hsv(hue, rng.uniform(0.5, 0.8), 0.8) for hue in rng.random() + np.array([0, 0.13, 0.5])
    )
    painted = glossy(textures.stripes(rng, [first, first * 0.75, third], count=6), rng.uniform(0.2, 0.35))
    shell, trim = glossy(first, rng.uniform(0.2, 0.4)), glossy(second, 0.3)
    steel = metal(textures.hsv(rng.uniform(0.05, 0.6), 0.12, 0.88), rng.uniform(0.2, 0.3))
    dark = glossy((0.05, 0.055, 0.07), 0.25)

    def ground(frame: float) -> np.ndarray:
        angle = start + sense * 360 * frame / lap
        place = shift(centre[0] + radius * np.sin(np.radians(angle)), 0, centre[1] + radius * np.cos(np.radians(angle)))
        return place @ turn("y", angle + 90 * sense)

    def pelvis(frame: float) -> np.ndarray:
        height = max(_leg_length(*_stride(frame, stride, phase)) for phase in (0.0, 0.5))
        return ground(frame) @ shift(0, height, 0)

    def chest(frame: float) -> np.ndarray:
        return pelvis(frame) @ turn("y", 8 * swing(frame, stride)) @ shift(0, 0.42, 0)

    look = rng.uniform(35, 60)

    def head(frame: float) -> np.ndarray:
        return (
            chest(frame)
            @ shift(0, 0.55, 0)
            @ turn("y", 40 * swing(frame, look))
            @ turn("x", 8 * swing(frame, 0.6 * look))
        )

    soft = shapes.soft_box(0.35, 0.45)
    _part(stage, "pelvis", soft, pelvis, scale(0.22, 0.12, 0.16), steel)
    _part(stage, "torso", soft, chest, scale(0.3, 0.34, 0.2), painted)
    _part(stage, "panel", "cube", chest, shift(0, 0.05, 0.19) @ scale(0.14, 0.1, 0.025), dark)
    _part(stage, "backpack", shapes.soft_box(0.2, 0.2), chest, shift(0, 0.03, -0.24) @ scale(0.2, 0.22, 0.09), trim)
    _part(stage, "head", shapes.soft_box(0.6, 0.6), head, scale(0.2, 0.18, 0.18), steel)
    _part(stage, "visor", soft, head, shift(0, 0.03, 0.15) @ scale(0.15, 0.05, 0.05), dark)
    _part(stage, "antenna", shapes.drum(0.4), head, shift(0.08, 0.15, 0) @ scale(0.02, 0.22, 0.02), steel)
    _part(stage, "antenna_ball", "sphere", head, shift(0.08, 0.4, 0) @ scale(0.045), trim)
    limb = shapes.lathe(
        [(0, -1), (0.8, -1)], [(0.8, -1), (1.0, -0.8), (1.0, -0.2), (0.75, 0)], [(0.75, 0), (0, 0)], segments=24
    )
    for side, name, phase in ((-1, "right", 0.0), (1, "left", 0.5)):
        _arm(stage, name, side, chest, stride, phase, limb, shell, steel)
        _leg(stage, name, side, pelvis, stride, phase, limb, trim, steel)


def _part(
    stage: Stage, name: str, shape: str | shapes.Mesh, joint: Motion, local: np.ndarray, material: Finish
) -> None:
    """A shape fixed to a moving joint.

    Args:
      stage: gets the shape.
      name: of the shape.
      shape: a primitive's name or a mesh.
      joint: motion of the joint.
      local: [4, 4] pose relative to the joint.
      material: of the shape.
    """
    stage.add(name, shape, attached(joint, local), material)


def _arm(
    stage: Stage,
    name: str,
    side: int,
    chest: Motion,
    stride: float,
    phase: float,
    limb: shapes.Mesh,
    shell: Finish,
    steel: Finish,
) -> None:
    """One arm: arms swing opposite to the legs; the elbow bends as the arm comes forwards.

    Args:
      stage: gets the shapes.
      name: suffix of the shapes' names.
      side: 1 or -1 along x.
      chest: motion of the chest.
      stride: period of a step cycle, in frames.
      phase: of the arm, in periods.
      limb: mesh of upper arm and forearm.
      shell: material of the limbs.
      steel: material of shoulder and hand.
    """

    def shoulder(frame: float) -> np.ndarray:
        return (
            chest(frame)
            @ shift(side * 0.38, 0.22, 0)
            @ turn("z", side * 9)
            @ turn("x", 30 * swing(frame, stride, phase))
        )

    def elbow(frame: float) -> np.ndarray:
        return shoulder(frame) @ shift(0, -0.36, 0) @ turn("x", -38 + 26 * swing(frame, stride, phase))

    _part(stage, f"shoulder_{name}", "sphere", shoulder, scale(0.115), steel)
    _part(stage, f"upper_arm_{name}", limb, shoulder, scale(0.085, 0.36, 0.085), shell)
    _part(stage, f"fore_arm_{name}", limb, elbow, scale(0.075, 0.34, 0.075), shell)
    _part(stage, f"hand_{name}", shapes.soft_box(0.4, 0.4), elbow, shift(0, -0.4, 0) @ scale(0.075, 0.09, 0.05), steel)


def _leg(
    stage: Stage,
    name: str,
    side: int,
    pelvis: Motion,
    stride: float,
    phase: float,
    limb: shapes.Mesh,
    trim: Finish,
    steel: Finish,
) -> None:
    """One leg with its foot.

    Args:
      stage: gets the shapes.
      name: suffix of the shapes' names.
      side: 1 or -1 along x.
      pelvis: motion of the pelvis.
      stride: period of a step cycle, in frames.
      phase: of the leg, in periods.
      limb: mesh of thigh and shin.
      trim: material of the limbs.
      steel: material of the joints.
    """

    def hip(frame: float) -> np.ndarray:
        return pelvis(frame) @ shift(side * 0.15, 0, 0) @ turn("x", -_stride(frame, stride, phase)[0])

    def knee(frame: float) -> np.ndarray:
        return hip(frame) @ shift(0, -THIGH, 0) @ turn("x", _stride(frame, stride, phase)[1])

    def ankle(frame: float) -> np.ndarray:
        forward, bend = _stride(frame, stride, phase)
        return knee(frame) @ shift(0, -SHIN, 0) @ turn("x", forward - bend)

    _part(stage, f"thigh_{name}", limb, hip, scale(0.1, THIGH, 0.1), trim)
    _part(stage, f"knee_{name}", "sphere", knee, scale(0.105), steel)
    _part(stage, f"shin_{name}", limb, knee, scale(0.085, SHIN, 0.085), trim)
    foot = shift(0, -0.5 * SOLE, 0.06) @ scale(0.1, 0.5 * SOLE, 0.19)
    _part(stage, f"foot_{name}", shapes.soft_box(0.3, 0.4), ankle, foot, steel)


def _drone(stage: Stage) -> None:
    """A small flying ring with a bright belly that circles around the robot, outside its own circle."""
    rng = stage.rng
    lap, radius, height = rng.uniform(28, 44) * rng.choice([-1, 1]), rng.uniform(1.68, 1.78), rng.uniform(1.9, 2.1)
    phase = rng.uniform(0, 360)

    def drone(frame: float) -> np.ndarray:
        orbit = turn("y", phase + 360 * frame / lap) @ shift(radius, height + 0.08 * swing(frame, 23), 0)
        return shift(0, 0, -1.0) @ orbit @ turn("z", 12) @ turn("y", 11 * frame)

    paint = glossy(textures.stripes(rng, [textures.hsv(hue, 0.7, 0.85) for hue in rng.random(2)], count=8), 0.3)
    _part(stage, "drone_ring", shapes.ring(0.22), drone, scale(0.17), paint)
    _part(
        stage, "drone_core", shapes.soft_box(0.7, 1.0), drone, scale(0.11, 0.07, 0.11), metal((0.8, 0.78, 0.75), 0.25)
    )
