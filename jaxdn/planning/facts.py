"""Plain facts about a scene in motion, as far as they decide what has to be simulated.

The vocabulary between those who read facts (:mod:`jaxdn.render.scene_facts` from a scene,
:mod:`jaxdn.clips.evidence` from a finished clip) and the catalogue of effects, which knows neither Mitsuba nor files.
"""

from collections.abc import Mapping
from typing import NamedTuple

NO_NAMES: frozenset[str] = frozenset()


class Surface(NamedTuple):
    """One shape and what light does on it."""

    name: str
    lobes: frozenset[str] = frozenset({"diffuse"})
    """Of ``diffuse``, ``glossy`` (rougher than a mirror, smoother than diffuse), ``mirror``, ``transmission``; empty
    for what reflects nothing."""
    textured: bool = False
    """Its diffuse reflectance varies over the surface."""
    medium: bool = False
    """It bounds fog, smoke or another participating medium."""
    specular: bool = False
    """It is not perfectly diffuse, so that its reflectance is not its albedo: even metal of roughness 1."""


class Light(NamedTuple):
    """One source of light."""

    name: str
    environment: bool = False
    """It shines from everywhere around and is seen where the camera's rays leave the scene."""


class Moment(NamedTuple):
    """What happens between one frame and the one before it; names are those of shapes and lights."""

    camera: bool = False
    """The camera, or its field of view, is another one."""
    moving: frozenset[str] = NO_NAMES
    """Shapes with another pose."""
    seen: frozenset[str] = NO_NAMES
    """Those of them that may be on screen in one of the two frames."""
    reveals: bool = False
    """Something may come into view that was hidden."""
    changing: frozenset[str] = NO_NAMES
    """Lights that became brighter or darker, or that moved."""
    shining: frozenset[str] = NO_NAMES
    """Lights that may be on screen in this frame."""


class Facts(NamedTuple):
    """A scene in motion."""

    surfaces: tuple[Surface, ...]
    lights: tuple[Light, ...]
    moments: tuple[Moment, ...]
    """One a frame; the first one has nothing before it."""
    medium: bool = False
    """The camera itself stands in a participating medium."""
    interreflects: bool = True
    """Light reflected by one surface may reach another one."""
    max_depth: int | None = None
    """Path length that the scene asks for (1 emission, 2 direct, 3 one bounce of indirect light)."""
    uncertain: Mapping[str, str] = {}
    """Effect -> why it could not be decided; such an effect counts as present."""
