"""Properties of a finished clip from its buffers, for clips whose scene is not available.

Buffers show less than a scene does. Where they cannot decide, the effect is uncertain and counts as present. The record
of a clip that was rendered by a plan lists the effects that it was rendered for.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.frame import BUFFERS, FAR, Frame
from jaxdn.data.clip.folder import is_clip, read_record
from jaxdn.data.clip.record import is_planned
from jaxdn.data.foreign.classify import UNNAMED, ChannelNaming
from jaxdn.data.read import open_frames
from jaxdn.planning.scene_properties import NO_NAMES, Light, Moment, SceneProperties, Surface

_ANY_CONVENTION = "previous-current"
"""Whether anything moves is the same in every convention of motion vectors."""
_ANYTHING = frozenset({"what moves"})
_HIDDEN = {
    "transmission": "a buffer of the first surface does not show what lies behind it",
    "media": "no buffer shows a medium",
    "environment": "light from all around need not be seen by the camera",
    "moving-shadow": "an object that casts a shadow need not be on screen",
    "changing-light": "noise hides small changes of light",
}
"""Effects that no buffer can rule out."""


def read_clip_properties(path: str | Path, animation: Any = None, naming: ChannelNaming = UNNAMED) -> SceneProperties:
    """Properties of a clip's folder, or EXR files of any renderer; frames are read one at a time.

    ``naming``: ``channels`` and ``layer`` of files of other renderers.
    Raises ClipError as :func:`jaxdn.clips.read_clip` does, and ValueError for an ``animation``, which a finished clip
    does not need.
    """
    if animation is not None:
        raise ValueError(f"animation {animation}: expected none, as {path} is a finished clip; leave it out.")
    record: Mapping[str, Any] = read_record(path) if is_clip(path) else {}
    look = _Look(record)
    spp = record["layers"][0] if record else 1
    _, frames = open_frames(
        path, spp=spp, motion_convention=_ANY_CONVENTION, channels=naming.channels, layer=naming.layer
    )
    for stored in frames:
        look.at(stored.frame)
    return look.properties()


class _Look:
    """What has been seen so far of a clip's frames."""

    def __init__(self, record: Mapping[str, Any]) -> None:
        self._cameras = record.get("cameras")
        self._plan = record.get("plan") if is_planned(record) else None
        self._moments: list[Moment] = []
        self._unsure: dict[str, str] = {}
        self._lobes: set[str] = {"diffuse"}
        self._textured = self._specular = self._lit = self._sky_shines = False

    def at(self, frame: Frame) -> None:
        """Look at the next frame."""
        index = len(self._moments)
        self._lit |= any(_some(getattr(frame, name)) for name, buffer in BUFFERS.items() if buffer.kind == "light")
        self._surface(frame)
        shining = frozenset({"a light"}) if _some(frame.emission) else NO_NAMES
        if frame.emission is not None:
            sky = _sky(frame)
            self._sky_shines |= sky is not None and bool(np.any(np.asarray(frame.emission)[sky] > 0))
        elif self._plan is None:
            self._unsure.setdefault("emission", "there is no emission buffer")
        self._moments.append(self._moment(frame, index)._replace(shining=shining))

    def _moment(self, frame: Frame, index: int) -> Moment:
        moved = frame.motion is not None and bool(np.any(np.asarray(frame.motion) != 0))
        if frame.motion is None and self._plan is None:
            why = "there are no motion vectors"
            self._unsure |= dict.fromkeys(("camera-motion", "object-motion", "disocclusion"), why)
        if index == 0:
            return Moment()
        if frame.dual_motion is not None:
            # NaN equals NaN here: where both have no vector there is no difference.
            reveals = not np.array_equal(np.asarray(frame.dual_motion), np.asarray(frame.motion), equal_nan=True)
        else:
            reveals = moved and self._plan is None
            if reveals:
                self._unsure.setdefault("disocclusion", "there are no dual motion vectors")
        if self._cameras is None:
            camera, objects = moved, moved
            if moved:
                why = "the vectors do not distinguish camera motion from object motion"
                self._unsure |= dict.fromkeys(("camera-motion", "object-motion"), why)
        else:
            camera = self._cameras[index] != self._cameras[index - 1]
            objects = moved and (not camera or self._had("object-motion"))
            if objects and camera and self._plan is None:
                self._unsure.setdefault("object-motion", "the camera moves too")
        movers = _ANYTHING if objects else NO_NAMES
        return Moment(camera=camera, moving=movers, seen=movers, reveals=reveals)

    def _had(self, effect: str) -> bool:
        """Whether the clip was rendered for an effect; without a plan this is assumed."""
        return self._plan is None or effect in self._plan["effects"]

    def _surface(self, frame: Frame) -> None:
        if frame.roughness is not None:
            roughness = np.asarray(frame.roughness)
            self._lobes |= {"glossy"} if np.any((roughness > 0) & (roughness < 1)) else set()
            self._lobes |= {"mirror"} if np.any(roughness == 0) else set()
        elif self._plan is None:
            self._unsure |= dict.fromkeys(("glossy", "mirror"), "there is no roughness buffer")
        if frame.reflectance is not None:
            self._specular |= frame.albedo is None or not np.array_equal(frame.reflectance, frame.albedo)
        elif self._plan is None:
            self._unsure.setdefault("specular", "there is no reflectance buffer")
        if frame.albedo is None or frame.ids is None:
            if self._plan is None:
                self._unsure.setdefault("texture", "albedo and ids are needed to distinguish a texture from two shapes")
        elif not self._textured:
            albedo, ids = np.asarray(frame.albedo), np.asarray(frame.ids)[..., 0]
            self._textured = any(np.any(np.ptp(albedo[ids == shape], axis=0) > 0) for shape in np.unique(ids[ids >= 0]))

    def properties(self) -> SceneProperties:
        """The properties that all frames together show."""
        hidden = {name: why for name, why in _HIDDEN.items() if self._had(name)}
        if self._plan is None and not self._lit:
            hidden = {}
        if len(self._moments) == 1:
            hidden = {name: why for name, why in hidden.items() if name not in ("moving-shadow", "changing-light")}
        if self._sky_shines:
            hidden.pop("environment", None)
        surface = Surface("what is seen", frozenset(self._lobes), self._textured, specular=self._specular)
        lights = (Light("a light", environment=self._sky_shines),) if self._lit else ()
        return SceneProperties((surface,), lights, tuple(self._moments), uncertain=hidden | self._unsure)


def _some(buffer: Any) -> bool:
    return buffer is not None and bool(np.any(np.asarray(buffer) > 0))


def _sky(frame: Frame) -> np.ndarray | None:
    """[H, W] bool, the camera ray left the scene; None where no buffer shows it."""
    if frame.ids is not None:
        return np.asarray(np.asarray(frame.ids)[..., 0] < 0)
    return None if frame.depth is None else np.asarray(np.asarray(frame.depth)[..., 0] >= FAR)
