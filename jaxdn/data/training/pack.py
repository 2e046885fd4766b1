"""A training set in one compact file of a stated size: random windows of clips, to train where a line is thin.

The file is ``jaxdnpk1``, the SHA-256 of all that follows, the length of the index in 8 bytes (little-endian), the index
(JSON, compressed by zlib), and the compressed arrays of all windows in the order of the index. Codes and compression:
:mod:`jaxdn.data.training.compact`. On first use it is unpacked into the same arrays as the cache of a clip
(:mod:`jaxdn.data.training.cache`), so that everything that reads cached clips reads it.
"""

import hashlib
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.frame import BUFFERS, GUIDES
from jaxdn.data.errors import ClipError, read_json
from jaxdn.data.training.cache import ArrayFiles, CachedClip, ensure_cache, read_array
from jaxdn.data.training.compact import CODES, compress, decompress
from jaxdn.data.training.windows import Packed, Packing, check_packable, choose_windows
from jaxdn.runtime.atomic_files import write_atomically

_MAGIC = b"jaxdnpk1"
_HEADER = len(_MAGIC) + 32 + 8

_NOISY = "noisy_1spp"
_PARTS = {"draws": slice(0, 3), "draws_direct": slice(3, 6)}
"""Arrays of single samples, and their channels in the cache."""


Stored = list[tuple[str, str, bytes]]
"""Name, way and data of each array of a window."""


def write_pack(
    path: str | Path,
    clips: Sequence[CachedClip],
    *,
    size: int,
    packing: Packing,
    progress: Callable[[int, int], None] = lambda windows, size: None,
) -> Packed:
    """Pack random windows of clips into a file of at most ``size`` bytes, of every clip one before of any a second.

    Equal arguments give equal files. It ends before the first window that does not fit, or when chance finds no new
    window any more (in clips as large as a window there is one). ``progress`` is called with the windows and bytes so
    far. The file is complete or absent. Raises ClipError for clips that lack what is asked for or are smaller than a
    window, and for a size that not even one window fits in; ValueError for other values out of range; OSError if it
    cannot be written.
    """
    for clip in clips:
        check_packable(clip, packing)
    entries: list[dict[str, Any]] = []
    blobs: list[bytes] = []
    index, total = _packed_index(entries), _HEADER
    with ThreadPoolExecutor() as pool:
        for clip, window, rng in choose_windows(clips, packing):
            stored = _stored(clip, window, packing, rng, pool)
            entry = _entry(clip, window, packing, stored)
            longer = _packed_index([*entries, entry])
            data = sum(map(len, blobs)) + sum(len(data) for _, _, data in stored)
            if _HEADER + len(longer) + data > size:
                if not entries:
                    raise ClipError(
                        f"{path}: expected room for one window of {packing.crop} x {packing.crop} pixels, which takes "
                        f"{(_HEADER + len(longer) + data) / 2**20:.3g} MiB, got {size / 2**20:.3g} MiB; allow more, or "
                        "store less."
                    )
                break
            entries.append(entry)
            blobs += [data for _, _, data in stored]
            index, total = longer, _HEADER + len(longer) + data
            progress(len(entries), total)
    body = len(index).to_bytes(8, "little") + index + b"".join(blobs)
    write_atomically({Path(path): _MAGIC + hashlib.sha256(body).digest() + body})
    return Packed(len(entries), len({entry["clip"] for entry in entries}), total)


def open_pack(path: str | Path, *, cache: str | Path | None = None) -> list[CachedClip]:
    """The windows of a packed set as cached clips, unpacked into ``cache`` (default: ``.cache`` next to it) if need be.

    Raises ClipError if the file is missing, not a packed set, of another version, damaged or incomplete, and OSError if
    it cannot be unpacked.
    """
    path = Path(path)
    if not path.is_file():
        raise ClipError(f"{path}: there is no such file.")
    home = ensure_cache(path, cache, [path], lambda folder: _unpack(path, folder))
    clips = []
    for number, entry in enumerate(read_json(home / "facts.json")["windows"]):
        where = path / f"{number:04d}-{entry['clip']}"
        arrays, layers = frozenset(entry["arrays"]), tuple(entry["layers"])
        counts = entry["draws"], entry["reference_spp"], entry["planned"]
        clips.append(
            CachedClip(where, ArrayFiles(_folder(home, number)), tuple(entry["shape"]), arrays, layers, *counts)
        )
    return clips


