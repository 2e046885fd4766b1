"""A clip as a folder: ``clip.json`` and ``frame_0000.exr``, ``frame_0001.exr`` ... in it.

``clip.json`` is the clip's record: how it was made and what it contains. It is written last. While frames are being
written the folder has ``clip.unfinished.json`` instead, from which an interrupted rendering is resumed; such a folder
is not a clip yet.
"""

import itertools
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdn.core.frame import OF_SAMPLES, Clip, frame_at, only, present
from jaxdn.data.clip.frames import StoredFrame, encode_frame, layers_for, read_frame, stored_layers, write_frame
from jaxdn.data.clip.record import FORMAT, check_record, is_planned, shared_with
from jaxdn.data.errors import ClipError, read_json
from jaxdn.data.exr.exr import HALF_MAX
from jaxdn.data.exr.file import ExrFile
from jaxdn.runtime.atomic_files import write_json

RECORD = "clip.json"
_UNFINISHED = "clip.unfinished.json"


def frame_path(folder: str | Path, index: int) -> Path:
    """The path of frame ``index`` of a clip."""
    return Path(folder) / f"frame_{index:04d}.exr"


def is_clip(path: str | Path) -> bool:
    """Whether ``path`` is a folder with a finished clip in it."""
    return (Path(path) / RECORD).is_file()


def begin_record(record: Mapping[str, Any], folder: str | Path) -> None:
    """Start or extend a clip in a folder, which is created if it is missing, with the record of its future contents.

    Writes ``record`` as ``clip.unfinished.json`` and removes ``clip.json``: a finished clip that gets more frames is
    unfinished until :func:`finish_record`. Call it again when an entry changes in between. Raises ClipError if an
    entry is missing or wrong and ValueError if one is not JSON, without changing the folder; OSError if it cannot be
    written.
    """
    folder = Path(folder)
    record = check_record({"format": FORMAT, **record}, folder / _UNFINISHED)
    folder.mkdir(parents=True, exist_ok=True)
    # In this order there is always a record, however this is interrupted; until the second step, the finished clip's.
    write_json(folder / _UNFINISHED, record)
    (folder / RECORD).unlink(missing_ok=True)


def finish_record(record: Mapping[str, Any], folder: str | Path) -> None:
    """Make a folder whose frames are all written a clip: writes ``clip.json``, removes ``clip.unfinished.json``.

    Raises as :func:`begin_record` does.
    """
    folder = Path(folder)
    write_json(folder / RECORD, check_record({"format": FORMAT, **record}, folder / RECORD))
    (folder / _UNFINISHED).unlink(missing_ok=True)


def begun_record(folder: str | Path) -> dict[str, Any] | None:
    """The record of a clip that is finished or was interrupted; None where there is none.

    Raises ClipError if the record is broken or of another version.
    """
    for file in (Path(folder) / RECORD, Path(folder) / _UNFINISHED):  # where both exist, the clip is finished
        if file.is_file():
            return check_record(read_json(file), file)
    return None


def read_record(path: str | Path) -> dict[str, Any]:
    """The record of the finished clip in folder ``path``.

    Raises ClipError if it is missing, broken or of another version, or if rendering the clip was interrupted.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise ClipError(f"{folder}: there is no such folder.")
    if not is_clip(folder):
        raise _unfinished(folder)
    return check_record(read_json(folder / RECORD), folder / RECORD)


def find_clips(path: str | Path) -> list[Path]:
    """The finished clips in a folder (or the folder itself if it is one), by name.

    Warns of those that are left out because their rendering was interrupted. Raises ClipError if there is no finished
    one.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise ClipError(f"{folder}: there is no such folder.")
    if is_clip(folder):
        return [folder]
    if (folder / _UNFINISHED).is_file():
        raise _unfinished(folder)
    inside = sorted(folder.iterdir())
    found = [sub for sub in inside if is_clip(sub)]
    interrupted = [sub for sub in inside if (sub / _UNFINISHED).is_file() and sub not in found]
    if not found and interrupted:
        raise _unfinished(interrupted[0])
    if not found:
        raise ClipError(f"{folder}: expected a clip (a folder with {RECORD}) or a folder of clips, found none.")
    for sub in interrupted:
        warnings.warn(f"{_unfinished(sub)} It is left out.", stacklevel=2)
    return found


