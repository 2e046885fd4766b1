"""Where the buffers of a sequence come from, and what its numbers are taken for, from the header of its first file."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxdn.clips.exr import read_names
from jaxdn.clips.files import ClipError
from jaxdn.clips.folder import frame_path, is_clip
from jaxdn.clips.frames import stored_layers
from jaxdn.clips.import_exr import MOTION_CONVENTIONS, motion_convention_of, sequence_files
from jaxdn.clips.layers import detect_channels, layer_of
from jaxdn.frame import BUFFERS, GUIDES, Buffer

OWN = "previous-current"
"""The convention of the motion vectors in jaxdn's own clips."""


class Source(NamedTuple):
    """One buffer that is read."""

    buffer: str
    layer: str
    channels: tuple[str, ...]
    convention: str
    """What the numbers are taken for, in words."""


def sources_of(
    path: str | Path,
    *,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
) -> list[Source]:
    """The sources of a clip's buffers, or of those of another renderer's files, without reading a pixel.

    Takes what :func:`jaxdn.clips.import_exr.plain_frames` takes and raises as it does, except that motion vectors whose
    convention nobody has stated are listed as such.
    """
    if is_clip(path):
        return _of_clip(read_names(frame_path(path, 0)))
    file = sequence_files(path)[0]
    names = read_names(file)
    try:
        found = detect_channels(names, channels=channels, layer=layer)
    except ClipError as error:
        raise ClipError(f"{file}: {error}") from error
    stated: str | None = None
    if "motion" in found:
        try:
            stated = motion_convention_of(found, names, motion_convention)
        except ClipError:
            stated = "unknown"
    if stated is None:
        found.pop("motion", None)
    return [Source(name, layer_of(found[name]), found[name], _words(name, stated)) for name in found]


def _of_clip(names: list[str]) -> list[Source]:
    """The sources in a file of jaxdn's own."""
    layers = {"radiance": f"noisy_{min(stored_layers(names), default=1)}spp", **{name: name for name in GUIDES}}
    found = {name: tuple(f"{layers[name]}.{letter}" for letter in BUFFERS[name].letters) for name in layers}
    there = {name: channels for name, channels in found.items() if set(channels) <= set(names)}
    return [Source(name, layers[name], there[name], _words(name, OWN)) for name in there]


def _words(name: str, motion: str | None) -> str:
    """What the numbers of a buffer are taken for."""
    buffer: Buffer = BUFFERS[name]
    if buffer.kind == "vector":
        return MOTION_CONVENTIONS.get(motion or "", "nothing says: state --motion-convention")
    kinds = {
        "light": "linear light",
        "direction": "world space",
        "id": "whole numbers, 0 is nothing",
        "flag": "0 or 1",
    }
    if name in ("depth", "previous_depth"):
        return "along the optical axis (view-space z), not along the ray"
    if name == "roughness":
        return "linear, GGX alpha is its square"
    return kinds.get(buffer.kind, "share of light, 0 to 1" if buffer.kind == "fraction" else buffer.kind)
