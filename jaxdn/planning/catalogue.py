"""The effects that a scene may have: how each is detected, and what is needed to simulate it.

Effects are data, and the planner treats all of them equally: for a method that reads a new buffer, add the buffer to
the effects that produce it, or add an effect. The absence of an effect equals the neutral value of its buffers
(:data:`jaxdn.core.frame.BUFFERS`).
"""

from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

from jaxdn.planning.scene_properties import Moment, SceneProperties

NoisyLight = Literal["indirect", "reflected"]
"""The light that is rendered with noise: the indirect part, or all that surfaces reflect."""
INDIRECT: NoisyLight = "indirect"
OF_SHADOWS = frozenset({"shadowed", "unshadowed", "shadow_motion"})
"""Buffers of direct light with noise."""
THROUGH_CENTRES = frozenset({"luminance_gradient", "shadow_motion", "glossy_motion"})
"""Buffers that are traced through the centres of pixels: none with sub-pixel jitter."""
OF_FIRST_HITS = THROUGH_CENTRES | {
    "specular",
    "specular_reflectance",
    "hit_distance",
    "specular_hit_distance",
    "ray_length",
}
"""Buffers of the surface that the camera ray meets first: none where mirrors and glass are seen through."""
DIRECT = 2
"""Path length, in Mitsuba's count, of light reflected by one surface: 1 is emission, 3 one more reflection."""


class Effect(NamedTuple):
    """One effect that a scene may have."""

    name: str
    sentence: str
    """A description for the user."""
    detect: Callable[[SceneProperties, Moment], str]
    """(scene properties, moment) -> the reason why one frame has it; an empty string if it does not."""
    buffers: frozenset[str] = frozenset()
    """The buffers of a Frame that it requires."""
    depth: int = DIRECT
    """The shortest path length that shows it. From :data:`DIRECT` + 1 on there is indirect light to denoise."""
    integrator: str = "path"
    """Mitsuba's integrator that simulates it."""
    seen_through: frozenset[str] = frozenset()
    """Further buffers that it requires where mirrors and glass are seen through."""
    in_time: bool = False
    """It concerns two frames: the first frame of a clip takes it from the second."""


def _list(names: Iterable[str]) -> str:
    ordered = sorted(names)
    return ", ".join(ordered[:3]) + (f" and {len(ordered) - 3} more" if len(ordered) > 3 else "")


def _surfaces(scene: SceneProperties, lobe: str, what: str) -> str:
    names = [surface.name for surface in scene.surfaces if lobe in surface.lobes]
    return f"{_list(names)}: {what}" if names else ""


def _camera_motion(scene: SceneProperties, moment: Moment) -> str:
    return "the camera moves" if moment.camera else ""


def _object_motion(scene: SceneProperties, moment: Moment) -> str:
    return f"{_list(moment.seen)} moves on screen" if moment.seen else ""


def _disocclusion(scene: SceneProperties, moment: Moment) -> str:
    if not moment.reveals:
        return ""
    return f"behind {_list(moment.seen)} things come into view" if moment.seen else "the camera sees past edges"


def _reflecting(scene: SceneProperties) -> list[str]:
    return [surface.name for surface in scene.surfaces if surface.lobes]


def _indirect(scene: SceneProperties, moment: Moment) -> str:
    reflecting = _reflecting(scene)
    if not (scene.lights and reflecting and scene.interreflects):
        return ""
    lights = _list(light.name for light in scene.lights)
    return f"light of {lights} is reflected onto other surfaces by {_list(reflecting)}"


def _glossy(scene: SceneProperties, moment: Moment) -> str:
    return _surfaces(scene, "glossy", "rougher than a mirror, smoother than roughness 1")


def _mirror(scene: SceneProperties, moment: Moment) -> str:
    return _surfaces(scene, "mirror", "reflects as a mirror")


def _transmission(scene: SceneProperties, moment: Moment) -> str:
    return _surfaces(scene, "transmission", "lets light through")


