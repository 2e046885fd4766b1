"""Which channels of another renderer's file make up which buffer: by what is stated, by names, and by values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxdn.data.foreign.decisions import Decisions
from jaxdn.data.foreign.layers import Channels, detect_channels, layer_of, unpaired_specular
from jaxdn.data.foreign.vectors import check_convention, contradicts_cycles, find_motion_convention, forward_channels


@dataclass(frozen=True)
class ChannelNaming:
    """How the buffers of other renderers' files are found; empty: by the names of their channels alone.

    Raises ClipError, listing the known ones, for a motion convention that does not exist.
    """

    motion_convention: str | None = None
    """Of the motion vectors: a key of :data:`jaxdn.data.foreign.vectors.CHOICES`; None: nobody has stated it."""
    channels: Mapping[str, str] | None = None
    """Buffer -> the layer it is read from, ``"none"``, or a pattern for the EXR files that have it."""
    layer: str | None = None
    """The view layer or part that the other buffers are looked for in."""
    view: str | None = None
    """The only view to read, of files with several, as of a stereo camera; None: each."""

    def __post_init__(self) -> None:
        check_convention(self.motion_convention)

    @property
    def pass_files(self) -> dict[str, str]:
        """Buffer -> pattern, of those that lie in files of their own."""
        return {name: layer for name, layer in (self.channels or {}).items() if layer.lower().endswith(".exr")}

    @property
    def options(self) -> list[str]:
        """The command line's options that say what this says."""
        stated = {
            "--channels": self.channels,
            "--layer": self.layer,
            "--view": self.view,
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
    named: tuple[str, ...]
    """The buffers that the file has a layer for, also where that is left out."""
    notes: list[str]
    """What was left unused, and why, in words; what earlier frames have told is not told again."""


def classify_channels(
    pixels: Mapping[str, np.ndarray],
    naming: ChannelNaming,
    *,
    decisions: Decisions | None = None,
    single: bool = False,
) -> ChannelMapping:
    """The buffers of a file.

    A layer called ``diffuse`` that is light (:func:`jaxdn.data.foreign.lighting.explain_light`), a Cryptomatte in half
    precision, and layers in which no frame has had anything yet are left out and noted. Raises ClipError as
    :func:`jaxdn.data.foreign.layers.detect_channels` does, for motion vectors whose convention nobody has stated, and
    for light that was named the albedo outright.

    Args:
      pixels: every channel of the file.
      naming: what is stated about them.
      decisions: what earlier frames of the sequence have told; what this one tells is added to it. None: no other frame
        has been looked at.
      single: there is no other frame, so motion vectors that nobody has explained are left out and noted.
    """
    decisions = Decisions() if decisions is None else decisions
    stated = naming.channels or {}
    named = naming.detect(list(pixels))
    convention = find_motion_convention(named, pixels, naming.motion_convention, single=single)
    vectors = named.pop("motion") if convention is None and "motion" in named else None
    buffers, judged = decisions.reject_by_values(pixels, named, stated)
    buffers, emptied = decisions.drop_empty(pixels, buffers, forward_channels(buffers, pixels, convention))
    notes = [*judged, *emptied]
    if "specular_reflectance" not in stated and (unpaired := unpaired_specular(list(pixels), named)) is not None:
        notes.append(
            f"not used: {unpaired!r}, as the albedo may have this part in it already; if yours is the diffuse part "
            f"alone, name it: --channels specular_reflectance={unpaired}"
        )
    if vectors is not None and naming.motion_convention is None:
        notes.append(
            f"not used: {layer_of(vectors)!r}, as nothing says what these vectors mean; a single image needs none"
        )
    convention = convention if "motion" in buffers else None
    if contradicts_cycles(buffers, pixels, convention):
        notes.append(
            f"{layer_of(buffers['motion'])!r} looks like Blender's, whose convention is 'cycles'; read as stated"
        )
    return ChannelMapping(buffers, convention, forward_channels(buffers, pixels, convention), tuple(named), notes)
