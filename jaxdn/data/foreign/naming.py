"""What a user says about the channels of another renderer's files, where their names do not tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxdn.data.foreign.layers import Channels, detect_channels
from jaxdn.data.foreign.vectors import check_convention


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
