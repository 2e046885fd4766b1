"""Small scenes, each with the effects that it has: from a static grey box to a room in which everything moves.

A scene is a box of six walls, a lamp, its contents, and an animation. It is built from materials and animations, so
that random scenes can be drawn from them too.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn.clips import write_image

FRAMES = 4
LIT = {"indirect"}


def rgb(name: str, value: str) -> str:
    return f'<rgb name="{name}" value="{value}"/>'


def checker(name: str, first: str = "0.2 0.3 0.6", second: str = "0.7 0.6 0.3") -> str:
    return f'<texture type="checkerboard" name="{name}">{rgb("color0", first)}{rgb("color1", second)}</texture>'


def rough_texture(low: float, high: float) -> str:
    return (
        f'<texture type="checkerboard" name="alpha"><float name="color0" value="{low}"/>'
        f'<float name="color1" value="{high}"/></texture>'
    )


def bsdf(kind: str, inner: str = "") -> str:
    return f'<bsdf type="{kind}">{inner}</bsdf>'


def number(name: str, value: float) -> str:
    return f'<float name="{name}" value="{value}"/>'


BUMPS = (
    '<texture type="bitmap" name="arbitrary"><string name="filename" value="bumps.exr"/>'
    '<boolean name="raw" value="true"/></texture>'
)
GREY = bsdf("twosided", bsdf("diffuse", rgb("reflectance", "0.5")))
BLACK = bsdf("diffuse", rgb("reflectance", "0"))

MATERIALS: dict[str, tuple[str, set[str]]] = {
    "grey": (GREY, set()),
    "checkered": (bsdf("twosided", bsdf("diffuse", checker("reflectance"))), {"texture"}),
    "rough metal": (bsdf("roughconductor", number("alpha", 0.3)), {"specular", "glossy"}),
    "metal of roughness 1": (bsdf("roughconductor", number("alpha", 1.0)), {"specular"}),
    "plastic of roughness 1": (bsdf("roughplastic", number("alpha", 1.0)), {"specular"}),
    "textured roughness": (bsdf("roughconductor", rough_texture(0.2, 1.0)), {"specular", "glossy"}),
    "textured roughness 1": (bsdf("roughconductor", rough_texture(1.0, 1.0)), {"specular"}),
    "mirror": (bsdf("conductor"), {"specular", "mirror"}),
    "smooth plastic": (bsdf("plastic"), {"specular", "mirror"}),
    "glass": (bsdf("dielectric"), {"specular", "mirror", "transmission"}),
    "thin glass": (bsdf("thindielectric"), {"specular", "mirror", "transmission"}),
    "rough glass": (bsdf("roughdielectric", number("alpha", 0.2)), {"specular", "glossy", "transmission"}),
    "principled": (bsdf("principled", number("roughness", 0.4)), {"specular", "glossy"}),
    "principled matt": (bsdf("principled", number("roughness", 1.0)), {"specular"}),
    "principled metal, textured": (
        bsdf("principled", number("metallic", 1.0) + number("roughness", 0.3) + checker("base_color")),
        {"specular", "glossy"},
    ),
    "principled glass": (
        bsdf("principled", number("spec_trans", 1.0) + number("roughness", 0.3) + number("eta", 1.5)),
        {"specular", "glossy", "transmission"},
    ),
    "blend": (
        bsdf("blendbsdf", number("weight", 0.4) + bsdf("diffuse", checker("reflectance")) + bsdf("conductor")),
        {"specular", "texture", "mirror"},
    ),
    "blend of one": (
        bsdf("blendbsdf", number("weight", 0.0) + bsdf("diffuse") + bsdf("conductor")),
        {"specular"},  # so its flags say
    ),
    "two sides": (
        bsdf("twosided", bsdf("diffuse") + bsdf("roughconductor", number("alpha", 0.2))),
        {"specular", "glossy"},
    ),
    "deep inside": (
        bsdf("mask", number("opacity", 1.0) + bsdf("twosided", bsdf("roughplastic", number("alpha", 0.2)))),
        {"specular", "glossy"},
    ),
    "bumpy": (bsdf("bumpmap", BUMPS + bsdf("diffuse")), set()),
    "cut-out": (bsdf("mask", number("opacity", 0.5) + bsdf("diffuse")), {"specular", "transmission"}),
}
"""Name -> XML and the effects of the material."""

# The camera stands at z = 3.5 and looks along -z; the lamp is behind it, or in view under the ceiling.
STILL: dict[str, Any] = {}
MOVES = [
    {"frame": 0, "origin": [0, 1, 3.5], "target": [0, 1, 0]},
    {"frame": 3, "origin": [0.3, 1, 3.5], "target": [0, 1, 0]},
]
ACROSS = [{"frame": 0, "translation": [0, 0, 0]}, {"frame": 3, "translation": [0.5, 0, 0]}]
NOWHERE = [{"frame": 0, "translation": [0.1, 0.2, 0]}, {"frame": 3, "translation": [0.1, 0.2, 0]}]
LATE = [{"frame": 1, "translation": [0, 0, 0]}, {"frame": 3, "translation": [0.5, 0, 0]}]

OBJECT = {"object-motion", "disocclusion", "moving-shadow"}
CAMERA = {"camera-motion", "disocclusion"}

ANIMATIONS: dict[str, tuple[dict[str, Any], set[str]]] = {
    "still": (STILL, set()),
    "nothing moves": (
        {"camera": [MOVES[0] | {"frame": f} for f in (0, 3)], "shapes": {"ball": {"keys": NOWHERE}}},
        set(),
    ),
    "camera": ({"camera": MOVES}, CAMERA),
    "ball": ({"shapes": {"ball": {"keys": ACROSS}}}, OBJECT),
    "ball, later": ({"shapes": {"ball": {"keys": LATE}}}, OBJECT),
    "behind the camera": ({"shapes": {"behind": {"keys": ACROSS}}}, {"moving-shadow"}),
    "dimmed": ({"lights": {"lamp": [{"frame": 0, "scale": 1}, {"frame": 3, "scale": 0.2}]}}, {"changing-light"}),
    "lamp, unseen": ({"shapes": {"lamp": {"keys": ACROSS}}}, {"changing-light", "moving-shadow"}),
    "everything": (
        {
            "camera": MOVES,
            "shapes": {"ball": {"keys": ACROSS}, "behind": {"keys": ACROSS}},
            "lights": {"lamp": [{"frame": 0, "scale": 1}, {"frame": 3, "scale": 0.2}]},
        },
        OBJECT | CAMERA | {"changing-light"},
    ),
}
"""Name -> animation of the room and its effects."""


def rectangle(name: str, transform: str, material: str = GREY, emitter: str = "") -> str:
    place = f'<transform name="to_world">{transform}</transform>'
    return f'<shape type="rectangle" id="{name}">{place}{material}{emitter}</shape>'


def area(radiance: float = 10) -> str:
    return f'<emitter type="area">{rgb("radiance", str(radiance))}</emitter>'


def ball(material: str, name: str = "ball", place: str = 'x="0" y="0.6" z="0"') -> str:
    return (
        f'<shape type="sphere" id="{name}"><transform name="to_world"><scale value="0.5"/><translate {place}/>'
        f"</transform>{material}</shape>"
    )


def box(*, wall: str = GREY, open_front: bool = False) -> str:
    parts = {
        "floor": '<rotate x="1" angle="-90"/><scale value="2 1 4"/>',
        "ceiling": '<rotate x="1" angle="90"/><scale value="2 1 4"/><translate y="2"/>',
        "left": '<rotate y="1" angle="90"/><scale value="1 1 4"/><translate x="-2" y="1"/>',
        "right": '<rotate y="1" angle="-90"/><scale value="1 1 4"/><translate x="2" y="1"/>',
        "front": '<rotate y="1" angle="180"/><scale value="2 1 1"/><translate y="1" z="4"/>',
    }
    if not open_front:
        parts["back"] = '<scale value="2 1 1"/><translate y="1" z="-2"/>'
    return "".join(rectangle(name, place, wall if name == "floor" else GREY) for name, place in parts.items())


BEHIND = rectangle("lamp", '<rotate x="1" angle="90"/><scale value="0.5"/><translate y="1.99" z="3.7"/>', "", area())
SEEN = rectangle("lamp", '<rotate x="1" angle="90"/><scale value="0.5"/><translate y="1.9" z="-1"/>', "", area())
SENSOR = (
    '<sensor type="perspective"><float name="fov" value="60"/><transform name="to_world">'
    '<lookat origin="0,1,3.5" target="0,1,0" up="0,1,0"/></transform></sensor>'
)
FAR_BALL = ball(GREY, "behind", 'x="0" y="0.5" z="6"')
"""It is outside the box, behind the camera."""
INTEGRATOR = '<integrator type="path"><integer name="max_depth" value="6"/></integrator>'


class Case(NamedTuple):
    """A scene, its animation and the effects that it has."""

    xml: str
    animation: dict[str, Any]
    effects: set[str]
    uncertain: frozenset[str] = frozenset()

    def write(self, folder: Path) -> Path:
        """Write the scene with its animation next to it; returns the scene's path."""
        path = folder / "scene.xml"
        write_image(folder / "bumps.exr", np.random.default_rng(0).random((8, 8, 3)).astype(np.float32))
        path.write_text(f'<scene version="3.0.0">{INTEGRATOR}{SENSOR}{self.xml}</scene>')
        path.with_suffix(".json").write_text(json.dumps({"frames": FRAMES, **self.animation}))
        return path


