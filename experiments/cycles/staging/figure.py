"""A person who walks: an articulated figure whose limbs swing about their joints."""

import math
from typing import Any

from experiments.cycles.staging import materials, shapes
from experiments.cycles.staging.stage import Point, Stage


def walker(stage: Stage, start: Point, end: Point, *, stride: float = 1.3) -> Any:
    """A figure that walks from one place to another over the clip; returns the group of its body.

    Thighs swing by a sine of the way; a knee bends while its leg comes forward; arms swing against the legs; the hips
    rise twice a stride.
    """
    heading = math.atan2(end[1] - start[1], end[0] - start[0]) + math.pi / 2
    size = stage.between(0.92, 1.08)
    parts = _limbs(stage, size)
    body = parts["body"]
    way = math.dist(start, end)
    phase0 = stage.between(0, 2 * math.pi)

    def phase(t: float) -> float:
        return phase0 + 2 * math.pi * t * way / (stride * size)

    def place(t: float) -> tuple[Point, Point]:
        bob = 0.025 * size * math.cos(2 * phase(t))
        x, y, z = (a + t * (b - a) for a, b in zip(start, end, strict=True))
        return (x, y, z + 0.93 * size + bob), (0.06, 0.03 * math.sin(phase(t)), heading)

    stage.move(body, place)
    for side, shift in (("left", 0.0), ("right", math.pi)):

        def swing(t: float, shift: float = shift) -> float:
            return math.sin(phase(t) + shift)

        def lift(t: float, shift: float = shift) -> float:
            return max(0.0, math.cos(phase(t) + shift))

        stage.move(parts[f"{side} thigh"], lambda t, swing=swing: (None, (-0.5 * swing(t), 0, 0)))  # type: ignore[misc]
        stage.move(parts[f"{side} shin"], lambda t, lift=lift: (None, (0.1 + 0.95 * lift(t), 0, 0)))  # type: ignore[misc]
        stage.move(parts[f"{side} arm"], lambda t, swing=swing: (None, (0.45 * swing(t), 0, 0)))  # type: ignore[misc]
        stage.move(
            parts[f"{side} forearm"],
            lambda t, swing=swing: (None, (-0.35 - 0.2 * swing(t), 0, 0)),  # type: ignore[misc]
        )
    return body


def _limbs(stage: Stage, size: float) -> dict[str, Any]:
    """The groups at the joints, by name, with the meshes that hang on them; the figure faces -y."""
    skin = materials.plain(stage, (0.6 * size, 0.36, 0.25), 0.5, Subsurface_Weight=0.1)
    shirt, trousers = materials.cloth(stage), materials.cloth(stage)
    shoe = materials.plain(stage, materials.color(stage, (0.1, 0.6), (0.02, 0.2)), 0.4)
    hair = materials.plain(stage, materials.brown(stage), 0.6)
    body = stage.group()
    trunk = [
        (0.0, -0.06),
        (0.15, -0.05),
        (0.165, 0.08),
        (0.14, 0.2),
        (0.18, 0.42),
        (0.12, 0.53),
        (0.05, 0.56),
        (0.05, 0.62),
    ]
    torso = stage.add(shapes.turned(_sized(trunk, size)), shirt, smooth=True, parent=body)
    torso.scale = (1.0, 0.68, 1.0)
    stage.add(
        shapes.ball(0.112 * size), skin, (0, -0.01, 0.73 * size), scale=(0.88, 1.0, 1.15), smooth=True, parent=body
    )
    cap = shapes.turned(_sized([(0.118, 0.0), (0.112, 0.05), (0.07, 0.11), (0, 0.13)], size))
    stage.add(cap, hair, (0, 0.015, 0.74 * size), turn=(-0.35, 0, 0), smooth=True, parent=body)
    parts = {"body": body}
    for side, x in (("left", -1), ("right", 1)):
        thigh = stage.group((x * 0.09 * size, 0, 0), parent=body)
        shin = stage.group((0, 0, -0.43 * size), parent=thigh)
        _limb(stage, trousers, thigh, 0.43 * size, (0.085, 0.06))
        _limb(stage, trousers, shin, 0.42 * size, (0.06, 0.045))
        foot = shapes.box(0.09 * size, 0.25 * size, 0.08 * size)
        stage.add(foot, shoe, (0, -0.06 * size, -0.49 * size), bevel=0.03, parent=shin)
        arm = stage.group((x * 0.2 * size, 0, 0.47 * size), (0, -x * 0.1, 0), parent=body)
        forearm = stage.group((0, 0, -0.28 * size), parent=arm)
        _limb(stage, shirt, arm, 0.28 * size, (0.055, 0.042))
        _limb(stage, shirt, forearm, 0.24 * size, (0.042, 0.034))
        stage.add(shapes.ball(0.045 * size, 16), skin, (0, 0, -0.28 * size), smooth=True, parent=forearm)
        parts |= {f"{side} thigh": thigh, f"{side} shin": shin, f"{side} arm": arm, f"{side} forearm": forearm}
    return parts


def _limb(stage: Stage, made: Any, joint: Any, long: float, radii: tuple[float, float]) -> None:
    """A limb with round ends that hangs from a joint."""
    wide, thin = radii
    profile = [
        (0, -long - thin),
        (thin * 0.8, -long - 0.6 * thin),
        (thin, -long),
        (wide, -0.15 * long),
        (wide * 0.8, 0.5 * wide),
        (0, wide * 0.9),
    ]
    stage.add(shapes.turned(profile, 20), made, smooth=True, parent=joint)


def _sized(profile: list[tuple[float, float]], size: float) -> list[tuple[float, float]]:
    return [(size * r, size * z) for r, z in profile]
