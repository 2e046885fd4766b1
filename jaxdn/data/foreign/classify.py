"""Which channels of another renderer's file make up which buffer: by what is stated, by names, and by values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.layers import (
    UNSURE_ALBEDO,
    Channels,
    detect_channels,
    is_cryptomatte,
    last_name,
    layer_of,
    stack_channels,
    unpaired_specular,
)
from jaxdn.data.foreign.lighting import explain_light
from jaxdn.data.foreign.vectors import check_convention, contradicts_cycles, find_motion_convention, forward_channels


@dataclass(frozen=True)
class ChannelNaming:
    """How the buffers of other renderers' files are found; empty: by the names of their channels alone.

    Raises ClipError, listing the known ones, for a motion convention that does not exist.
    """

    motion_convention: str | None = None
    """Of the motion vectors: a key of :data:`jaxdn.data.foreign.vectors.CHOICES`; None: nobody has stated it."""
    channels: Mapping[str, str] | None = None
    """Buffer -> the layer it is read from, or ``"none"``."""
    layer: str | None = None
    """The view layer or part that the other buffers are looked for in."""

    def __post_init__(self) -> None:
        check_convention(self.motion_convention)

    @property
    def options(self) -> list[str]:
        """The command line's options that say what this says."""
        stated = {
            "--channels": self.channels,
            "--layer": self.layer,
            "--motion-convention": self.motion_convention,
        }
        return [option for option, value in stated.items() if value]

    def detect(self, names: Sequence[str]) -> dict[str, Channels]:
        """Buffer -> its channels (:func:`jaxdn.data.foreign.layers.detect_channels`)."""
        return detect_channels(names, channels=self.channels, layer=self.layer)


UNNAMED = ChannelNaming()
"""Nothing is stated."""


class ChannelMapping(NamedTuple):
    """What is read of a file, from which channels."""

    buffers: dict[str, Channels]
    """Buffer -> its channels."""
    convention: str | None
    """Of the motion vectors."""
    forward: Channels | None
    """The channels that dual motion vectors are made from, with those of the frame before."""
    rejected: frozenset[str]
    """Buffers whose channels turned out to be something else."""
    notes: list[str]
    """What was left unused, and why, in words."""


def classify_channels(
    pixels: Mapping[str, np.ndarray],
    naming: ChannelNaming,
    *,
    rejected: frozenset[str] | None = None,
    single: bool = False,
) -> ChannelMapping:
    """The buffers of a file.

    A layer called ``diffuse`` that is light (:func:`jaxdn.data.foreign.lighting.explain_light`), and a Cryptomatte in
    half precision, are left out and noted. Raises ClipError as :func:`jaxdn.data.foreign.layers.detect_channels` does,
    for motion vectors whose convention nobody has stated, and for light that was named the albedo outright.

    Args:
      pixels: every channel of the file.
      naming: what is stated about them.
      rejected: what an earlier frame of the sequence has decided; None: decide.
      single: there is no other frame, so motion vectors that nobody has explained are left out and noted.
    """
    stated = naming.channels or {}
    buffers = naming.detect(list(pixels))
    convention = find_motion_convention(buffers, pixels, naming.motion_convention, single=single)
    vectors = buffers.pop("motion") if convention is None and "motion" in buffers else None
    notes: dict[str, str] = {}
    if rejected is None:
        notes = _reject_by_values(pixels, buffers, stated)
        rejected = frozenset(notes)
        notes |= _doubt_stated_albedo(pixels, buffers, stated)
    buffers = {name: channels for name, channels in buffers.items() if name not in rejected}
    if "specular_reflectance" not in stated and (unpaired := unpaired_specular(list(pixels), buffers)) is not None:
        notes["specular_reflectance"] = (
            f"not used: {unpaired!r}, as the albedo may have this part in it already; if yours is the diffuse part "
            f"alone, name it: --channels specular_reflectance={unpaired}"
        )
    if vectors is not None and naming.motion_convention is None:
        notes["motion"] = (
            f"not used: {layer_of(vectors)!r}, as nothing says what these vectors mean; a single image needs none"
        )
    if contradicts_cycles(buffers, pixels, convention):
        notes["motion"] = (
            f"{layer_of(buffers['motion'])!r} looks like Blender's, whose convention is 'cycles'; read as stated"
        )
    return ChannelMapping(
        buffers, convention, forward_channels(buffers, pixels, convention), rejected, list(notes.values())
    )


def _reject_by_values(
    pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels], stated: Mapping[str, str]
) -> dict[str, str]:
    """Buffers whose channels are not what their names promise, with the reason. Raises ClipError for one named so."""
    notes = {}
    albedo, ids = buffers.get("albedo"), buffers.get("ids")
    if albedo is not None and ("albedo" in stated or last_name(albedo) == UNSURE_ALBEDO):
        why = _explain_albedo(pixels, buffers)
        if why is not None and "albedo" not in stated:
            notes["albedo"] = f"not used: {layer_of(albedo)!r} is a lighting pass and no albedo: {why}"
        elif why is not None and "at most" in why:  # who names a layer knows better, except about this
            raise ClipError(
                f"albedo: {layer_of(albedo)!r} is no albedo: {why}; name another, or --channels albedo=none."
            )
    if ids is not None and is_cryptomatte(ids) and pixels[ids[0]].dtype != np.float32:
        notes["ids"] = f"not used: {layer_of(ids)!r}, as half precision has destroyed the ids in it"
    return notes


def _doubt_stated_albedo(
    pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels], stated: Mapping[str, str]
) -> dict[str, str]:
    """A note about an albedo that was named outright and looks like light."""
    why = _explain_albedo(pixels, buffers) if "albedo" in stated and "albedo" in buffers else None
    if why is None:
        return {}
    return {"albedo": f"taken as you say: {layer_of(buffers['albedo'])!r}, but it looks like light: {why}"}


def _explain_albedo(pixels: Mapping[str, np.ndarray], buffers: Mapping[str, Channels]) -> str | None:
    """Why the albedo is light, in words; None where nothing says so."""
    return explain_light(stack_channels(pixels, buffers["albedo"]), stack_channels(pixels, buffers["radiance"]))
