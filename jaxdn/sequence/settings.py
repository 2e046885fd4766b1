"""What ``jaxdn denoise`` does with files."""

from collections.abc import Collection
from typing import Literal, NamedTuple

from jaxdn.data.foreign.classify import UNNAMED, ChannelNaming
from jaxdn.sequence.optics import Optics


class Settings(NamedTuple):
    """How frames are read, which of them are denoised, and what is written."""

    spp: int = 1
    """Samples per pixel to take from a clip's layers."""
    naming: ChannelNaming = UNNAMED
    """What is stated about the channels of other renderers' files."""
    frames: Collection[int] | None = None
    """Numbers of the frames to denoise; None: all."""
    skip_existing: bool = False
    """Leave out what is there already."""
    strict: bool = False
    """End at a file of another renderer that is damaged or differs from the others, instead of leaving it out."""
    only_beauty: bool = False
    """Of files of other renderers, write the denoised beauty and its alpha alone."""
    aovs: Literal["keep", "additive"] = "keep"
    """What becomes of the other layers of light in files of other renderers: they stay, or are denoised too, so that
    they still add up to the beauty (:mod:`jaxdn.sequence.aov_decomposition`)."""
    alpha: bool = False
    """Denoise the alpha of such files too (:mod:`jaxdn.sequence.alpha`)."""
    wrap: bool = False
    """The left edge of such files continues at the right one (:mod:`jaxdn.sequence.panorama`), as it does anyway where
    their attribute ``envmap`` says so."""
    reblur: Optics | None = None
    """Put motion blur and depth of field into what is written of such files (:mod:`jaxdn.sequence.optics`)."""
    preview: bool = False
    """Write a PNG next to each frame."""
    bidirectional: bool = False
    """Denoise from the last frame to the first too, and blend both passes (:mod:`jaxdn.filters.time_reversal`)."""
    safe: bool = True
    """Keep of the noisy image what is no noise (:mod:`jaxdn.sequence.james_stein`)."""
    max_memory: float | None = None
    """Bytes; frames that need more are denoised in tiles. None: half of the machine's memory."""
