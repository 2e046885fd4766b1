"""Where the buffers of a sequence come from, and what its numbers are taken for, from its first file."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from jaxdn.core.frame import BUFFERS, GUIDES, Buffer
from jaxdn.data.clip.folder import frame_path, is_clip
from jaxdn.data.clip.frames import stored_layers
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.classify import UNNAMED, ChannelNaming, classify_channels
from jaxdn.data.foreign.layers import Channels, is_cryptomatte, last_name, layer_of
from jaxdn.data.foreign.reflectance import CAMERA_NORMALS
from jaxdn.data.foreign.shot_files import find_sequence
from jaxdn.data.foreign.vectors import MOTION_CONVENTIONS, UnknownMotion, find_motion_convention
from jaxdn.data.foreign.views import open_views

OWN = "previous-current"
"""The convention of the motion vectors in jaxdn's own clips."""
UNSTATED = "nothing says: state --motion-convention"
"""What motion vectors are taken for whose convention nobody has stated."""

CAMERA_SPACE = "camera space"
"""What normals are taken for that are said to be those of the camera."""


class MappedBuffer(NamedTuple):
    """One buffer that is read."""

    buffer: str
    layer: str
    channels: tuple[str, ...]
    convention: str
    """What the numbers are taken for, in words."""


def read_channel_mapping(
    source: str | Path | ExrFile,
    naming: ChannelNaming = UNNAMED,
    *,
    single: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> list[MappedBuffer]:
    """From which channels the buffers of a clip, or of another renderer's files, are read.

    ``source`` is a clip's folder, a place of files, of which the first is looked at, or a file, which stays decoded.
    Raises as :func:`jaxdn.data.foreign.import_exr.plain_frames` does, except that motion vectors whose convention
    nobody has stated are listed as such, unless the image is a ``single`` one and needs none. ``log`` is called with
    lines about what is left unused.
    """
    if isinstance(source, ExrFile):
        return _map_foreign(source, naming, single=single, log=log)
    if is_clip(source):
        return _map_own(list(ExrFile(frame_path(source, 0)).windows))
    first = next(iter(open_views(find_sequence(source, naming.pass_files), naming.view).values()))[0]
    return _map_foreign(first, naming, single=single, log=log)


def lacks_convention(file: ExrFile, naming: ChannelNaming, *, single: bool = False) -> bool:
    """Whether a file of another renderer has motion vectors, be they 0, and nothing says what they mean."""
    pixels = file.pixels
    try:
        find_motion_convention(naming.detect(list(pixels)), pixels, naming.motion_convention, single=single)
    except UnknownMotion:
        return True
    return False


def _map_foreign(
    file: ExrFile, naming: ChannelNaming, *, single: bool, log: Callable[[str], None]
) -> list[MappedBuffer]:
    """From which channels the buffers of another renderer's file are read."""
    pixels = file.pixels
    try:
        unknown = lacks_convention(file, naming, single=single)
        assumed = replace(naming, motion_convention=OWN) if unknown else naming
        mapping = classify_channels(pixels, assumed, single=single)
    except ClipError as error:
        raise ClipError(f"{file.path}: {error}") from error
    for note in mapping.notes:
        log(note)
    said = "unknown" if unknown else mapping.convention
    mapped = [
        MappedBuffer(name, layer_of(channels), channels, _describe(name, channels, said))
        for name, channels in mapping.buffers.items()
    ]
    if mapping.forward:
        place = 1 + next(index for index, one in enumerate(mapped) if one.buffer == "motion")
        words = "pixels, current minus next, y up, of the frame before (Blender's Vector pass, last two components)"
        mapped.insert(place, MappedBuffer("dual_motion", layer_of(mapping.forward), mapping.forward, words))
    return mapped


def _map_own(names: list[str]) -> list[MappedBuffer]:
    """The buffers in a file of jaxdn's own."""
    layers = {"radiance": f"noisy_{min(stored_layers(names), default=1)}spp", **{name: name for name in GUIDES}}
    wanted = {name: tuple(f"{layers[name]}.{letter}" for letter in BUFFERS[name].letters) for name in layers}
    stored = {name: channels for name, channels in wanted.items() if set(channels) <= set(names)}
    return [MappedBuffer(name, layers[name], stored[name], _describe(name, stored[name], OWN)) for name in stored]


def _describe(name: str, channels: Channels, motion: str | None) -> str:
    """What the numbers of a buffer are taken for."""
    buffer: Buffer = BUFFERS[name]
    last = last_name(channels)
    if buffer.kind == "vector":
        return MOTION_CONVENTIONS.get(motion or "", UNSTATED)
    if name in ("depth", "previous_depth"):
        along_ray = last == "denoising depth" or channels[0].lower().endswith(".t")  # Cycles; Mitsuba
        return "along the ray" if along_ray else "along the optical axis (view-space z), not along the ray"
    if name == "normal":
        return CAMERA_SPACE if last in CAMERA_NORMALS else "world space"
    if name == "roughness":
        return "linear, GGX alpha is its square"
    if name == "ids" and is_cryptomatte(channels):
        return "hash of what covers most of the pixel (Cryptomatte)"
    kinds = {"light": "linear light", "id": "whole numbers, 0 has none", "flag": "0 or 1"}
    return kinds.get(buffer.kind, "share of light, 0 to 1" if buffer.kind == "fraction" else buffer.kind)
