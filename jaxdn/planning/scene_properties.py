"""The properties of an animated scene that decide what has to be simulated.

Plain data, passed from those who read them (:mod:`jaxdn.render.scene_properties` for a scene,
:mod:`jaxdn.data.evidence` for a finished clip) to the catalogue of effects, which depends neither on Mitsuba nor
on files.
"""

from collections.abc import Mapping
from typing import NamedTuple

NO_NAMES: frozenset[str] = frozenset()


class Surface(NamedTuple):
    """One shape and how it scatters light."""

    name: str
    lobes: frozenset[str] = frozenset({"diffuse"})
    """Some of ``diffuse``, ``glossy`` (rougher than a mirror, smoother than diffuse), ``mirror``, ``transmission``;
    empty if it reflects nothing."""
    textured: bool = False
    """Its diffuse reflectance varies over the surface."""
    medium: bool = False
    """It bounds fog, smoke or another medium that scatters light; one that only absorbs it does not count."""
    specular: bool = False
    """It is not perfectly diffuse, so that its reflectance is not its albedo: even metal of roughness 1."""


class Light(NamedTuple):
    """One source of light."""

    name: str
    environment: bool = False
    """It surrounds the scene and is seen where the camera's rays leave the scene."""


class Moment(NamedTuple):
    """What happens between one frame and the one before it; names are those of shapes and lights."""

    camera: bool = False
    """The camera moved, or its field of view changed."""
    moving: frozenset[str] = NO_NAMES
    """Shapes whose pose changed."""
    seen: frozenset[str] = NO_NAMES
    """Those of them that may be on screen in one of the two frames."""
    reveals: bool = False
    """Something may come into view that was hidden."""
    changing: frozenset[str] = NO_NAMES
    """Lights that became brighter or darker, or that moved."""
    shining: frozenset[str] = NO_NAMES
    """Lights that may be on screen in this frame."""


class SceneProperties(NamedTuple):
    """An animated scene."""

    surfaces: tuple[Surface, ...]
    lights: tuple[Light, ...]
    moments: tuple[Moment, ...]
    """One per frame; the first has no previous frame."""
    medium: bool = False
    """The camera itself is in such a medium."""
    interreflects: bool = True
    """Light reflected by one surface may reach another one."""
    max_depth: int | None = None
    """Path length that the scene specifies (1 emission, 2 direct, 3 one bounce of indirect light)."""
    uncertain: Mapping[str, str] = {}
    """Effect -> why it could not be decided; such an effect counts as present."""