def write_clip(clip: Clip, path: str | Path, *, record: Mapping[str, Any] | None = None, spp: int = 1) -> None:
    """Write a clip into the folder ``path``, which is created if it is missing; an existing clip is replaced.

    The clip's radiance becomes its one noisy layer of ``spp`` samples a pixel. ``record`` is stored as ``clip.json``
    with the entries that follow from the frames (format, frames, width, height, layers) filled in. Light, fractions and
    directions keep half precision (:attr:`jaxdn.core.frame.Buffer.stored`); a warning counts light beyond 65504, which
    becomes that. Raises ValueError for shapes that do not fit each other or a record that is not JSON, and ClipError
    for a folder with frames that are no clip's, before anything is written; OSError if a file cannot be written.
    """
    folder = Path(path)
    if np.ndim(clip.frames.radiance) != 4 or not np.size(clip.frames.radiance):
        raise ValueError(f"{folder}: expected radiance [T, H, W, 3], got shape {np.shape(clip.frames.radiance)}.")
    clip = jax.tree.map(np.asarray, clip._replace(layers=None))
    count, height, width = clip.frames.radiance.shape[:3]
    lengths = {np.shape(leaf)[0] for leaf in jax.tree.leaves(clip)}
    if lengths != {count}:
        raise ValueError(f"{folder}: expected {count} frames in every buffer, got {sorted(lengths)}.")
    facts = {"format": FORMAT, "frames": count, "width": width, "height": height, "layers": [spp]}
    whole_record = {"name": folder.name, **(record or {}), **facts}
    _refuse_others(folder)

    def stored_frame(index: int) -> StoredFrame:
        frame = frame_at(clip.frames, index)
        reference = None if clip.reference is None else np.asarray(clip.reference[index])
        return StoredFrame(frame, {spp: np.asarray(frame.radiance)}, reference)

    encode_frame(frame_path(folder, 0), stored_frame(0))  # raises what a frame would while nothing is written
    _warn_of_clamped(clip, folder)
    begin_record(whole_record, folder)
    for index in range(count):
        one = stored_frame(index)
        write_frame(frame_path(folder, index), one.frame, layers=one.layers, reference=one.reference)
    for number, stale in _numbered(folder):
        if number >= count:
            stale.unlink()
    finish_record(whole_record, folder)


def _refuse_others(folder: Path) -> None:
    """Raise ClipError for a folder with frames that are no clip's: a renderer may call its files alike."""
    others = _numbered(folder)
    if others and not any((folder / name).is_file() for name in (RECORD, _UNFINISHED)):
        raise ClipError(
            f"{folder}: expected a clip or a folder without frames, got {others[0][1].name} and no {RECORD}; name "
            "another folder."
        )


def _warn_of_clamped(clip: Clip, folder: Path) -> None:
    """Warn of light that half precision cannot hold."""
    light = {"radiance": clip.frames.radiance, "reference": clip.reference}
    counts = {
        name: int(np.count_nonzero(np.isfinite(image) & (np.abs(image) > HALF_MAX)))
        for name, image in light.items()
        if image is not None
    }
    found = ", ".join(f"{number} of {name}" for name, number in counts.items() if number)
    if found:
        warnings.warn(
            f"{folder}: values beyond {HALF_MAX:g} become that, as light is stored in half precision: {found}; divide "
            "the light by a number that brings it below.",
            stacklevel=3,
        )