def _stored(
    clip: CachedClip, window: tuple[slice, ...], packing: Packing, rng: np.random.Generator, pool: ThreadPoolExecutor
) -> Stored:
    """Everything to store of a window."""
    wanted = set(packing.buffers) | ({"direct", "emission"} if packing.direct and packing.draws else set())
    wanted |= {"reference"} | ({"reference_half"} if packing.half else set()) | (set() if packing.draws else {_NOISY})
    codes: dict[str, np.ndarray] = {}
    for name in (*GUIDES, "reference", "reference_half", _NOISY):  # in this order: neutral buffers come first
        if name in wanted & clip.arrays:
            codes[name] = CODES[_kind(name)].encode(read_array(clip, name, window))
    if packing.draws:
        chosen = np.sort(rng.permutation(clip.draws)[: packing.draws])
        draws = read_array(clip, "draws", (window[0], chosen, *window[1:]))
        for name in list(_PARTS)[: 1 + packing.direct]:
            codes[name] = CODES["sample"].encode(draws[..., _PARTS[name]])
    changes = {name: _changes(name, codes) for name in codes}
    compressed = pool.map(lambda name: compress(changes[name], _slopes(name, codes)), codes)
    return [(name, way, data) for name, (way, data) in zip(codes, compressed, strict=True)]


def _kind(name: str) -> str:
    """The row of the table of codes for an array."""
    return BUFFERS[name].kind if name in GUIDES else "light" if name.startswith("reference") else "sample"


def _base(name: str, there: Mapping[str, Any]) -> str | None:
    """The buffer that another is stored relative to, so that both are equal where they were: the one it defaults to."""
    neutral = BUFFERS[name].neutral if name in GUIDES else None
    return neutral if isinstance(neutral, str) and neutral in there else None


def _slopes(name: str, there: Mapping[str, Any]) -> tuple[int, ...]:
    return () if _base(name, there) else CODES[_kind(name)].slopes


def _changes(name: str, codes: Mapping[str, np.ndarray]) -> np.ndarray:
    base = _base(name, codes)
    return codes[name] if base is None else codes[name] - codes[base]  # modulo 2^bits


def _entry(clip: CachedClip, window: tuple[slice, ...], packing: Packing, stored: Stored) -> dict[str, Any]:
    """A window's part of the index."""
    return {
        "clip": clip.path.name,
        "start": [part.start for part in window],
        "shape": [part.stop - part.start for part in window],
        "draws": packing.draws,
        "reference_spp": clip.reference_spp,
        "planned": clip.planned,
        "arrays": [[name, way, len(data)] for name, way, data in stored],
    }


def _packed_index(entries: Sequence[Mapping[str, Any]]) -> bytes:
    return zlib.compress(json.dumps(entries).encode(), 9)


def _unpack(path: Path, home: Path) -> dict[str, Any]:
    data = path.read_bytes()
    if not data.startswith(_MAGIC):
        raise ClipError(f"{path}: this is not a training set that `jaxdn pack` of this version has written.")
    body = data[len(_MAGIC) + 32 :]
    if hashlib.sha256(body).digest() != data[len(_MAGIC) : len(_MAGIC) + 32]:
        raise ClipError(f"{path}: the file is damaged or incomplete (its checksum differs); copy it or pack it again.")
    place = 8 + int.from_bytes(body[:8], "little")
    entries = json.loads(zlib.decompress(body[8:place]))
    jobs = []
    for number, entry in enumerate(entries):
        _folder(home, number).mkdir()
        blobs = []
        for _, _, count in entry["arrays"]:
            blobs.append(body[place : place + count])
            place += count
        jobs.append((_folder(home, number), entry, blobs))
    with ThreadPoolExecutor() as pool:
        return {"windows": list(pool.map(lambda job: _unpack_window(*job), jobs))}


def _unpack_window(folder: Path, entry: Mapping[str, Any], blobs: Sequence[bytes]) -> dict[str, Any]:
    """Write the arrays of a window as the cache of a clip has them; returns its facts."""
    codes: dict[str, np.ndarray] = {}
    there = {name for name, _, _ in entry["arrays"]}
    images: dict[str, np.ndarray] = {}
    for (name, way, _), blob in zip(entry["arrays"], blobs, strict=True):
        code = CODES[_kind(name)]
        frames, *pixels = entry["shape"]
        channels = BUFFERS[name].channels if code.channels is None else code.channels
        count = [entry["draws"]] if name in _PARTS else []
        shape = (frames, *count, *pixels, *([channels] if channels else []))
        codes[name] = decompress(way, blob, code.dtype, shape, _slopes(name, dict.fromkeys(there)))
        base = _base(name, codes)
        if base is not None:
            codes[name] = codes[name] + codes[base]
        images[name] = code.decode(codes[name])
    parts = [images.pop(name) for name in _PARTS if name in images]
    if parts:
        images["draws"] = np.concatenate(parts, axis=-1)
        images[_NOISY] = parts[0][:, 0]  # a noisy layer too, for readers that take no single samples
    for name, image in images.items():
        np.save(folder / f"{name}.npy", image)
    return {**entry, "arrays": sorted(images), "layers": [1]}


def _folder(home: Path, number: int) -> Path:
    return home / f"{number:04d}"
