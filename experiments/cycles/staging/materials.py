"""Materials: plain surfaces, procedural patterns, bumps, metals, glass, light, all drawn by the stage's seed."""

import colorsys
from collections.abc import Sequence
from typing import Any

import bpy

from experiments.cycles.staging.stage import Stage

Color = Sequence[float]
"""Linear red, green, blue."""

PATTERNS = {
    "noise": ("ShaderNodeTexNoise", {"Detail": 5.0}, "Fac"),
    "wood": ("ShaderNodeTexWave", {"Distortion": 6.0, "Detail": 4.0, "Detail Scale": 1.5}, "Fac"),
    "cells": ("ShaderNodeTexVoronoi", {}, "Distance"),
    "mosaic": ("ShaderNodeTexVoronoi", {}, "Color"),
    "checker": ("ShaderNodeTexChecker", {}, "Fac"),
    "brick": ("ShaderNodeTexBrick", {"Mortar Size": 0.015}, "Fac"),
    "magic": ("ShaderNodeTexMagic", {"Distortion": 2.0}, "Fac"),
}
"""Blender's texture node of each pattern, its inputs, and the output that is read."""


def color(stage: Stage, saturation: Sequence[float] = (0.05, 0.75), value: Sequence[float] = (0.1, 0.8)) -> Color:
    """A linear colour of any hue."""
    return colorsys.hsv_to_rgb(stage.between(0, 1), stage.between(*saturation), stage.between(*value))


def pale(stage: Stage) -> Color:
    """The colour of a wall: pale and nearly grey."""
    return color(stage, (0.02, 0.25), (0.45, 0.8))


def brown(stage: Stage) -> Color:
    """The colour of a wood."""
    return colorsys.hsv_to_rgb(stage.between(0.04, 0.1), stage.between(0.45, 0.8), stage.log_between(0.05, 0.5))


def green(stage: Stage) -> Color:
    """The colour of a leaf."""
    return colorsys.hsv_to_rgb(stage.between(0.2, 0.36), stage.between(0.5, 0.9), stage.log_between(0.08, 0.4))


def warm(stage: Stage) -> Color:
    """The light of a bulb."""
    return (1.0, stage.between(0.55, 0.85), stage.between(0.2, 0.6))


def plain(stage: Stage, base: Color | None = None, roughness: float | None = None, **inputs: Any) -> Any:
    """A surface without texture; ``inputs`` are those of the Principled BSDF, spaces as underscores."""
    made, bsdf = _new()
    bsdf.inputs["Base Color"].default_value = (*(base or color(stage)), 1.0)
    bsdf.inputs["Roughness"].default_value = stage.between(0.25, 0.9) if roughness is None else roughness
    for name, value in inputs.items():
        bsdf.inputs[name.replace("_", " ")].default_value = value
    return made


def metal(stage: Stage, roughness: float, base: Color | None = None, anisotropic: float = 0.0) -> Any:
    """A metal: of steel, brass, copper, gold or painted."""
    tints = [(0.6, 0.6, 0.62), (0.9, 0.7, 0.3), (0.95, 0.55, 0.38), (1.0, 0.78, 0.34), (0.4, 0.42, 0.45)]
    return plain(stage, base or stage.one_of(tints), roughness, Metallic=1.0, Anisotropic=anisotropic)


def mirror(stage: Stage) -> Any:
    """A clean mirror."""
    return plain(stage, (0.9, 0.9, 0.9), stage.one_of([0.0, 0.02]), Metallic=1.0)


def glass(stage: Stage, tint: Color = (1.0, 1.0, 1.0), roughness: float = 0.0) -> Any:
    """Clear, tinted or frosted glass that lets light through to what it shades, without caustics.

    For rays to lamps it is a tinted transparent surface: the usual way to light what stands behind glass.
    """
    made = plain(stage, tint, roughness, Transmission_Weight=1.0, IOR=stage.between(1.4, 1.6))
    tree = made.node_tree
    clear, mix = tree.nodes.new("ShaderNodeBsdfTransparent"), tree.nodes.new("ShaderNodeMixShader")
    clear.inputs["Color"].default_value = (*(0.9 * c for c in tint), 1.0)
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs["Is Shadow Ray"], mix.inputs["Fac"])
    tree.links.new(tree.nodes["Principled BSDF"].outputs["BSDF"], mix.inputs[1])
    tree.links.new(clear.outputs["BSDF"], mix.inputs[2])
    tree.links.new(mix.outputs["Shader"], tree.nodes["Material Output"].inputs["Surface"])
    return made


def cloth(stage: Stage, base: Color | None = None) -> Any:
    """A woven cloth with a soft sheen and a fine bump."""
    return patterned(
        stage, "noise", stage.between(20, 60), [base or color(stage), color(stage)], roughness=0.9, bump=0.3, mix=0.35
    )


def wood(stage: Stage, base: Color | None = None) -> Any:
    """Grained wood, oiled or raw."""
    dark = base or brown(stage)
    light = tuple(min(1.0, 1.9 * x + 0.02) for x in dark)
    rough = stage.between(0.25, 0.6)
    return patterned(stage, "wood", stage.between(2, 9), [dark, light], roughness=rough, bump=0.05)


def light(stage: Stage, tint: Color, strength: float) -> Any:
    """A surface that shines evenly."""
    return plain(stage, (0.0, 0.0, 0.0), 0.5, Emission_Color=(*tint, 1.0), Emission_Strength=strength)


