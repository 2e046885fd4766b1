"""The lights of a scene file: which there are, and how bright they are in one frame."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.scenes.scene_parser import SceneParser

_POWERS = ("radiance", "intensity", "irradiance", "power")
"""The properties that define an emitter's brightness."""
_SCALES = ("scale", "sky_scale", "sun_scale")
"""Factors on it, which emitters with a sky or an image have."""


class SceneLight(NamedTuple):
    """One light of a scene file."""

    owner: int
    """The child of the scene that it is, or is a part of."""
    emitter: int
    """Its own node."""
    scalable: bool
    """Its brightness is given in the file, as one or three numbers, as a spectrum, or as an image."""
    plain: bool
    """It is given as one or three numbers, or as a spectrum."""
    colored: bool
    """It is given in red, green and blue, each of which can be scaled by itself."""


def list_lights(parser: SceneParser) -> dict[str, SceneLight]:
    """The lights of a scene by their names: those of lamps, of shapes that emit, and the ids of these shapes' emitters.

    An emitter that stands beside the shapes, and that one of them refers to, is that shape's.
    """
    found: dict[str, SceneLight] = {}
    for owner in parser.children:
        kind = parser.type_of(owner)
        if kind not in ("Shape", "Emitter"):
            continue
        nodes = [owner] if kind == "Emitter" else parser.references(owner)
        for emitter in (node for node in nodes if parser.type_of(node) == "Emitter"):
            light = _read_light(parser, owner, emitter)
            if kind == "Shape":
                found[parser.names[owner]] = light
            name = parser.id(emitter)
            if name and (kind == "Shape" or name not in found):
                found[name] = light
    return found


def _read_light(parser: SceneParser, owner: int, emitter: int) -> SceneLight:
    values = parser.values(emitter)
    powers = [values[name] for name in _POWERS if name in values]
    plain = [type(value).__name__ for value in powers if type(value).__name__ != "ResolvedReference"]
    scaled = parser.plugin(emitter) in ("envmap", "sky", "sun", "sunsky")
    return SceneLight(
        owner, emitter, bool(powers) or scaled, bool(plain), bool(plain) and all("Color" in name for name in plain)
    )


def check_lights(parser: SceneParser, lights: Mapping[str, SceneLight], keys: Mapping[str, Any]) -> None:
    """Raise ValueError for a name that is not a light of the scene, or a light that cannot be scaled so."""
    for name in keys:
        if name not in lights:
            known = ", ".join(lights) or "none"
            raise ValueError(f"animation lights: the scene {parser.path} has no light {name!r}; it has {known}.")
        if not lights[name].scalable:
            raise ValueError(f"animation lights: {name!r} has no colour or number to scale; give it one in the scene.")
        if any(np.ptp(np.broadcast_to(key["scale"], 3)) > 0 for key in keys[name]) and not lights[name].colored:
            raise ValueError(
                f"animation lights: {name!r} is not given in red, green and blue; expected one number as its scale."
            )


def scale_light(emitter: Any, factors: np.ndarray, name: str) -> None:
    """Multiply the brightness of a loaded emitter by [3] factors, which are equal for one without red, green, blue.

    Raises ValueError for an emitter whose brightness is not a parameter, such as that of a black body.
    """
    import mitsuba as mi

    parameters = mi.traverse(emitter)
    known = list(parameters.keys())
    keys = [key for key in known if key in _SCALES] or [
        key for key in known if key.split(".")[0] in _POWERS and key.rpartition(".")[2] in ("value", "values", "data")
    ]
    if not keys:
        raise ValueError(
            f"animation lights: the brightness of {name!r} is no number that can be scaled; give it one in the scene."
        )
    for key in keys:
        value = parameters[key]
        colors = np.asarray(value)
        if key in _SCALES or colors.size == 1:
            parameters[key] = type(value)(value * float(factors[0]))
        elif key.endswith(".data"):
            parameters[key] = type(value)(colors * np.asarray(factors, colors.dtype)[: colors.shape[-1]])
        else:
            # Vectorised variants have the channels first, and one column.
            parameters[key] = type(value)((colors.reshape(-1) * factors[: colors.size]).tolist())
    parameters.update()
