"""Fur and hair: a shaggy rug, furry balls that swing, brushes, heads of hair, in a room with soft light."""

import math
from typing import Any

import bpy
import numpy as np

from experiments.cycles.staging import cameras, lamps, materials, rooms, shapes
from experiments.cycles.staging.stage import Point, Stage


def build(stage: Stage) -> None:
    """A furnished room whose front is full of hair."""
    room = rooms.shell(stage)
    rooms.furnish(stage, room, crowd=0.5)
    lamps.window(stage, room, stage.log_between(60, 160))
    lamps.ceiling_panel(stage, room, stage.log_between(30, 90))
    middle = np.array([stage.between(-0.3, 0.3), 2.3, 0.0])
    rug(stage, middle, stage.between(1.6, 2.4), stage.between(1.0, 1.5))
    for i in range(stage.count(4, 7)):
        radius = stage.between(0.1, 0.24)
        at = middle + (stage.between(-1.0, 1.0), stage.between(-0.5, 0.6), radius + 0.05)
        body = furry_ball(stage, at, radius, stage.between(0.03, 0.14))
        speed, shift = stage.between(-1.2, 1.2), stage.between(-0.15, 0.15)
        if i < 3:
            stage.move(body, lambda t, at=at, s=shift, v=speed: (at + (s * t, 0, 0), (0, 0, v * t)))  # type: ignore[misc]
    eye = (middle[0] + stage.between(-0.6, 0.6), stage.between(0.3, 0.7), stage.between(0.7, 1.1))
    path = cameras.some_path(stage, eye, middle + (0, 0.2, 0.25), stage.between(0.15, 0.45))
    cameras.film(stage, path, lens=stage.between(26, 38))


def fibre(stage: Stage) -> Any:
    """Hair by melanin, or dyed."""
    made = bpy.data.materials.new("hair")
    made.use_nodes = True
    tree = made.node_tree
    bsdf = tree.nodes.new("ShaderNodeBsdfHairPrincipled")
    if stage.chance(0.6):
        bsdf.parametrization = "MELANIN"
        bsdf.inputs["Melanin"].default_value = stage.between(0.1, 0.9)
        bsdf.inputs["Melanin Redness"].default_value = stage.between(0.0, 1.0)
    else:
        bsdf.parametrization = "COLOR"
        bsdf.inputs["Color"].default_value = (*materials.color(stage, (0.2, 0.8), (0.2, 0.8)), 1.0)
    bsdf.inputs["Roughness"].default_value = stage.between(0.2, 0.5)
    tree.links.new(bsdf.outputs["BSDF"], tree.nodes["Material Output"].inputs["Surface"])
    return made


def strands(
    stage: Stage, roots: np.ndarray, outward: np.ndarray, long: float, thick: float, made: Any, parent: Any
) -> Any:
    """Curves from roots [N, 3] along directions [N, 3] that bend down and part into tufts."""
    number, points = len(roots), 6
    tuft = stage.rng.normal(size=(max(number // 40, 1), 3))
    bend = tuft[stage.rng.integers(len(tuft), size=number)] * 0.35 + stage.rng.normal(size=(number, 3)) * 0.15
    length = long * stage.rng.uniform(0.6, 1.0, (number, 1))
    t = np.linspace(0, 1, points)[:, None, None]
    path = roots + length * (t * outward + t**2 * (bend + (0, 0, -0.35)))
    data = bpy.data.hair_curves.new("hair")
    data.add_curves([points] * number)
    data.points.foreach_set("position", np.swapaxes(path, 0, 1).astype(np.float32).ravel())
    radii = np.tile(thick * (1 - 0.85 * np.linspace(0, 1, points)), number).astype(np.float32)
    data.points.foreach_set("radius", radii)
    data.materials.append(made)
    thing = bpy.data.objects.new("hair", data)
    thing.parent = parent
    thing.pass_index = parent.pass_index if parent else 900
    stage.scene.collection.objects.link(thing)
    return thing


def rug(stage: Stage, at: Point, length: float, depth: float) -> None:
    """A shaggy rug."""
    number = stage.count(9000, 14000)
    x, y, z = at
    roots = stage.rng.uniform((-length / 2, -depth / 2, 0), (length / 2, depth / 2, 0.001), (number, 3)) + (x, y, z)
    outward = stage.rng.normal(size=(number, 3)) * 0.3 + (0, 0, 1)
    stage.add(shapes.box(length, depth, 0.01), materials.plain(stage), at)
    strands(stage, roots, outward, stage.between(0.05, 0.1), stage.between(0.0015, 0.003), fibre(stage), None)


def furry_ball(stage: Stage, at: Point, radius: float, long: float) -> Any:
    """A ball with fur; returns its thing, which the fur follows."""
    body = stage.add(shapes.ball(radius), materials.plain(stage), at, smooth=True)
    number = int(stage.between(5000, 11000) * math.sqrt(radius / 0.2))
    outward = stage.rng.normal(size=(number, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    strands(stage, radius * outward, outward, long, stage.between(0.0008, 0.002), fibre(stage), body)
    return body
