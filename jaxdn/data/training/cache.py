"""Clips as memory maps, so that training need not decode EXR files for every crop.

``<folder>/.cache/<clip>.<stamp>/`` holds one ``.npy`` file per buffer of a clip, in the precision it has in the EXR
files. The stamp is made of the names, sizes and times of those files, so that a clip that changes gets a new cache; the
cache may be deleted at any time.
"""

import glob
import hashlib
import itertools
import os
import secrets
import shutil
import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from jaxdn.core.frame import AVERAGED, BUFFERS, GUIDES, OF_SAMPLES, Buffer, Clip, Frame, present, written_out
from jaxdn.data.clip.folder import frame_path, read_frames, read_record
from jaxdn.data.clip.frames import StoredFrame, combine, doubling_layers, layers_for
from jaxdn.data.clip.record import is_planned
from jaxdn.data.errors import ClipError, read_json
from jaxdn.data.exr.exr import to_half
from jaxdn.runtime.atomic_files import write_json

_VERSION = 3  # of the cache's layout; caches of other versions are not used
_LIGHT = BUFFERS["radiance"]
"""How noisy layers and references are stored."""
_ONE_HEADER = threading.Lock()
"""NumPy parses a file's header as Python, which in CPython 3.11 fails now and then in several threads at once
(SystemError: AST constructor recursion depth mismatch)."""


class ArrayStore(Protocol):
    """Where the arrays of a clip are."""

    def read(self, name: str, window: tuple[Any, ...]) -> np.ndarray:
        """The part ``window`` of an array, as it is stored."""


class ArrayFiles(NamedTuple):
    """Arrays as ``.npy`` files in a folder, mapped into memory only while they are read.

    A memory map holds a file handle for as long as it lives, and a few hundred clips of a dozen buffers would need more
    of them than a process may have.
    """

    folder: Path

    def read(self, name: str, window: tuple[Any, ...]) -> np.ndarray:
        """The part ``window`` of an array, as a view of its file."""
        with _ONE_HEADER:
            whole = np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        return whole[window]


class CachedClip(NamedTuple):
    """One clip, ready for random access; files are opened only by :func:`read_window`."""

    path: Path
    """The clip's own folder."""
    store: ArrayStore
    """Its arrays."""
    shape: tuple[int, int, int]
    """Frames, height, width."""
    arrays: frozenset[str]
    """The stored arrays: names of buffers, ``reference``, ``reference_half``, ``draws`` and ``noisy_<n>spp``; of a clip
    with filtered pixels also the guides of each image, ``noisy_<n>spp_<buffer>`` and ``reference_<buffer>``."""
    layers: tuple[int, ...]
    """The sample counts of the noisy layers."""
    draws: int = 0
    """The number of single samples."""
    reference_spp: int = 0
    """Samples per pixel of the reference; 0 if it is not known."""
    planned: bool = False
    """Whether a buffer that is missing is an absent effect, equal to its neutral value."""

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the Frame buffers that are present, except ``radiance``."""
        return self.arrays & frozenset(GUIDES)

    @property
    def filtered(self) -> bool:
        """Whether each image has its own guides, means over its samples."""
        return any(f"reference_{name}" in self.arrays for name in AVERAGED)

    @property
    def half_spp(self) -> int:
        """Samples per pixel of the reference's first half; 0 without one."""
        return (self.reference_spp + 1) // 2 if "reference_half" in self.arrays else 0


def open_cached(path: str | Path, *, cache: str | Path | None = None) -> CachedClip:
    """Open a clip through its cache (default: ``.cache`` next to the clip's folder), which is created if it is missing.

    Reference values that are not finite or negative are 0 in the cache, and a UserWarning names the clip and how many
    there are; noisy images stay as they are, as denoisers sanitize their own input. Raises ClipError as
    :func:`jaxdn.clips.read_clip` does, and OSError if the cache cannot be written.
    """
    path = Path(path)
    record = read_record(path)
    frames = (frame_path(path, index) for index in range(record["frames"]))  # the record may claim any number
    home = ensure_cache(path, cache, itertools.chain([path / "clip.json"], frames), lambda folder: _fill(path, folder))
    facts = read_json(home / "facts.json")
    if facts["bad_reference_values"]:
        warnings.warn(
            f"{path}: {facts['bad_reference_values']} values of the reference are not finite or negative; "
            "they count as 0.",
            stacklevel=2,
        )
    shape = (record["frames"], record["height"], record["width"])
    counts = facts["draws"], int(record.get("reference_spp", 0))
    return CachedClip(
        path, ArrayFiles(home), shape, frozenset(facts["arrays"]), tuple(facts["layers"]), *counts, is_planned(record)
    )


