"""What a layer is, decided over the frames of a shot: a frame that tells nothing decides nothing.

A fade from black has a first frame without light, ids or vectors, and renderers write zeros where nobody asked for a
buffer. Such a layer counts as missing until a frame has something in it. From then on it is read in every frame, so
that a frame of sky in the middle of a shot changes nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.layers import UNSURE_ALBEDO, Channels, is_cryptomatte, last_name, layer_of, stack_channels
from jaxdn.data.foreign.lighting import SLACK, explain_light, is_clearly_brighter

_STILL = 1e-6
"""Vectors are shorter where nothing moves, whatever their unit; a matrix product leaves so much of 0."""
_MANY = 0.1
"""Share of the pixels; so many values above 1 are no lamps in an albedo."""
_EVERY = 16
"""Of so many rows one is looked at first."""


@dataclass
class Decisions:
    """What the frames of a shot have told so far about its layers."""

    filled: set[str] = field(default_factory=set)
    """Buffers that had something in them in some frame."""
    empty: set[str] = field(default_factory=set)
    """Buffers that had nothing in them in all frames so far."""
    rejected: set[str] = field(default_factory=set)
    """Buffers whose channels have turned out to be something else."""
    stated: bool = False
    """What was named outright has been looked at."""
    albedo: bool | None = None
    """Whether a layer called ``diffuse`` is an albedo; None: no frame has told."""

    def drop_empty(
        self, pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels], forward: Channels | None
    ) -> tuple[dict[str, Channels], list[str]]:
        """The buffers that have something in them, in this frame or an earlier one, and what is new, in sentences.

        Args:
          pixels: every channel of the file.
          buffers: buffer -> channels.
          forward: the channels of the vectors to the next frame, if the motion has them.
        """
        notes = []
        for name, channels in buffers.items():
            if name in self.filled:
                continue
            read = channels + (forward or ()) if name == "motion" else channels
            why = _look_for_emptiness(name, pixels, read)
            if why is None:
                self.filled.add(name)
                if name in self.empty:
                    notes.append(f"from here on {name} is read from {layer_of(channels)!r}, which is no longer empty")
            elif name not in self.empty and name in _SAID:
                notes.append(f"{name} counts as missing: {layer_of(channels)!r} is {why}{_SAID[name]}")
            self.empty = self.empty - {name} if why is None else self.empty | {name}
        return {name: channels for name, channels in buffers.items() if name in self.filled}, notes

    def reject_by_values(
        self, pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels], stated: Mapping[str, str]
    ) -> tuple[dict[str, Channels], list[str]]:
        """The buffers whose channels are what their names promise, and what is new, in sentences.

        Raises ClipError for light that was named the albedo outright.
        """
        notes = []
        albedo, ids = buffers.get("albedo"), buffers.get("ids")
        if albedo is not None and "albedo" in stated and not self.stated:
            notes += _doubt_stated_albedo(pixels, buffers)
        elif albedo is not None and "albedo" not in stated and last_name(albedo) == UNSURE_ALBEDO:
            notes += self._judge_albedo(pixels, buffers)
        self.stated = True
        if (
            ids is not None
            and is_cryptomatte(ids)
            and pixels[ids[0]].dtype != np.float32
            and "ids" not in self.rejected
        ):
            self.rejected.add("ids")
            notes.append(f"not used: {layer_of(ids)!r}, as half precision has destroyed the ids in it")
        return {name: channels for name, channels in buffers.items() if name not in self.rejected}, notes

    def _judge_albedo(self, pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels]) -> list[str]:
        """Decide whether a layer called ``diffuse`` is the albedo; what is new, in sentences.

        Until a frame with light has told, it is none. A layer that was taken for light, as nowhere brighter than the
        beauty, is an albedo as soon as it is clearly brighter: an overexposed frame told nothing.
        """
        if self.albedo:
            return []
        values, beauty = stack_channels(pixels, buffers["albedo"]), stack_channels(pixels, buffers["radiance"])
        layer = layer_of(buffers["albedo"])
        if self.albedo is None and np.any(values > 0) and np.any(beauty > 0):
            why = explain_light(values, beauty)
            self.albedo = why is None
            if why is not None:
                self.rejected.add("albedo")
                return [f"not used: {layer!r} is a lighting pass and no albedo: {why}"]
            waited = "albedo" in self.rejected
            self.rejected.discard("albedo")
            return [f"from here on {layer!r} is the albedo"] if waited else []
        elif self.albedo is False and is_clearly_brighter(values, beauty) and explain_light(values, beauty) is None:
            self.albedo = True
            self.rejected.discard("albedo")
            return [f"from here on {layer!r} is the albedo: it is brighter than the beauty, as no part of it can be"]
        elif self.albedo is None and "albedo" not in self.rejected:
            self.rejected.add("albedo")
            return [f"{layer!r} is not used yet: a frame without light does not tell an albedo from light"]
        return []


_SAID = {
    "albedo": "",
    "normal": "",
    "depth": "",
    "roughness": "",
    "specular_hit_distance": "",
    "motion": "; right where nothing moves, but Blender writes zeros where motion blur is on: "
    "what moves is then measured, and true vectors need a render without motion blur, which may be added afterwards",
}
"""Buffers whose emptiness is told, with what to know about it; ids are zeros in most files."""


def _look_for_emptiness(name: str, pixels: Mapping[str, np.ndarray], channels: Channels) -> str | None:
    """:func:`_explain_empty` of a buffer's channels.

    What has nothing in it has nothing in some of its rows, and hardly any layer passes that: few rows tell of most.
    """
    few = {channel: pixels[channel][::_EVERY] for channel in set(channels)}
    if _explain_empty(name, stack_channels(few, channels)) is None:
        return None
    return _explain_empty(name, stack_channels(pixels, channels))


def _explain_empty(name: str, values: np.ndarray) -> str | None:
    """What a buffer [H, W, C] in which nothing can be seen has everywhere, in words; None for any other."""
    known = ~np.isnan(values)
    if name == "normal":
        first = values[:1, :1]
        same = bool(np.all((values == first) | ~known))
        return "(" + ", ".join(f"{value:g}" for value in first.ravel()) + ") everywhere" if same else None
    if name == "albedo" and np.all((values == 1) | ~known):
        return "1 everywhere"
    if name == "motion":
        values = np.where(np.abs(np.nan_to_num(values)) < _STILL, 0, values)
    return "0 everywhere" if name in _ZEROS and not np.any((values != 0) & known) else None


_ZEROS = ("albedo", "depth", "roughness", "motion", "ids", "specular_hit_distance")
"""Buffers that are empty where they are 0 everywhere; no specular reflectance is one, too."""


def _doubt_stated_albedo(pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels]) -> list[str]:
    """A note about an albedo that was named outright and looks like light; ClipError where it cannot be one."""
    values, layer = stack_channels(pixels, buffers["albedo"]), layer_of(buffers["albedo"])
    bright = np.any(np.nan_to_num(values, posinf=np.inf) > 1 + SLACK, axis=-1)
    if bright.mean() <= _MANY:  # lamps hold their light
        values = np.where(bright[..., None], 1, values)
    why = explain_light(values, stack_channels(pixels, buffers["radiance"]))
    if why is None:
        return []
    if bright.mean() > _MANY:
        raise ClipError(f"albedo: {layer!r} is no albedo: {why}; name another, or --channels albedo=none.")
    return [f"taken as you say: {layer!r}, but it looks like light: {why}"]
