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
OF_PRIMARY_SURFACES = THROUGH_CENTRES | {
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


def _join(names: Iterable[str]) -> str:
    ordered = sorted(names)
    return ", ".join(ordered[:3]) + (f" and {len(ordered) - 3} more" if len(ordered) > 3 else "")


def _describe_surfaces(scene: SceneProperties, lobe: str, what: str) -> str:
    names = [surface.name for surface in scene.surfaces if lobe in surface.lobes]
    return f"{_join(names)}: {what}" if names else ""


def _detect_camera_motion(scene: SceneProperties, moment: Moment) -> str:
    return "the camera moves" if moment.camera else ""


def _detect_object_motion(scene: SceneProperties, moment: Moment) -> str:
    return f"{_join(moment.seen)} moves on screen" if moment.seen else ""


def _detect_disocclusion(scene: SceneProperties, moment: Moment) -> str:
    if not moment.reveals:
        return ""
    return f"behind {_join(moment.seen)} things come into view" if moment.seen else "the camera sees past edges"


def _list_reflecting(scene: SceneProperties) -> list[str]:
    return [surface.name for surface in scene.surfaces if surface.lobes]


def _detect_indirect(scene: SceneProperties, moment: Moment) -> str:
    reflecting = _list_reflecting(scene)
    if not (scene.lights and reflecting and scene.interreflects):
        return ""
    lights = _join(light.name for light in scene.lights)
    return f"light of {lights} is reflected onto other surfaces by {_join(reflecting)}"


def _detect_glossy(scene: SceneProperties, moment: Moment) -> str:
    return _describe_surfaces(scene, "glossy", "rougher than a mirror, smoother than roughness 1")


def _detect_mirror(scene: SceneProperties, moment: Moment) -> str:
    return _describe_surfaces(scene, "mirror", "reflects as a mirror")


def _detect_transmission(scene: SceneProperties, moment: Moment) -> str:
    return _describe_surfaces(scene, "transmission", "lets light through")


def _detect_specular(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if surface.specular]
    return f"{_join(names)}: not perfectly diffuse" if names else ""


def _detect_moving_shadow(scene: SceneProperties, moment: Moment) -> str:
    if not (moment.moving and scene.lights and _list_reflecting(scene)):
        return ""
    unseen = moment.moving - moment.seen
    reason = f"{_join(moment.moving)} moves through light"
    return f"{reason} ({_join(unseen)} off screen: its shadow may fall into view)" if unseen else reason


def _detect_changing_light(scene: SceneProperties, moment: Moment) -> str:
    return f"{_join(moment.changing)} moves or changes in brightness" if moment.changing else ""


def _detect_texture(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if surface.textured and "diffuse" in surface.lobes]
    return f"{_join(names)}: the reflectance varies over the surface" if names else ""


def _detect_environment(scene: SceneProperties, moment: Moment) -> str:
    names = [light.name for light in scene.lights if light.environment]
    return f"{_join(names)} shines from all around" if names else ""


def _detect_media(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if surface.medium]
    return f"{_join(names)} bounds a medium" if names else "the camera stands in a medium" if scene.medium else ""


def _detect_emission(scene: SceneProperties, moment: Moment) -> str:
    return f"{_join(moment.shining)} is seen by the camera" if moment.shining else ""


def _detect_moving_reflection(scene: SceneProperties, moment: Moment) -> str:
    names = [surface.name for surface in scene.surfaces if {"glossy", "mirror"} & surface.lobes]
    if not names or not (moment.camera or moment.moving):
        return ""
    return f"{_join(moment.moving) or 'the camera'} moves, and {_join(names)} may reflect it"


_MOTION = frozenset({"motion", "previous_depth", "far_motion"})
_REVEALED = frozenset({"dual_motion", "visible"})
_CHANGE = frozenset({"luminance_gradient"})
_SURFACE = frozenset({"roughness"})

EFFECTS: tuple[Effect, ...] = (
    Effect(
        "camera-motion", "The camera moves, turns or zooms.", _detect_camera_motion, _MOTION | _CHANGE, in_time=True
    ),
    Effect("object-motion", "Something on screen moves.", _detect_object_motion, _MOTION, in_time=True),
    Effect(
        "disocclusion",
        "Something comes into view that was hidden in the frame before.",
        _detect_disocclusion,
        _REVEALED,
        in_time=True,
    ),
    Effect(
        "indirect",
        "Light arrives after more than one reflection.",
        _detect_indirect,
        frozenset({"hit_distance"}),
        depth=DIRECT + 1,
    ),
    Effect("glossy", "A surface reflects sharper than a diffuse one.", _detect_glossy, _SURFACE),
    Effect("mirror", "A surface reflects like a mirror.", _detect_mirror, _SURFACE),
    Effect("transmission", "Light passes through a surface.", _detect_transmission, _SURFACE),
    Effect(
        "specular",
        "A surface's reflectance differs from its albedo.",
        _detect_specular,
        frozenset({"reflectance", "specular", "specular_reflectance", "specular_hit_distance", "ray_length"}),
    ),
    Effect(
        "moving-shadow",
        "Something that moves blocks or reflects light; it need not be on screen itself.",
        _detect_moving_shadow,
        _CHANGE | OF_SHADOWS,
        in_time=True,
    ),
    Effect(
        "moving-reflection",
        "A reflection moves over the surface that shows it.",
        _detect_moving_reflection,
        frozenset({"glossy_motion"}),
        seen_through=_MOTION | _REVEALED,
        in_time=True,
    ),
    Effect(
        "changing-light", "A light moves, or becomes brighter or darker.", _detect_changing_light, _CHANGE, in_time=True
    ),
    Effect("texture", "Diffuse reflectance varies over a surface: dividing by the albedo pays.", _detect_texture),
    Effect("environment", "Light comes from all around the scene.", _detect_environment),
    Effect(
        "media",
        "Light is scattered between surfaces: fog, smoke.",
        _detect_media,
        depth=DIRECT + 1,  # again and again
        integrator="volpath",
    ),
    Effect("emission", "A light is seen by the camera.", _detect_emission, frozenset({"emission"})),
)
"""All effects, in the order in which they are listed."""

NAMES: tuple[str, ...] = tuple(effect.name for effect in EFFECTS)