def read_window(
    clip: CachedClip,
    window: tuple[slice, ...],
    *,
    spp: int = 1,
    light: tuple[np.ndarray, np.ndarray | None] | None = None,
    buffers: Collection[str] | None = None,
    layers: bool = False,
    widen: bool = True,
) -> Clip:
    """The part ``window`` (frames, rows, columns) of a clip as a Clip of plain arrays with ``spp`` samples per pixel.

    ``light``: noisy radiance and reference of the window, where they are not to be read. The buffers of samples
    (:data:`jaxdn.core.frame.OF_SAMPLES`) are read only where the radiance is the layer they belong to. Where pixels
    were filtered, guides are those of ``spp`` samples.

    Buffers have the dtypes of :attr:`jaxdn.core.frame.Buffer.dtype`. ``buffers`` names the ones to read (default:
    all there are); of a clip that was rendered by a plan, those that it lacks are written out. With ``layers`` the
    clip's independent noisy layers of 1, 2, 4, ... samples are read too (``Clip.layers``). Without ``widen`` guides
    stay in half precision where they are stored so.
    """
    asked = set(clip.buffers) if buffers is None else set(buffers) & set(GUIDES)
    if light is not None or layers_for(spp, clip.layers, clip.path) != [min(clip.layers)]:
        asked -= OF_SAMPLES
    guides = {name: read_guide(clip, name, window, spp, widen=widen) for name in clip.buffers & asked}
    if light is None:
        reference = read_array(clip, "reference", window) if "reference" in clip.arrays else None
        light = read_layers(clip, window, spp), reference
    frames = Frame(radiance=light[0], **guides)
    counts = doubling_layers(clip.layers, clip.path) if layers else ()
    return Clip(
        written_out(frames, asked) if clip.planned else frames,
        light[1],
        {samples: read_array(clip, _noisy(samples), window) for samples in counts} if layers else None,
    )


def read_layers(clip: CachedClip, window: tuple[slice, ...], spp: int, *, widen: bool = True) -> np.ndarray:
    """Noisy radiance of ``spp`` samples a pixel, combined from the layers; one alone, without ``widen``, as stored."""
    chosen = layers_for(spp, clip.layers, clip.path)
    if len(chosen) == 1 and not widen:
        return read_stored(clip, _noisy(chosen[0]), window)
    return combine({samples: read_array(clip, _noisy(samples), window) for samples in chosen})


def read_guide(clip: CachedClip, name: str, window: tuple[slice, ...], spp: int, *, widen: bool = True) -> np.ndarray:
    """The part ``window`` of a buffer; one that is a mean over samples, of ``spp`` of them.

    Of the half of a reference there are no guides: those of all its samples are as good as free of noise, too.
    """
    if not clip.filtered or name not in AVERAGED:
        narrow = not widen and BUFFERS[name].stored == "half"
        return read_stored(clip, name, window) if narrow else read_array(clip, name, window)
    if spp == clip.half_spp:
        return read_array(clip, f"reference_{name}", window)
    fewest = min(clip.layers)
    chosen = layers_for(spp, clip.layers, clip.path)
    images = {n: read_array(clip, name if n == fewest else f"{_noisy(n)}_{name}", window) for n in chosen}
    return combine(images).astype(BUFFERS[name].dtype, copy=False)


def read_array(clip: CachedClip, name: str, window: tuple[Any, ...]) -> np.ndarray:
    """The part ``window`` of one stored array, in the dtype of its buffer."""
    return np.array(clip.store.read(name, window), BUFFERS.get(name, _LIGHT).dtype)


def read_stored(clip: CachedClip, name: str, window: tuple[Any, ...]) -> np.ndarray:
    """The part ``window`` of one stored array, in the precision it is stored in."""
    return np.array(clip.store.read(name, window))