def patterned(
    stage: Stage,
    pattern: str,
    scale: float,
    colors: Sequence[Color],
    *,
    roughness: float | None = None,
    metallic: float = 0.0,
    bump: float = 0.0,
    mix: float = 1.0,
    shine: float = 0.0,
    bump_pattern: str | None = None,
    wear: bool = False,
) -> Any:
    """A pattern that runs through colours, and may bend the normal (``bump``), wear the gloss and shine.

    ``scale`` is in repeats a metre, roughly; ``mix`` is the pattern's contrast; ``shine`` is the strength of light that
    the pattern itself sends out.
    """
    made, bsdf = _new()
    tree = made.node_tree
    value = _texture(stage, tree, pattern, scale)
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    if pattern == "mosaic":
        ramp.color_ramp.interpolation = "CONSTANT"
    _fill(ramp.color_ramp, colors, mix)
    tree.links.new(value, ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], bsdf.inputs["Base Color"])
    bsdf.inputs["Metallic"].default_value = metallic
    bsdf.inputs["Roughness"].default_value = stage.between(0.2, 0.9) if roughness is None else roughness
    if wear:
        spots = _texture(stage, tree, "noise", scale * stage.between(0.3, 1.2))
        spread = tree.nodes.new("ShaderNodeMapRange")
        low = stage.between(0.05, 0.3)
        spread.inputs["From Min"].default_value, spread.inputs["From Max"].default_value = 0.35, 0.65
        spread.inputs["To Min"].default_value, spread.inputs["To Max"].default_value = low, low + 0.4
        tree.links.new(spots, spread.inputs["Value"])
        tree.links.new(spread.outputs["Result"], bsdf.inputs["Roughness"])
    if bump:
        other = bump_pattern or pattern
        height = value if other == pattern else _texture(stage, tree, other, scale)
        _bend(tree, bsdf, height, bump)
    if shine:
        tree.links.new(ramp.outputs["Color"], bsdf.inputs["Emission Color"])
        bsdf.inputs["Emission Strength"].default_value = shine
    return made


def cut_out(stage: Stage, shade: Color) -> Any:
    """A leaf on a square sheet: its outline is a mask of alpha, its back lets light through.

    The sheet spans -0.5 to 0.5 in x and y of the object. Inside are the points with |x| < w (1 - (2 y)^2) (1 + 0.25 s),
    s a fine wave: serrated edges.
    """
    made, bsdf = _new()
    tree = made.node_tree
    bsdf.inputs["Base Color"].default_value = (*shade, 1.0)
    bsdf.inputs["Roughness"].default_value = stage.between(0.35, 0.6)
    place = tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"]
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(place, split.inputs["Vector"])
    x, y = (_maths(tree, "SUBTRACT", split.outputs[axis], 0.5) for axis in ("X", "Y"))
    wave = _maths(tree, "SINE", _maths(tree, "MULTIPLY", y, stage.between(40, 90)), 0.0)
    width = _maths(tree, "SUBTRACT", 1.0, _maths(tree, "POWER", _maths(tree, "MULTIPLY", y, 2.0), 2.0))
    ragged = _maths(tree, "ADD", _maths(tree, "MULTIPLY", wave, stage.between(0.05, 0.25)), 1.0)
    edge = _maths(tree, "MULTIPLY", _maths(tree, "MULTIPLY", width, ragged), stage.between(0.16, 0.32))
    inside = _maths(tree, "LESS_THAN", _maths(tree, "ABSOLUTE", x, 0.0), edge)
    tree.links.new(inside, bsdf.inputs["Alpha"])
    bsdf.inputs["Transmission Weight"].default_value = 0.0
    return made


def _new() -> tuple[Any, Any]:
    made = bpy.data.materials.new("material")
    made.use_nodes = True
    return made, made.node_tree.nodes["Principled BSDF"]


def _texture(stage: Stage, tree: Any, pattern: str, scale: float) -> Any:
    """The value of a pattern at a point of the object, turned and shifted at random."""
    kind, inputs, output = PATTERNS[pattern]
    node = tree.nodes.new(kind)
    for name, value in {**inputs, "Scale": scale}.items():
        node.inputs[name].default_value = value
    shift = tree.nodes.new("ShaderNodeMapping")
    shift.inputs["Location"].default_value = [stage.between(-9, 9) for _ in range(3)]
    if pattern not in ("brick", "checker"):
        shift.inputs["Rotation"].default_value = [stage.between(-0.4, 0.4) for _ in range(3)]
    place = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(place.outputs["Object"], shift.inputs["Vector"])
    tree.links.new(shift.outputs["Vector"], node.inputs["Vector"])
    return node.outputs[output]


def _fill(ramp: Any, colors: Sequence[Color], mix: float) -> None:
    """Colours at even steps of a ramp, drawn towards the first one where ``mix`` is below 1."""
    first = colors[0]
    while len(ramp.elements) < len(colors):
        ramp.elements.new(0.5)
    for i, shade in enumerate(colors):
        ramp.elements[i].position = 0.25 + 0.5 * i / max(len(colors) - 1, 1)
        ramp.elements[i].color = (*(a + mix * (b - a) for a, b in zip(first, shade, strict=True)), 1.0)


def _bend(tree: Any, bsdf: Any, height: Any, strength: float) -> None:
    bump = tree.nodes.new("ShaderNodeBump")
    bump.inputs["Strength"].default_value = min(strength, 1.0)
    bump.inputs["Distance"].default_value = 0.02
    tree.links.new(height, bump.inputs["Height"])
    tree.links.new(bump.outputs["Normal"], bsdf.inputs["Normal"])


def _maths(tree: Any, operation: str, first: Any, second: Any) -> Any:
    """The output of a maths node; inputs are sockets or numbers."""
    node = tree.nodes.new("ShaderNodeMath")
    node.operation = operation
    for i, given in enumerate((first, second)):
        if isinstance(given, int | float):
            node.inputs[i].default_value = given
        else:
            tree.links.new(given, node.inputs[i])
    return node.outputs[0]
