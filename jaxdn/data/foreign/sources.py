"""Where the buffers of a sequence come from, and what its numbers are taken for, from its first file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxdn.core.frame import BUFFERS, GUIDES, Buffer
from jaxdn.data.clip.folder import frame_path, is_clip
from jaxdn.data.clip.frames import stored_layers
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.exr import read_exr, read_names
from jaxdn.data.foreign.import_exr import choose
from jaxdn.data.foreign.layers import Channels, detect_channels, is_cryptomatte, last_name, layer_of
from jaxdn.data.foreign.reflectance import CAMERA_NORMALS
from jaxdn.data.foreign.shots import sequence_files
from jaxdn.data.foreign.vectors import MOTION_CONVENTIONS, UnknownMotion, check_convention, motion_convention_of

OWN = "previous-current"
"""The convention of the motion vectors in jaxdn's own clips."""
UNSTATED = "nothing says: state --motion-convention"
"""What motion vectors are taken for whose convention nobody has stated."""


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
    alone: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> list[Source]:
    """The sources of a clip's buffers, or of those of another renderer's files, from its first file.

    Takes what :func:`jaxdn.data.foreign.import_exr.plain_frames` takes and raises as it does, except that motion
    vectors whose convention nobody has stated are listed as such, unless the image is ``alone`` and needs none. ``log``
    is called with lines about what is left unused.
    """
    if is_clip(path):
        return _of_clip(read_names(frame_path(path, 0)))
    check_convention(motion_convention)
    file = sequence_files(path)[0]
    there = read_exr(file)
    naming: Any = {"channels": channels, "layer": layer}
    unknown = False
    try:
        try:
            motion_convention_of(detect_channels(list(there), **naming), there, motion_convention, alone=alone)
        except UnknownMotion:
            unknown = True
        chosen = choose(there, motion_convention=OWN if unknown else motion_convention, alone=alone, **naming)
    except ClipError as error:
        raise ClipError(f"{file}: {error}") from error
    for note in chosen.notes:
        log(note)
    said = "unknown" if unknown else chosen.convention
    found = [Source(name, layer_of(each), each, _words(name, each, said)) for name, each in chosen.found.items()]
    if chosen.forward:
        place = 1 + next(index for index, source in enumerate(found) if source.buffer == "motion")
        words = "pixels, current minus next, y up, of the frame before (Blender's Vector pass, last two components)"
        found.insert(place, Source("dual_motion", layer_of(chosen.forward), chosen.forward, words))
    return found


def _of_clip(names: list[str]) -> list[Source]:
    """The sources in a file of jaxdn's own."""
    layers = {"radiance": f"noisy_{min(stored_layers(names), default=1)}spp", **{name: name for name in GUIDES}}
    found = {name: tuple(f"{layers[name]}.{letter}" for letter in BUFFERS[name].letters) for name in layers}
    there = {name: channels for name, channels in found.items() if set(channels) <= set(names)}
    return [Source(name, layers[name], there[name], _words(name, there[name], OWN)) for name in there]


def _words(name: str, channels: Channels, motion: str | None) -> str:
    """What the numbers of a buffer are taken for."""
    buffer: Buffer = BUFFERS[name]
    last = last_name(channels)
    if buffer.kind == "vector":
        return MOTION_CONVENTIONS.get(motion or "", UNSTATED)
    if name in ("depth", "previous_depth"):
        along_ray = last == "denoising depth" or channels[0].lower().endswith(".t")  # Cycles; Mitsuba
        return "along the ray" if along_ray else "along the optical axis (view-space z), not along the ray"
    if name == "normal":
        return "camera space" if last in CAMERA_NORMALS else "world space"
    if name == "roughness":
        return "linear, GGX alpha is its square"
    if name == "ids" and is_cryptomatte(channels):
        return "hash of what covers most of the pixel (Cryptomatte)"
    kinds = {"light": "linear light", "id": "whole numbers, 0 is nothing", "flag": "0 or 1"}
    return kinds.get(buffer.kind, "share of light, 0 to 1" if buffer.kind == "fraction" else buffer.kind)
