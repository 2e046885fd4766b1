"""Frames and clips from anywhere: folders of our own clips, and EXR sequences of other renderers."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdn.core.frame import Clip, Frame, present, written_out
from jaxdn.data.clip.folder import RECORD, frame_path, is_clip, read_frames, read_record, refuse_unfinished
from jaxdn.data.clip.frames import StoredFrame, doubling_layers
from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.import_exr import plain_frames
from jaxdn.filters.time_reversal import reverse_time


def open_frames(
    path: str | Path | Sequence[Path],
    *,
    spp: int = 1,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    view: str | None = None,
    part: range | None = None,
    backwards: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[list[Path], Iterator[StoredFrame]]:
    """The files of a clip, or of another renderer's sequence, and their frames, each read when it is requested.

    Takes what :func:`read_clip` takes, or a list of another renderer's files, and raises as it does; ``part`` are the
    indices to read of a clip, None: all. ``backwards`` and ``log`` as in
    :func:`jaxdn.data.foreign.import_exr.plain_frames`. The frames of another renderer have no ``layers`` and no
    reference.
    """
    if isinstance(path, str | Path):
        if is_clip(path):
            part = range(read_record(path)["frames"]) if part is None else part
            # First checks that all frames of the record exist.
            frames = read_frames(path, spp=spp, order=part[::-1] if backwards else part)
            return [frame_path(path, index) for index in part], _turned(frames) if backwards else frames
        refuse_unfinished(path)
    check_single_layer(path, spp)
    files, plain = plain_frames(
        path,
        motion_convention=motion_convention,
        channels=channels,
        layer=layer,
        view=view,
        backwards=backwards,
        log=log,
    )
    # Unlike the variable of a loop, this does not keep a frame while the next one is read.
    return files, map(StoredFrame, plain)


def _refuse_naming(path: str | Path, given: Mapping[str, Any]) -> None:
    """Raise ClipError for what is for files of other renderers, given for a clip of ours."""
    if unused := [name for name, value in given.items() if value]:
        raise ClipError(
            f"{path}: expected none of {', '.join(unused)}, which are for files of other renderers; it is a clip of "
            "jaxdn's own."
        )


def check_single_layer(path: str | Path | Sequence[Path], spp: int) -> None:
    """Raise ClipError for another renderer's files of which other than their only sample count is asked for."""
    if spp != 1:
        where = path if isinstance(path, str | Path) else f"{path[0]} ({len(path)} file{'s' * (len(path) != 1)})"
        raise ClipError(f"{where}: expected spp 1, got {spp}; only a clip with a {RECORD} has several sample counts.")


def _turned(frames: Iterator[StoredFrame]) -> Iterator[StoredFrame]:
    """Frames that come from the last to the first, with time turned around."""
    after: Frame | None = None
    for stored in frames:
        yield stored._replace(frame=reverse_time(stored.frame, after))
        after = stored.frame


def read_clip(
    path: str | Path,
    *,
    spp: int = 1,
    layers: bool = False,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    view: str | None = None,
) -> Clip:
    """Read a clip as NumPy arrays, with the dtypes of :attr:`jaxdn.core.frame.Buffer.dtype`.

    A buffer that only some frames have is written out in the others (:func:`jaxdn.core.frame.written_out`).

    ``path`` is the folder of a clip, of which ``spp`` samples a pixel are read, and with ``layers`` the independent
    noisy layers of 1, 2, 4, ... samples too (``Clip.layers``); or a folder of, or a glob pattern for, the EXR files of
    another renderer, whose channels are found by their names (``motion_convention``, ``channels``, ``layer``, ``view``:
    :func:`jaxdn.data.foreign.import_exr.plain_frames`).

    Raises ClipError, naming the file and the reason: no such folder, no ``clip.json``, another format version, missing
    or unreadable frames, missing channels, frames that differ in size or channels, ``spp`` or ``layers`` not available,
    and of a clip of ours what is for files of other renderers.
    """
    naming: dict[str, Any] = {
        "motion_convention": motion_convention,
        "channels": channels,
        "layer": layer,
        "view": view,
    }
    if is_clip(path):
        _refuse_naming(path, naming)
    _, opened = open_frames(path, spp=spp, **naming)
    stored = list(opened)
    counts = doubling_layers(stored[0].layers, path) if layers else []
    named = {name for one in stored for name in present(one.frame)}
    frames = jax.tree.map(lambda *buffers: np.stack(buffers), *(written_out(one.frame, named) for one in stored))
    references = [one.reference for one in stored if one.reference is not None]
    return Clip(
        frames,
        np.stack(references) if references else None,
        {count: np.stack([one.layers[count] for one in stored]) for count in counts} if layers else None,
    )