def _specular(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if surface.specular]
    return f"{_list(names)}: not perfectly diffuse" if names else ""


def _moving_shadow(scene: SceneProperties, moment: Moment) -> str:
    if not (moment.moving and scene.lights and _reflecting(scene)):
        return ""
    unseen = moment.moving - moment.seen
    reason = f"{_list(moment.moving)} moves through light"
    return f"{reason} ({_list(unseen)} off screen: its shadow may fall into view)" if unseen else reason


def _changing_light(scene: SceneProperties, moment: Moment) -> str:
    return f"{_list(moment.changing)} moves or changes in brightness" if moment.changing else ""


def _texture(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if surface.textured and "diffuse" in surface.lobes]
    return f"{_list(names)}: the reflectance varies over the surface" if names else ""


def _environment(scene: SceneProperties, moment: Moment) -> str:
    names = [light.name for light in scene.lights if light.environment]
    return f"{_list(names)} shines from all around" if names else ""


def _media(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if surface.medium]
    return f"{_list(names)} bounds a medium" if names else "the camera stands in a medium" if scene.medium else ""


def _emission(scene: SceneProperties, moment: Moment) -> str:
    return f"{_list(moment.shining)} is seen by the camera" if moment.shining else ""


def _moving_reflection(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if {"glossy", "mirror"} & surface.lobes]
    if not names or not (moment.camera or moment.moving):
        return ""
    return f"{_list(moment.moving) or 'the camera'} moves, and {_list(names)} may reflect it"


_MOTION = frozenset({"motion", "previous_depth", "far_motion"})
_REVEALED = frozenset({"dual_motion", "visible"})
_CHANGE = frozenset({"luminance_gradient"})
_SURFACE = frozenset({"roughness"})

EFFECTS: tuple[Effect, ...] = (
    Effect("camera-motion", "The camera moves, turns or zooms.", _camera_motion, _MOTION | _CHANGE, in_time=True),
    Effect("object-motion", "Something on screen moves.", _object_motion, _MOTION, in_time=True),
    Effect(
        "disocclusion",
        "Something comes into view that was hidden in the frame before.",
        _disocclusion,
        _REVEALED,
        in_time=True,
    ),
    Effect(
        "indirect",
        "Light arrives after more than one reflection.",
        _indirect,
        frozenset({"hit_distance"}),
        depth=DIRECT + 1,
    ),
    Effect("glossy", "A surface reflects sharper than a diffuse one.", _glossy, _SURFACE),
    Effect("mirror", "A surface reflects like a mirror.", _mirror, _SURFACE),
    Effect("transmission", "Light passes through a surface.", _transmission, _SURFACE),
    Effect(
        "specular",
        "A surface's reflectance differs from its albedo.",
        _specular,
        frozenset({"reflectance", "specular", "specular_reflectance", "specular_hit_distance", "ray_length"}),
    ),
    Effect(
        "moving-shadow",
        "Something that moves blocks or reflects light; it need not be on screen itself.",
        _moving_shadow,
        _CHANGE | OF_SHADOWS,
        in_time=True,
    ),
    Effect(
        "moving-reflection",
        "A reflection moves over the surface that shows it.",
        _moving_reflection,
        frozenset({"glossy_motion"}),
        seen_through=_MOTION | _REVEALED,
        in_time=True,
    ),
    Effect("changing-light", "A light moves, or becomes brighter or darker.", _changing_light, _CHANGE, in_time=True),
    Effect("texture", "Diffuse reflectance varies over a surface: dividing by the albedo pays.", _texture),
    Effect("environment", "Light comes from all around the scene.", _environment),
    Effect("media", "Light is scattered between surfaces: fog, smoke.", _media, integrator="volpath"),
    Effect("emission", "A light is seen by the camera.", _emission, frozenset({"emission"})),
)
"""All effects, in the order in which they are listed."""

NAMES: tuple[str, ...] = tuple(effect.name for effect in EFFECTS)