def read_frames(path: str | Path, *, spp: int = 1, order: Iterable[int] | None = None) -> Iterator[StoredFrame]:
    """The frames of a clip one by one, for clips that do not fit into memory. Raises as :func:`jaxdn.read_clip` does.

    ``order`` are the indices of those to read; None: all.

    Frames of a clip that was rendered by a plan may have different buffers (an object starts to move): absent ones are
    ``None``. A frame that shows the same as an earlier one takes its buffers and its reference from there, except for
    those of its own samples.
    """
    folder = Path(path)
    record = read_record(folder)
    own_samples = layers_for(spp, record["layers"], folder) == [min(record["layers"])]
    count, size = record["frames"], (record["height"], record["width"])
    _all_there(folder, count)
    held = shared_with(record)

    def frames() -> Iterator[StoredFrame]:
        first: set[str] | None = None
        source: tuple[int, StoredFrame] | None = None
        for index in range(count) if order is None else order:
            file = frame_path(folder, index)
            stored = read_frame(file, spp=spp)
            found = stored.frame.radiance.shape[:2]
            if found != size:
                raise ClipError(
                    f"{file}: expected {size[1]} x {size[0]} pixels as {RECORD} says, got {found[1]} x {found[0]}."
                )
            if held[index] == index:
                source = index, stored
            elif source is None or source[0] != held[index]:
                source = held[index], read_frame(frame_path(folder, held[index]), spp=spp)
            if held[index] != index:
                stored = _from(stored, source[1])
            if is_planned(record):
                wanted = set(record["plan"]["frames"][index]) - (frozenset() if own_samples else OF_SAMPLES)
                stored = _checked_buffers(stored, wanted, file)
            names = _names(stored, planned=is_planned(record))
            first = names if first is None else first
            if names != first:
                differing = ", ".join(sorted(names ^ first))
                raise ClipError(f"{file}: expected the same channels as in the other frames, but {differing} differs.")
            yield stored

    return frames()


def _all_there(folder: Path, count: int) -> None:
    """Raise ClipError unless there are ``count`` frames; as fast for a record that claims any number of them."""
    there = {index for index, _ in _numbered(folder) if index < count and frame_path(folder, index).is_file()}
    if len(there) < count:
        first = list(itertools.islice((index for index in range(count) if index not in there), 9))
        shown = ", ".join(map(str, first[:8])) + (" ..." if len(first) > 8 else "")
        raise ClipError(f"{folder}: {count - len(there)} of {count} frames are missing ({shown}); render them again.")


def _from(stored: StoredFrame, source: StoredFrame) -> StoredFrame:
    """The noise of one frame with everything else of another."""
    noise = {name: getattr(stored.frame, name) for name in ("radiance", *OF_SAMPLES)}
    frame = source.frame._replace(**noise)
    return stored._replace(frame=frame, reference=source.reference, reference_half=source.reference_half)


def _checked_buffers(stored: StoredFrame, wanted: set[str], file: Path) -> StoredFrame:
    missing = wanted - set(present(stored.frame))
    if missing:
        raise ClipError(f"{file}: expected the buffers {', '.join(sorted(missing))}; render the frame again.")
    return stored._replace(frame=only(stored.frame, frozenset(wanted)))


def count_frames(path: str | Path, frames: int) -> int:
    """How many of a clip's first frames are there, whether it is finished or not; 0 for a folder that is missing."""
    return sum(index < frames for index, _ in _numbered(Path(path)))


def refuse_unfinished(path: str | Path) -> None:
    """Raise ClipError if a folder is one of our clips whose rendering was interrupted."""
    if _looks_unfinished(path):
        raise _unfinished(Path(path))


def _unfinished(folder: Path) -> ClipError:
    """Why a folder is not a clip."""
    if (folder / _UNFINISHED).is_file():
        return ClipError(f"{folder}: rendering this clip was interrupted; run the same command again to finish it.")
    return ClipError(f"{folder}: there is no {RECORD} in it; the clip was not finished. Render it again.")


def _looks_unfinished(path: str | Path) -> bool:
    first = frame_path(path, 0)
    return (Path(path) / _UNFINISHED).is_file() or (first.is_file() and bool(stored_layers(ExrFile(first).windows)))


def _names(stored: StoredFrame, *, planned: bool) -> set[str]:
    """What all frames of a clip must have; with a plan, buffers may differ."""
    light = {f"noisy_{samples}spp" for samples in stored.layers}
    light |= {name for name in ("reference", "reference_half") if getattr(stored, name) is not None}
    light |= set() if stored.draws is None else {f"{len(stored.draws)} draws"}
    return light if planned else light | set(present(stored.frame))


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """The frames' files in a folder with their numbers."""
    files = folder.glob("frame_*.exr")
    return [(int(file.stem[6:]), file) for file in files if file.stem[6:].isdecimal()]
