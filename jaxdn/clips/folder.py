"""A clip as a folder: ``clip.json`` and ``frame_0000.exr``, ``frame_0001.exr`` ... beside it.

``clip.json`` is the clip's record: how it was made and what it holds. It is written last, so a folder without one is
unfinished, never a clip.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdn.clips.exr import read_exr
from jaxdn.clips.files import ClipError, read_json, write_json
from jaxdn.clips.frames import StoredFrame, layers_for, read_frame, stored_layers, write_frame
from jaxdn.clips.import_exr import read_plain_frames
from jaxdn.frame import Clip, Frame, frame_at, only, written_out

FORMAT = 1
"""The version of the layout that this code writes and reads."""

_RECORD = "clip.json"
_BUFFERS = frozenset(Frame._fields[1:])


def frame_path(folder: str | Path, index: int) -> Path:
    """Where frame ``index`` of a clip lies."""
    return Path(folder) / f"frame_{index:04d}.exr"


def is_clip(path: str | Path) -> bool:
    """Whether ``path`` is a folder with a finished clip in it."""
    return (Path(path) / _RECORD).is_file()


def write_clip(clip: Clip, path: str | Path, *, record: Mapping[str, Any] | None = None, spp: int = 1) -> None:
    """Write a clip into the folder ``path``, which is made if need be; a clip that is there already is replaced.

    The clip's radiance becomes its one noisy layer of ``spp`` samples a pixel. ``record`` is stored as ``clip.json``
    with the entries that the frames decide (format, frames, width, height, layers) filled in. Light, albedo, normals
    and roughness keep half precision. Raises ValueError for shapes that do not fit each other, ClipError for a record
    that is no JSON, OSError if the disk refuses.
    """
    folder = Path(path)
    if np.ndim(clip.frames.radiance) != 4:
        raise ValueError(f"{folder}: expected radiance [T, H, W, 3], got shape {np.shape(clip.frames.radiance)}.")
    clip = jax.tree.map(np.asarray, clip)
    count, height, width = clip.frames.radiance.shape[:3]
    lengths = {np.shape(leaf)[0] for leaf in jax.tree.leaves(clip)}
    if lengths != {count}:
        raise ValueError(f"{folder}: expected {count} frames in every buffer, got {sorted(lengths)}.")
    facts = {"format": FORMAT, "frames": count, "width": width, "height": height, "layers": [spp]}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _RECORD).unlink(missing_ok=True)
    for index in range(count):
        frame = frame_at(clip.frames, index)
        reference = None if clip.reference is None else clip.reference[index]
        write_frame(frame_path(folder, index), frame, layers={spp: frame.radiance}, reference=reference)
    for stale in folder.glob("frame_*.exr"):
        if stale.stem[6:].isdecimal() and int(stale.stem[6:]) >= count:
            stale.unlink()
    write_record({"name": folder.name, **(record or {}), **facts}, folder)


def write_record(record: Mapping[str, Any], path: str | Path) -> None:
    """Write ``clip.json`` of the clip folder ``path``. Raises ClipError if an entry is missing or is no JSON."""
    file = Path(path) / _RECORD
    write_json(file, _checked({"format": FORMAT, **record}, file))


def read_record(path: str | Path) -> dict[str, Any]:
    """The record of the clip in folder ``path``. Raises ClipError if it is missing, broken or of another version."""
    folder = Path(path)
    if not folder.is_dir():
        raise ClipError(f"{folder}: there is no such folder.")
    if not is_clip(folder):
        raise ClipError(f"{folder}: there is no {_RECORD} in it; the clip was not finished. Render it again.")
    return _checked(read_json(folder / _RECORD), folder / _RECORD)


def read_frames(path: str | Path, *, spp: int = 1) -> Iterator[StoredFrame]:
    """The frames of a clip one by one, for clips that do not fit into memory. Raises as :func:`read_clip` does.

    A clip that was rendered by a plan may have frames with other buffers than their neighbours (an object that starts
    to move): what a frame lacks is ``None`` in it. A frame that shows what an earlier one did has its buffers and its
    reference from there.
    """
    folder = Path(path)
    record = read_record(folder)
    layers_for(spp, record["layers"], folder)
    count, size = record["frames"], (record["height"], record["width"])
    _all_there(folder, count)
    held = held_frames(record)

    def frames() -> Iterator[StoredFrame]:
        first: tuple[str, ...] | None = None
        source: tuple[int, StoredFrame] | None = None
        for index in range(count):
            file = frame_path(folder, index)
            stored = read_frame(file, spp=spp)
            found = stored.frame.radiance.shape[:2]
            if found != size:
                raise ClipError(
                    f"{file}: expected {size[1]} x {size[0]} pixels as {_RECORD} says, got {found[1]} x {found[0]}."
                )
            if held[index] == index:
                source = index, stored
            elif source is None or source[0] != held[index]:
                source = held[index], read_frame(frame_path(folder, held[index]), spp=spp)
            if held[index] != index:
                stored = _from(stored, source[1])
            if is_planned(record):
                wanted = set(record["plan"]["frames"][index])
                stored = _checked_buffers(stored, wanted, file)
            names = _present(stored)
            first = names if first is None else first
            if names != first and not is_planned(record):
                differing = ", ".join(sorted(set(names) ^ set(first)))
                raise ClipError(f"{file}: expected the same channels as in frame 0, but {differing} differs.")
            yield stored

    return frames()


def is_planned(record: Mapping[str, Any]) -> bool:
    """Whether a clip was rendered by a plan: what it lacks is an absent effect, not something forgotten."""
    return record.get("plan") is not None


def held_frames(record: Mapping[str, Any]) -> list[int]:
    """For each frame of a clip the one whose buffers it shares."""
    return list(record["plan"]["held"]) if is_planned(record) else list(range(record["frames"]))


def _all_there(folder: Path, count: int) -> None:
    """Raise ClipError unless there are ``count`` frames; as fast for a record that claims any number of them."""
    numbers = {int(path.stem[6:]) for path in folder.glob("frame_*.exr") if path.stem[6:].isdecimal()}
    there = {index for index in numbers if index < count and frame_path(folder, index).is_file()}
    if len(there) < count:
        first = list(itertools.islice((index for index in range(count) if index not in there), 9))
        shown = ", ".join(map(str, first[:8])) + (" ..." if len(first) > 8 else "")
        raise ClipError(f"{folder}: {count - len(there)} of {count} frames are missing ({shown}); render them again.")


def _from(stored: StoredFrame, source: StoredFrame) -> StoredFrame:
    """The noise of one frame with everything else of another."""
    frame = source.frame._replace(radiance=stored.frame.radiance)
    return StoredFrame(frame, stored.layers, source.reference, source.reference_half)


def _checked_buffers(stored: StoredFrame, wanted: set[str], file: Path) -> StoredFrame:
    there = {name for name in Frame._fields[1:] if getattr(stored.frame, name) is not None}
    if wanted - there:
        raise ClipError(f"{file}: expected the buffers {', '.join(sorted(wanted - there))}; render the frame again.")
    return stored._replace(frame=only(stored.frame, frozenset(wanted)))


def read_clip(
    path: str | Path,
    *,
    spp: int = 1,
    motion_convention: str | None = None,
    layers: Mapping[str, str] | None = None,
) -> Clip:
    """Read a clip as numpy arrays, float32 but for ``ids`` (int32) and ``visible`` (bool).

    A buffer that some frames have and others lack is written out in those (:func:`jaxdn.frame.written_out`).

    ``path`` is the folder of a clip, of which ``spp`` samples a pixel are read; or a folder of, or a glob pattern for,
    the EXR files of another renderer, whose channels are found by their names (``motion_convention`` and ``layers``:
    see :func:`jaxdn.clips.import_exr.read_plain_frames`).

    Raises ClipError, naming the file and the reason: no such folder, no ``clip.json``, another format version, missing
    or unreadable frames, missing channels, frames that differ in size or channels, or ``spp`` not available.
    """
    frames: Sequence[Frame]
    references: Sequence[np.ndarray | None]
    if is_clip(path):
        stored = [(one.frame, one.reference) for one in read_frames(path, spp=spp)]
        frames, references = zip(*stored, strict=True)
        present = {name for frame in frames for name in Frame._fields[1:] if getattr(frame, name) is not None}
        frames = [written_out(frame, present) for frame in frames]
    elif _unfinished(path):
        raise ClipError(f"{path}: there is no {_RECORD} in it; the clip was not finished. Render it again.")
    elif spp != 1:
        raise ClipError(f"{path}: expected spp 1, got {spp}; only a clip with a {_RECORD} has several sample counts.")
    else:
        frames = read_plain_frames(path, motion_convention=motion_convention, layers=layers)
        references = [None] * len(frames)
    known = [reference for reference in references if reference is not None]
    stack = jax.tree.map(lambda *buffers: np.stack(buffers), *frames)
    return Clip(stack, np.stack(known) if known else None)


def _unfinished(path: str | Path) -> bool:
    first = frame_path(path, 0)
    return first.is_file() and bool(stored_layers(read_exr(first)))


def _present(stored: StoredFrame) -> tuple[str, ...]:
    buffers = [name for name, buffer in stored.frame._asdict().items() if buffer is not None]
    light = [f"noisy_{samples}spp" for samples in stored.layers]
    return (*buffers, *light, *(["reference"] if stored.reference is not None else []))


def _checked(record: Any, file: Path) -> dict[str, Any]:
    if not isinstance(record, dict):
        raise ClipError(f"{file}: expected a JSON object, got {type(record).__name__}.")
    if record.get("format") != FORMAT:
        raise ClipError(
            f"{file}: expected format {FORMAT}, got {record.get('format')!r}; this clip was written by another version."
        )
    for name in ("frames", "width", "height"):
        value = record.get(name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ClipError(f"{file}: {name}: expected a whole number of at least 1, got {value!r}.")
    layers = record.get("layers")
    if not isinstance(layers, list) or not layers or not all(type(n) is int and n > 0 for n in layers):
        raise ClipError(f"{file}: layers: expected a list of sample counts such as [1, 2, 4], got {layers!r}.")
    _check_plan(record.get("plan"), record["frames"], file)
    cameras = record.get("cameras")
    if cameras is not None and (not isinstance(cameras, list) or len(cameras) < record["frames"]):
        raise ClipError(f"{file}: cameras: expected a list with one for each frame; render the clip again.")
    return record


def _check_plan(plan: Any, count: int, file: Path) -> None:
    """Raise ClipError unless a plan is None or says what each frame holds, whose it is, and for which effects."""
    if plan is None:
        return
    held = plan.get("held") if isinstance(plan, Mapping) else None
    frames = plan.get("frames") if isinstance(plan, Mapping) else None
    sound = isinstance(held, list) and isinstance(frames, list) and len(held) == len(frames) == count
    if not sound or not all(type(at) is int and 0 <= at <= index for index, at in enumerate(held or [])):
        raise ClipError(f"{file}: plan: expected what each of {count} frames holds; render it again.")
    effects = plan.get("effects")
    if not isinstance(effects, list) or not all(isinstance(name, str) for name in effects):
        raise ClipError(f"{file}: plan: expected a list of effects, got {effects!r}; render the clip again.")
    for names in frames or []:
        if not isinstance(names, list) or not all(isinstance(name, str) and name in _BUFFERS for name in names):
            raise ClipError(f"{file}: plan: expected names of buffers, got {names!r}; render it again.")
