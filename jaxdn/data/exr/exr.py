"""One OpenEXR file: named 2-D channels in, named 2-D channels out.

All EXR files are read and written here, because the Python bindings fail silently: they scramble non-contiguous arrays,
turn ``[H, W, 1]`` into R, G, B, overflow float16 to infinity, do not notice a full disk while a file is small, and
print a warning instead of raising an error for a truncated file.
"""

import errno
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from jaxdn.data.errors import ClipError
from jaxdn.data.exr.completeness import check_complete
from jaxdn.data.exr.file import ExrFile, utf8_name
from jaxdn.runtime.atomic_files import atomic_write

HALF_MAX = 65504.0
"""The largest float16."""

_NAME_LIMIT = 255  # longer channel names are cut off silently
_STORABLE = (np.float16, np.float32, np.uint32)
_WRITERS_OWN = ("channels", "chunkCount")  # attributes that the writer makes
_ABOUT_LAYERS = ("cryptomatte", "name", "view")
_LOSSY = (OpenEXR.B44_COMPRESSION, OpenEXR.B44A_COMPRESSION, OpenEXR.DWAA_COMPRESSION, OpenEXR.DWAB_COMPRESSION)


def to_half(values: np.ndarray) -> np.ndarray:
    """float16, finite values clamped to +-65504 instead of overflowing; NaN and infinities stay unchanged."""
    values = np.asarray(values)
    clamped = np.clip(values, -HALF_MAX, HALF_MAX)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.isinf(values), values, clamped).astype(np.float16)


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray]) -> None:
    """Write 2-D channels (float16, float32 or uint32, all of one size) as one ZIP-compressed scanline file.

    The file is written under a temporary name, checked, and then renamed: it is complete or absent. Raises ValueError
    for channels that OpenEXR cannot store and OSError (``errno.ENOSPC`` for a full disk) if the file cannot be written.
    """
    path = Path(path)
    prepared = {name: _storable(path, name, pixels) for name, pixels in channels.items()}
    sizes = {pixels.shape for pixels in prepared.values()}
    if len(sizes) != 1:
        raise ValueError(f"{path}: expected at least one channel and all of one size, got {sorted(sizes)}.")
    _write(path, [({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, prepared)])


def _write(path: Path, parts: Sequence[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> None:
    """Write parts of a header and channels each, see that all is there, and rename; raises OSError as its callers."""
    expected = [len(channels) for _, channels in parts]
    with atomic_write(path) as temporary:
        try:
            # The dicts are changed by the call.
            file = OpenEXR.File([OpenEXR.Part(header, dict(channels)) for header, channels in parts])
            with utf8_name(temporary) as name:
                file.write(name)
        except RuntimeError as error:
            code = errno.ENOSPC if "No space left" in str(error) else errno.EIO
            raise OSError(code, f"could not write the frame ({error})", str(path)) from error
        # The writer does not notice a disk that fills up within the last buffer: the file ends before its last chunk.
        try:
            check_complete(temporary)
            written = [len(header["channels"]) for header in ExrFile(temporary).headers]
        except ClipError as error:
            raise OSError(errno.ENOSPC, "the file is incomplete after writing; is the disk full?", str(path)) from error
        if written != expected:
            raise OSError(errno.EIO, "the file lacks some of its channels after writing", str(path))


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of a file by their full names, 2-D, in the precision they are stored in.

    Of a file with several parts, each channel is named ``part.channel`` unless it already begins with its part's name.
    Subsampled channels are left out. Raises ClipError, naming the file and the reason, if the file is missing, not an
    OpenEXR file, truncated or damaged, or has deep data.
    """
    return ExrFile(path).pixels


def rewrite_exr(
    source: ExrFile, target: str | Path, replaced: Mapping[str, np.ndarray], *, only: Mapping[str, str] | None = None
) -> list[str]:
    """Write a file again with other pixels in some channels, and everything else as it was.

    What stays: parts, the other channels and their order, half or float of each, data and display windows, compression,
    tiles, and all other attributes of the headers. Returns what cannot stay, in sentences. Raises as :func:`read_exr`
    and :func:`write_exr` do.

    Args:
      source: the file.
      target: the file to write.
      replaced: full name of a channel, as :func:`read_exr` gives it -> pixels of the size of its data window.
      only: full name -> new name of the channels to write; None: all. What lies in one part is a file of one part.
    """
    notes: dict[str, None] = {}
    written = []
    several = only is not None and sum(not set(only).isdisjoint(name for name, *_ in p[1]) for p in source.decode()) > 1
    for header, channels in source.decode():
        kept = {}
        for full, name, pixels in channels:
            if pixels is None:
                notes[f"not kept: channel {full!r}, which has less than one value for each pixel"] = None
            elif only is None or full in only:
                pixels = _as_type(replaced[full], pixels.dtype) if full in replaced else pixels
                kept[name if only is None else only[full]] = np.ascontiguousarray(pixels)
        if only is None and header["compression"] in _LOSSY:
            notes["the file's compression loses precision: its other layers are compressed once more"] = None
        gone = _WRITERS_OWN if only is None else (*_WRITERS_OWN, *_ABOUT_LAYERS[: 1 if several else None])
        if kept:
            # "cryptomatte/1a2b3c4/manifest" is about a layer, too
            written.append(({key: value for key, value in header.items() if key.partition("/")[0] not in gone}, kept))
    _write(Path(target), written)
    return list(notes)


def _as_type(pixels: np.ndarray, dtype: np.dtype) -> np.ndarray:
    return to_half(pixels) if dtype == np.float16 else np.asarray(pixels).astype(dtype)


def write_image(path: str | Path, image: np.ndarray) -> None:
    """Write ``[H, W, 3]`` as plain R, G, B in float32. Raises as :func:`write_exr` does."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[-1] != 3 or 0 in image.shape:
        raise ValueError(f"{path}: expected an image [H, W, 3], got shape {image.shape}.")
    write_exr(path, {name: image[..., i].astype(np.float32) for i, name in enumerate("RGB")})


def _storable(path: Path, name: str, pixels: np.ndarray) -> np.ndarray:
    if not name or len(name.encode()) > _NAME_LIMIT:
        raise ValueError(f"{path}: expected a channel name of 1 to {_NAME_LIMIT} bytes, got {name[:40]!r}.")
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or 0 in pixels.shape:
        raise ValueError(f"{path}: channel {name}: expected an array [H, W], got shape {np.shape(pixels)}.")
    if pixels.dtype not in _STORABLE:
        raise ValueError(f"{path}: channel {name}: expected float16, float32 or uint32, got {pixels.dtype}.")
    return np.ascontiguousarray(pixels)