def room(material: str = "grey", animation: str = "still", *, lamp: str = BEHIND) -> Case:
    """A closed room with a ball of some material in view."""
    xml, material_effects = MATERIALS[material]
    keys, animation_effects = ANIMATIONS[animation]
    effects = LIT | material_effects | animation_effects | ({"emission"} if lamp == SEEN else set())
    return Case(box() + lamp + ball(xml) + FAR_BALL, keys, effects)


OUT_OF_VIEW = [
    {"frame": 0, "translation": [0, 0, 0]},
    {"frame": 1, "translation": [0, 0, 4]},
    {"frame": 3, "translation": [0, 0, 5]},
]
INSTANCES = (
    '<shape type="shapegroup" id="group"><shape type="sphere" id="one"><transform name="to_world">'
    f'<scale value="0.3"/></transform>{bsdf("conductor")}</shape></shape>'
    '<shape type="instance" id="ball"><ref id="group"/>'
    '<transform name="to_world"><translate y="0.5"/></transform></shape>'
)
ENVIRONMENT = '<emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>'
MEDIUM = (
    '<shape type="cube" id="fog"><transform name="to_world"><scale value="0.3"/><translate y="0.5"/></transform>'
    '<bsdf type="null"/><medium name="interior" type="homogeneous"><rgb name="sigma_t" value="1"/>'
    '<rgb name="albedo" value="0.5"/></medium></shape>'
)
# One flat picture fills the view: however the camera moves, nothing can be disoccluded.
PICTURE = rectangle(
    "picture", '<scale value="40"/><translate z="-2"/>', bsdf("twosided", bsdf("diffuse", checker("reflectance")))
)
GLOWING = rectangle("lamp", '<scale value="0.5"/><translate y="1" z="-1"/>', BLACK, area())

