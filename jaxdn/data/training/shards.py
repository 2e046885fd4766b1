"""A training set in shards: windows of clips, exactly as they are stored, in ArrayRecord files of one to two gigabytes.

A set is a folder of ``windows-00000.arrayrecord`` ... and ``shards.json``, which is written last. Every array of a
window is a record of its own, compressed by zstd, so that what a denoiser does not read is not decompressed either.
Records are found by their number: a set of any size is shuffled exactly, and nothing is unpacked. The files are read
by Grain (``grain.sources.ArrayRecordDataSource``) and detect damage by the checksum of each record.

For few clips and thin lines there is the smaller, rounded form (:mod:`jaxdn.data.training.pack`).
"""

import importlib.util
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn.data.errors import ClipError, read_json
from jaxdn.data.training.cache import CachedClip, read_stored
from jaxdn.data.training.windows import Packed, Packing, check_packable, choose_windows
from jaxdn.runtime.atomic_files import atomic_write, write_json
from jaxdn.runtime.scratch import scratch_folder

_FORMAT = 1
_INDEX = "shards.json"
_SHARDS = "windows-*.arrayrecord"
_ADVICE = "copy it again, or pack the set again"
_OPTIONS = "group_size:1,zstd:1"
"""Each record can be read alone. Higher levels save 5 % more and take four times as long."""
_LEAST = 2**17
"""Bytes that a shard takes besides its records, at most."""
_OPEN_SHARDS = 256
"""Shards that are open at once: a process may have a thousand files open, and a set may have more shards."""

_INDEXED = 96
"""Bytes that a window takes in the index, at most."""


class Taken(NamedTuple):
    """A window of a clip with what is stored of it."""

    clip: CachedClip
    arrays: dict[str, np.ndarray]

    @property
    def size(self) -> int:
        """In bytes, before compression."""
        return sum(array.nbytes for array in self.arrays.values())


class ShardedArrays(NamedTuple):
    """The arrays of one window in a shard."""

    shard: Path
    first: int
    """The number of the window's first record."""
    arrays: Mapping[str, tuple[int, str, tuple[int, ...]]]
    """Of each array the number of its record, counted from the first, its dtype and its shape."""

    def read(self, name: str, window: tuple[Any, ...]) -> np.ndarray:
        """The part ``window`` of an array. Raises ClipError, naming the shard, if it is damaged."""
        place, dtype, shape = self.arrays[name]
        number = self.first + place
        try:
            record = _open_shard(self.shard)[number]
            return np.frombuffer(record, dtype).reshape(shape)[window]
        except (RuntimeError, ValueError, OSError, IndexError) as error:
            raise ClipError(
                f"{self.shard}: the shard is damaged: record {number}, {name}, cannot be read ({_short(error)}); copy "
                "the file again from where it was packed, or pack the set again."
            ) from error


def is_sharded(place: Path) -> bool:
    """Whether a folder is a set of shards, be it one whose index was not copied."""
    return (place / _INDEX).is_file() or next(place.glob(_SHARDS), None) is not None


def write_shards(
    folder: str | Path,
    clips: Sequence[CachedClip],
    *,
    size: int,
    packing: Packing,
    shard_size: int = 2**31,
    progress: Callable[[int, int], None] = lambda windows, size: None,
) -> Packed:
    """Pack random windows of clips into a new folder of at most ``size`` bytes, of every clip one before any a second.

    ``packing.buffers`` are stored in every form that the clips have, so are all noisy layers. Equal arguments give
    equal files. A shard ends when its windows have ``shard_size`` bytes, before they are compressed; the last ones are
    smaller, so that the size is kept. ``progress`` is called with the windows and bytes so far. The folder is complete
    or absent: what a killed process leaves behind has another name, and the next call removes it.

    Raises ClipError for clips that lack what is asked for, and for a size that not even one window fits in; ValueError
    for other values out of range, for a folder that exists, and on Windows, which ArrayRecord does not support; OSError
    if it cannot be written.
    """
    folder = Path(folder)
    if importlib.util.find_spec("array_record") is None:
        raise ValueError("arrayrecord: expected the package array-record, got none (Windows has none); pack a file.")
    if folder.exists():
        raise ValueError(f"{folder}: expected a new folder, got one that exists; delete it, or give another name.")
    for clip in clips:
        check_packable(clip, packing)
    contents, more = _Contents(clips), _take_windows(clips, packing)
    following: Taken | None = next(more)
    if following is not None and following.size > contents.room(size):
        raise ClipError(
            f"{folder}: expected room for one window of {packing.crop} x {packing.crop} pixels, which takes up to "
            f"{(1.01 * following.size + _LEAST) / 2**20:.3g} MiB, got {size / 2**20:.3g} MiB; allow more, or "
            "store less."
        )
    with scratch_folder(folder.parent, f".{folder.name}.packing-") as temporary:
        while following is not None and following.size <= contents.room(size):
            limit = min(shard_size, contents.room(size))
            following = _write_shard(contents, temporary, following, more, limit, progress)
        packed = contents.write_index(temporary)
        os.rename(temporary, folder)
    return packed