def ensure_cache(
    path: Path, cache: str | Path | None, files: Iterable[Path], fill: Callable[[Path], Mapping[str, Any]]
) -> Path:
    """The folder ``<cache>/<name of path>.<stamp of files>`` (default: ``.cache`` next to ``path``).

    Where it is missing, ``fill`` is called with a temporary folder and returns the contents of its ``facts.json``; the
    folder gets its name when it is complete. Raises ClipError for a missing file, OSError if it cannot be written.
    """
    root = path.parent / ".cache" if cache is None else Path(cache)
    home = root / f"{path.name}.{_stamp(files)}"
    if not home.is_dir():
        _build(path.name, home, fill)
        _remove_stale(root, path.name, home)
    return home


def _stamp(files: Iterable[Path]) -> str:
    digest = hashlib.sha256(f"{_VERSION}".encode())
    for file in files:
        try:
            facts = file.stat()
        except OSError as error:
            raise ClipError(f"{file}: {error.strerror}; render the frame again.") from error
        digest.update(f"{file.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def _build(name: str, home: Path, fill: Callable[[Path], Mapping[str, Any]]) -> None:
    home.parent.mkdir(parents=True, exist_ok=True)
    temporary = home.parent / f".{name}.{secrets.token_hex(4)}"
    temporary.mkdir()  # with the rights of any folder: a temporary one of Python's is its owner's alone
    try:
        write_json(temporary / "facts.json", fill(temporary))
        try:
            os.rename(temporary, home)
        except OSError:
            if not home.is_dir():  # otherwise another process made the same cache meanwhile
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _fill(path: Path, folder: Path) -> dict[str, object]:
    record = read_record(path)
    maps: dict[str, np.memmap] = {}
    bad, layers, draws = 0, [], 0
    for index, stored in enumerate(_uniform(path, record)):
        layers, draws = sorted(stored.layers), 0 if stored.draws is None else len(stored.draws)
        for name, image, buffer in _images(stored):
            if name in ("reference", "reference_half"):
                wrong = ~(np.isfinite(image) & (image >= 0))
                bad += int(wrong.sum()) if name == "reference" else 0
                image = np.where(wrong, np.float32(0), image)
            if buffer.stored == "half":
                image = to_half(image)
            if name not in maps:
                shape = (record["frames"], *image.shape)
                maps[name] = np.lib.format.open_memmap(folder / f"{name}.npy", "w+", image.dtype, shape)
            maps[name][index] = image
    for array in maps.values():
        array.flush()
    return {"arrays": sorted(maps), "layers": layers, "draws": draws, "bad_reference_values": bad}


def _uniform(path: Path, record: Mapping[str, Any]) -> Iterator[StoredFrame]:
    """The frames of a clip, all with the same buffers."""
    named = {name for names in record["plan"]["frames"] for name in names} if is_planned(record) else set()
    for stored in read_frames(path, spp=record["layers"][0]):
        yield stored._replace(frame=written_out(stored.frame, named))


def _images(stored: StoredFrame) -> Iterator[tuple[str, np.ndarray, Buffer]]:
    """Everything to store of a frame: the array's name, the array, and how it is stored."""
    for samples, image in stored.layers.items():
        yield _noisy(samples), image, _LIGHT
    for name in present(stored.frame):
        yield name, np.asarray(getattr(stored.frame, name)), BUFFERS[name]
    fewest = min(stored.layers)
    own = {_noisy(samples): guides for samples, guides in stored.layer_guides.items() if samples != fewest}
    for which, guides in {**own, "reference": stored.reference_guides}.items():
        for name, image in guides.items():
            yield f"{which}_{name}", image, BUFFERS[name]
    for name in ("reference", "reference_half", "draws"):
        image = getattr(stored, name)
        if image is not None:
            yield name, image, _LIGHT


def _noisy(samples: int) -> str:
    return f"noisy_{samples}spp"


def _remove_stale(root: Path, name: str, home: Path) -> None:
    """Remove this clip's caches of earlier stamps; maps that other processes hold open stay valid for them."""
    for old in root.glob(f"{glob.escape(name)}.*"):
        if old != home and old.stem == name and old.suffix[1:].isalnum() and len(old.suffix) == 17:
            shutil.rmtree(old, ignore_errors=True)