CASES: dict[str, Case] = {
    "static grey box": Case(box() + BEHIND, {}, LIT),
    "static box, lamp seen": Case(box() + SEEN, {}, LIT | {"emission"}),
    "static textured box": Case(box(wall=MATERIALS["checkered"][0]) + BEHIND, {}, LIT | {"texture"}),
    **{f"a ball: {name}": room(name) for name in MATERIALS},
    **{f"moving: {name}": room("grey", name) for name in ANIMATIONS if name != "still"},
    "a light that moves out of view": Case(
        box() + SEEN,
        {"shapes": {"lamp": {"keys": OUT_OF_VIEW}}},
        LIT | OBJECT | {"changing-light", "emission"},
    ),
    "only emission": Case(GLOWING, {}, {"emission"}),
    "no light": Case(box(), {}, set()),
    "instances": Case(box() + BEHIND + INSTANCES, {}, LIT | {"specular", "mirror"}),
    "instances that move": Case(
        box() + BEHIND + INSTANCES, ANIMATIONS["ball"][0], LIT | OBJECT | {"specular", "mirror", "moving-reflection"}
    ),
    "open to the sky": Case(box(open_front=True) + ENVIRONMENT, {}, LIT | {"environment", "emission"}),
    "a sky that cannot be seen": Case(
        box() + ENVIRONMENT, {}, LIT | {"environment", "emission"}, frozenset({"emission"})
    ),
    "fog": Case(box() + BEHIND + MEDIUM, {}, LIT | {"media", "specular", "transmission"}),
    "one picture, camera moves": Case(PICTURE + BEHIND, {"camera": MOVES}, {"camera-motion", "texture"}),
    "a room in which everything moves": Case(
        box(wall=MATERIALS["checkered"][0])
        + SEEN
        + ball(MATERIALS["glass"][0])
        + FAR_BALL
        + ball(MATERIALS["rough metal"][0], "metal", 'x="-1" y="0.5" z="-1"'),
        ANIMATIONS["everything"][0],
        LIT
        | OBJECT
        | CAMERA
        | {
            "changing-light",
            "emission",
            "texture",
            "specular",
            "mirror",
            "transmission",
            "glossy",
            "moving-reflection",
        },
    ),
}
"""Name -> scene with exactly the effects that have to be found."""
