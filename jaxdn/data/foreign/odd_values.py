"""Values of a shot's frames that are repaired when it is denoised: found in a few frames, and told in words."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from jaxdn.core.frame import BUFFERS, Frame
from jaxdn.data.errors import ClipError, DamagedFile
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import OWN
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.data.foreign.import_exr import ForeignSequence

MOST = 5
"""Frames of a shot that are looked at: the first, the last, and some between them, evenly spread."""


def choose_frames(files: Sequence[ExrFile]) -> list[ExrFile]:
    """The files whose values are looked at: all of a short shot."""
    places = np.rint(np.linspace(0, len(files) - 1, min(MOST, len(files)))).astype(int)
    return [files[place] for place in places.tolist()]


def find_odd_values(files: Sequence[ExrFile], naming: ChannelNaming, *, unexplained: bool) -> list[str]:
    """What reading some frames tells, and which of their values are no numbers, in sentences.

    Args:
      files: of the frames to look at, all usable by their headers.
      naming: what is stated about the channels.
      unexplained: nobody has stated what the motion vectors mean; here any convention will do.
    """
    assumed = replace(naming, motion_convention=OWN) if unexplained else naming
    left, damaged = list(files), list[str]()
    while left:
        sequence, lines = ForeignSequence(left, assumed), list[str]()
        try:
            for file, frame in zip(left, sequence.frames(log=lines.append), strict=True):
                lines += [f"{label_file(file.path)}: {line}" for line in _count_odd(frame)]
        except DamagedFile as error:
            damaged.append(f"{label_file(error.path)} counts as a missing frame: {error.reason}")
            left = [file for file in left if file.path != error.path]
            continue
        except ClipError as error:
            lines.append(str(error))
        return [*damaged, *lines, *sequence.repairs.totals()]
    return damaged


def _count_odd(frame: Frame) -> Iterator[str]:
    """Which buffers have values that are no numbers; those of distances mean that nothing is there."""
    for name, values in frame._asdict().items():
        if values is None or BUFFERS[name].kind == "distance":
            continue
        count = int(np.sum(~np.isfinite(values).all(axis=-1)))
        if count == 1:
            yield f"1 pixel of {name} is NaN or infinite; it is replaced when the frame is denoised"
        elif count:
            yield f"{count} pixels of {name} are NaN or infinite; they are replaced when the frame is denoised"