def open_shards(folder: str | Path) -> list[CachedClip]:
    """The windows of a set of shards as clips for random access.

    Raises ClipError for a missing or damaged ``shards.json``, one of another version, and for shards that are missing
    or of another size, by name.
    """
    folder = Path(folder)
    if not (folder / _INDEX).is_file():
        raise ClipError(f"{folder / _INDEX}: the index is missing; {_ADVICE}.")
    index = read_json(folder / _INDEX, _ADVICE)
    if isinstance(index, dict) and index.get("format") != _FORMAT:
        raise ClipError(f"{folder / _INDEX}: expected format {_FORMAT}, got {index.get('format')}; pack the set again.")
    try:
        clips = _list_windows(folder, index)
        sizes = {folder / str(name): int(size) for name, size in index["shards"]}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise ClipError(f"{folder / _INDEX}: this is no index of shards ({error!r}); {_ADVICE}.") from error
    for shard, size in sizes.items():
        _check_size(shard, size)
    return clips


def _list_windows(folder: Path, index: Any) -> list[CachedClip]:
    shards = [folder / name for name, _ in index["shards"]]
    kinds = [_Kind.from_record(kind) for kind in index["kinds"]]
    clips = []
    for number, (shard, first, kind, clip) in enumerate(index["windows"]):
        where = folder / f"{number:06d}-{index['clips'][clip]}"
        clips.append(kinds[kind].as_clip(where, shards[shard], first))
    return clips


class _Kind(NamedTuple):
    """What windows have in common, of which a set has few sorts and many windows."""

    shape: tuple[int, int, int]
    arrays: dict[str, tuple[int, str, tuple[int, ...]]]
    names: frozenset[str]
    layers: tuple[int, ...]
    facts: tuple[int, int, bool]
    """Single samples, samples of the reference, whether the clip was rendered by a plan."""

    def as_record(self) -> dict[str, Any]:
        return {"shape": self.shape, "arrays": self.arrays, "layers": self.layers, "facts": self.facts}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> "_Kind":
        arrays = {name: (place, dtype, tuple(shape)) for name, (place, dtype, shape) in record["arrays"].items()}
        layers, facts = tuple(record["layers"]), tuple(record["facts"])
        return _Kind(tuple(record["shape"]), arrays, frozenset(arrays), layers, facts)

    def as_clip(self, path: Path, shard: Path, first: int) -> CachedClip:
        store = ShardedArrays(shard, first, self.arrays)
        return CachedClip(path, store, self.shape, self.names, self.layers, *self.facts)


class _Contents:
    """What has been written of a set."""

    def __init__(self, clips: Sequence[CachedClip]) -> None:
        self._clips = list(dict.fromkeys(clip.path.name for clip in clips))
        self._kinds: list[_Kind] = []
        self._shards: list[tuple[str, int]] = []
        self._windows: list[tuple[int, int, int, int]] = []

    @property
    def windows(self) -> int:
        return len(self._windows)

    @property
    def size(self) -> int:
        """In bytes, of the shards that are complete."""
        return sum(size for _, size in self._shards)

    def room(self, size: int) -> float:
        """Bytes of windows that certainly fit in what is left of ``size``, were they not compressed at all."""
        return (size - self.size - _LEAST - _INDEXED * self.windows) / 1.01

    def add_window(self, first: int, clip: CachedClip, arrays: Mapping[str, np.ndarray]) -> None:
        kind = _describe(clip, arrays)
        if kind not in self._kinds:
            self._kinds.append(kind)
        entry = (len(self._shards), first, self._kinds.index(kind), self._clips.index(clip.path.name))
        self._windows.append(entry)

    def next_shard(self) -> str:
        return f"windows-{len(self._shards):05d}.arrayrecord"

    def end_shard(self, path: Path) -> None:
        self._shards.append((path.name, path.stat().st_size))

    def write_index(self, folder: Path) -> Packed:
        kinds = [kind.as_record() for kind in self._kinds]
        index = {"format": _FORMAT, "shards": self._shards, "clips": self._clips, "kinds": kinds}
        write_json(folder / _INDEX, {**index, "windows": self._windows})
        clips = {clip for *_, clip in self._windows}
        return Packed(self.windows, len(clips), self.size + (folder / _INDEX).stat().st_size)


