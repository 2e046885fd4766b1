"""Is an OpenEXR file all there? Told by its size and the places of its chunks, without decoding them.

Layout: https://openexr.com/en/latest/OpenEXRFileLayout.html. After the headers lies a table of the offsets of all
chunks, and then the chunks. A file that was cut off ends before its last chunk; one that is still written has offsets
of 0.
"""

import struct
from pathlib import Path
from typing import BinaryIO

from jaxdn.data.errors import DamagedFile

_MAGIC = 20000630
_TILED, _DEEP, _PARTS = 0x200, 0x800, 0x1000
"""Bits of the version field."""
_REMEDY = "write the frame again"


def check_complete(path: Path) -> None:
    """Raise DamagedFile, naming the file, if it has no bytes, is no OpenEXR file, or lacks some of its chunks."""
    size = path.stat().st_size
    if size == 0:
        raise DamagedFile(path, "the file is empty (0 bytes), as a placeholder of a frame that is not rendered yet")
    try:
        with path.open("rb") as file:
            end = _find_end(file)
    except (struct.error, UnicodeDecodeError, ValueError):
        end = None
    if end is None or end > size:
        raise DamagedFile(path, f"the file is incomplete, or not an OpenEXR file; {_REMEDY}")


def _find_end(file: BinaryIO) -> int | None:
    """Where the last chunk ends, in bytes; None for a file whose table of chunks is incomplete. 0 for deep data.

    Raises struct.error or ValueError where the file ends before.
    """
    magic, version = _read(file, "<II")
    if magic != _MAGIC:
        return None
    if version & _DEEP:
        return 0  # not read anyway
    tiled = _read_headers(file, several=bool(version & _PARTS))
    if version & _TILED:
        tiled = [True]
    last, first = 0, None
    while first is None or file.tell() < first:  # the table ends where the first chunk begins
        (offset,) = _read(file, "<Q")
        if offset == 0:
            return None
        last, first = max(last, offset), min(first or offset, offset)
    file.seek(last)
    part = _read(file, "<i")[0] if version & _PARTS else 0
    if not 0 <= part < len(tiled):
        return None
    *_, stored = _read(file, "<iiiii" if tiled[part] else "<ii")
    return file.tell() + int(stored)


def _read_headers(file: BinaryIO, *, several: bool) -> list[bool]:
    """Read past the headers; whether each part has tiles."""
    tiled: list[bool] = []
    while True:
        attributes = {}
        while name := _read_text(file):
            kind = _read_text(file)
            (size,) = _read(file, "<i")
            value = file.read(size)
            if size < 0 or len(value) < size:
                raise ValueError(f"{kind} is cut off")
            attributes[name] = value
        if several and not attributes:
            return tiled
        tiled.append(attributes.get("type") == b"tiledimage")
        if not several:
            return tiled


def _read_text(file: BinaryIO) -> str:
    """A text that ends with a zero byte."""
    letters = bytearray()
    while (letter := file.read(1)) != b"\0":
        if not letter or len(letters) > 255:
            raise ValueError("no text")
        letters += letter
    return letters.decode("utf-8", "replace")


def _read(file: BinaryIO, layout: str) -> tuple[int, ...]:
    return struct.unpack(layout, file.read(struct.calcsize(layout)))