def _write_shard(
    contents: _Contents,
    folder: Path,
    window: Taken,
    more: Iterator[Taken],
    limit: float,
    progress: Callable[[int, int], None],
) -> Taken | None:
    """Write one window, and more while they have at most ``limit`` bytes; returns the first that is not written."""
    from array_record.python.array_record_module import ArrayRecordWriter

    path, records, raw = folder / contents.next_shard(), 0, 0
    following: Taken | None = window
    with atomic_write(path) as temporary:
        try:
            writer = ArrayRecordWriter(str(temporary), _OPTIONS)
            while following is not None and (not raw or raw + following.size <= limit):
                contents.add_window(records, following.clip, following.arrays)
                for array in following.arrays.values():
                    writer.write(array.tobytes())
                records, raw = records + len(following.arrays), raw + following.size
                progress(contents.windows, contents.size + raw)
                following = next(more, None)
            writer.close()
        except RuntimeError as error:  # a full disk, for one
            raise OSError(f"{path}: cannot be written ({_short(error)}).") from error
    contents.end_shard(path)
    return following


def _take_windows(clips: Sequence[CachedClip], packing: Packing) -> Iterator[Taken]:
    """Random windows with all arrays to store, as the clips have them."""
    beauty = {"direct", "emission"}
    guides = set(packing.buffers) | beauty if packing.direct else set(packing.buffers) - beauty
    for clip, window, rng in choose_windows(clips, packing):
        arrays = {}
        for name in sorted(clip.arrays - {"draws"}):
            if _is_wanted(name, guides, packing):
                arrays[name] = read_stored(clip, name, window)
        if packing.draws:
            chosen = np.sort(rng.permutation(clip.draws)[: packing.draws])
            draws = read_stored(clip, "draws", (window[0], chosen, *window[1:]))
            arrays["draws"] = draws if packing.direct else np.ascontiguousarray(draws[..., :3])
        yield Taken(clip, arrays)


def _is_wanted(name: str, guides: Collection[str], packing: Packing) -> bool:
    """Whether an array of a clip is stored: references, layers, wanted guides, and their means over other samples."""
    if name == "reference_half":
        return packing.half
    found = re.fullmatch(r"(?:reference|noisy_\d+spp)(?:_(?P<guide>\w+))?", name)
    guide = name if found is None else found["guide"]
    return guide is None or guide in guides


def _describe(clip: CachedClip, arrays: Mapping[str, np.ndarray]) -> _Kind:
    frames, height, width, _ = arrays["reference"].shape
    stored = {name: (place, array.dtype.str, array.shape) for place, (name, array) in enumerate(arrays.items())}
    facts = (arrays["draws"].shape[1] if "draws" in arrays else 0), clip.reference_spp, clip.planned
    return _Kind((frames, height, width), stored, frozenset(stored), clip.layers, facts)


def _check_size(path: Path, size: int) -> None:
    try:
        found = path.stat().st_size
    except FileNotFoundError as error:
        raise ClipError(f"{path}: the shard is missing; {_ADVICE}.") from error
    if found != size:
        raise ClipError(
            f"{path}: the shard is damaged: expected {size} bytes, got {found}; copy it again from where it was "
            "packed, or pack the set again."
        )


@lru_cache(maxsize=_OPEN_SHARDS)
def _open_shard(path: Path) -> Any:
    """The records of a shard, open until many others have been read since."""
    from grain.sources import ArrayRecordDataSource

    return ArrayRecordDataSource([str(path)])


def _short(error: BaseException) -> str:
    return str(error).split("; at", 1)[0][:200] or type(error).__name__
