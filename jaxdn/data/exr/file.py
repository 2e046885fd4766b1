"""One OpenEXR file to read: names and windows from its headers, pixels when they are asked for, both at most once.

Data and display windows say which pixels of the picture a file, or a part of it, has. A renderer may store less than
the picture (a region, a cropped bounding box that differs from frame to frame) or more (overscan). All frames of a
sequence are placed into the union of their data windows, so that motion vectors mean the same in each of them.
"""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import OpenEXR

from jaxdn.data.errors import ClipError, DamagedFile

_SIDE_LIMIT = 1 << 16  # a larger size in a header counts as damaged, before memory is allocated for it
_LATLONG = 0
"""The value of the attribute ``envmap`` for a panorama; 1 is a cube."""
_UNREADABLE = (RuntimeError, ValueError, KeyError, IndexError, TypeError, MemoryError, UnicodeDecodeError)
_T = TypeVar("_T")


class Window(NamedTuple):
    """A rectangle of pixels; its ends count, as in OpenEXR."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top + 1, self.right - self.left + 1

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """As an attribute of a header."""
        return np.array([self.left, self.top], np.int32), np.array([self.right, self.bottom], np.int32)


def window_of(header: Mapping[str, Any], name: str) -> Window:
    """The ``dataWindow`` or ``displayWindow`` of a header."""
    low, high = header[name]
    return Window(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def union_of(windows: Iterable[Window]) -> Window:
    """The smallest window that has all of them in it."""
    left, top, right, bottom = zip(*windows, strict=True)
    return Window(min(left), min(top), max(right), max(bottom))


def place(pixels: np.ndarray, window: Window, union: Window) -> np.ndarray:
    """Pixels [H, W, ...] of a window as an image of a union that contains it; 0 elsewhere.

    The pixels themselves where the window is the union.
    """
    if window == union:
        return pixels
    image = np.zeros((*union.size, *pixels.shape[2:]), pixels.dtype)
    image[_inside(window, union)] = pixels
    return image


def crop(image: np.ndarray, union: Window, window: Window) -> np.ndarray:
    """The pixels of a window that lies in the union, from an image of the union."""
    return image[_inside(window, union)]


def _inside(window: Window, union: Window) -> tuple[slice, slice]:
    height, width = window.size
    top, left = window.top - union.top, window.left - union.left
    return slice(top, top + height), slice(left, left + width)


class ExrPart(NamedTuple):
    """One part of a file."""

    header: dict[str, Any]
    channels: list["ExrChannel"]


class ExrChannel(NamedTuple):
    """One channel of a part."""

    full_name: str
    """Unique in the file: ``part.channel``, or the own name if the file has one part or it begins with the part's."""
    name: str
    """Within its part."""
    pixels: np.ndarray | None
    """[H, W] in the precision it is stored in; None if it is subsampled."""


class ExrFile:
    """A file that is opened once for its headers and once for its pixels, and only if somebody asks for them.

    The headers are checked before the pixels are decoded, and are those of the decoded parts afterwards. Pixels stay in
    memory until :meth:`drop`. Everything raises ClipError, naming the file and the reason, if the file is missing, not
    an OpenEXR file, truncated or damaged, or has deep data or a mipmap. Subsampled channels are not offered.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._sound = False
        self._latlong = False
        self._parts: list[ExrPart] | None = None
        self._headers: list[dict[str, Any]] | None = None
        self._layout: tuple[Window, dict[str, Window]] | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that are read: this one."""
        return (self.path,)

    @property
    def beside(self) -> frozenset[str]:
        """The channels that lie in other files than the one at :attr:`path`: none."""
        return frozenset()

    @property
    def is_panorama(self) -> bool:
        """Whether the attribute ``envmap`` says that the picture is an equirectangular panorama."""
        if not self._sound:
            self._read_headers()
        return self._latlong

    @property
    def display(self) -> Window:
        """The display window: the picture."""
        return self._read_layout()[0]

    @property
    def windows(self) -> dict[str, Window]:
        """Full name of each channel -> its data window."""
        return self._read_layout()[1]

    def decode(self) -> list[ExrPart]:
        """The parts with their pixels, in the order of the file."""
        if self._parts is None:
            if not self._sound:
                self._read_headers()
            self._parts = _open(self.path, lambda file: _decode(self.path, file))
        return self._parts

    @property
    def pixels(self) -> dict[str, np.ndarray]:
        """Full name of each channel -> its pixels. Raises ClipError if there are none."""
        found = {name: pixels for part in self.decode() for name, _, pixels in part.channels if pixels is not None}
        if not found:
            raise ClipError(f"{self.path}: the file has no channels.")
        return found

    @property
    def headers(self) -> list[dict[str, Any]]:
        """The attributes of each part."""
        if self._parts is not None:
            return [part.header for part in self._parts]
        if self._headers is None:
            self._headers = self._read_headers()
        return self._headers

    def full_name(self, name: str) -> str:
        """The name that a channel has in :meth:`decode`: this one."""
        return name

    @property
    def header(self) -> dict[str, Any]:
        """The attributes of the first part, such as ``worldToCamera``."""
        return self.headers[0]

    def placed(self, window: Window) -> Mapping[str, np.ndarray]:
        """The channels as images of a window that holds theirs; 0 where the file has no pixel."""
        return _Placed(self.pixels, self.windows, window)

    def drop(self) -> None:
        """Forget all that was read; it is read again if somebody asks for it."""
        self._parts = self._layout = self._headers = None

    def drop_windows(self) -> None:
        """Forget the windows alone: of a thousand files they take memory too."""
        self._layout = None

    def _read_layout(self) -> tuple[Window, dict[str, Window]]:
        if self._layout is None:
            headers = self.headers
            self._layout = (
                window_of(headers[0], "displayWindow"),
                {
                    full_name(header, channel.name, len(headers)): window_of(header, "dataWindow")
                    for header in headers
                    for channel in header["channels"]
                    if (channel.xSampling, channel.ySampling) == (1, 1)
                },
            )
            self._headers = None  # a Cryptomatte's manifest is large
        return self._layout

    def _read_headers(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            raise DamagedFile(self.path, "there is no such file")
        headers = _open(self.path, lambda file: [dict(part.header) for part in file.parts], header_only=True)
        if not headers:
            raise DamagedFile(self.path, "the file has no parts; write the frame again")
        for header in headers:
            _check_header(self.path, header)
        envmap: Any = headers[0].get("envmap")  # an enumeration, or a number
        self._latlong = envmap is not None and int(getattr(envmap, "value", envmap)) == _LATLONG
        self._sound = True
        return headers


class _Placed(Mapping[str, np.ndarray]):
    """The channels of a file as images of one window, each placed when it is looked up."""

    def __init__(self, pixels: Mapping[str, np.ndarray], windows: Mapping[str, Window], window: Window) -> None:
        self._pixels, self._windows, self._window = pixels, windows, window

    def __getitem__(self, name: str) -> np.ndarray:
        return place(self._pixels[name], self._windows[name], self._window)

    def __iter__(self) -> Iterator[str]:
        return iter(self._pixels)

    def __len__(self) -> int:
        return len(self._pixels)


@contextmanager
def utf8_name(path: Path) -> Iterator[str]:
    """The name of a file to read or to write, as the bindings want it: in UTF-8.

    Names on Linux are any bytes; those of another encoding are given as a link, for as long as the block lasts.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory(prefix="jaxdn-") as folder:
            link = Path(folder, "link.exr")
            link.symlink_to(path.absolute())
            yield str(link)
    else:
        yield str(path)


def _open(path: Path, read: Callable[[Any], _T], **options: Any) -> _T:
    """What ``read`` makes of the opened file, with the errors of the bindings in words."""
    try:
        with utf8_name(path) as name, OpenEXR.File(name, separate_channels=True, **options) as file:
            return read(file)
    except ClipError:
        raise
    except _UNREADABLE as error:
        raise DamagedFile(path, f"not readable as OpenEXR ({error}); write the frame again") from error


def _decode(path: Path, file: Any) -> list[ExrPart]:
    if not file.parts:
        raise DamagedFile(path, "the pixel data is truncated or damaged; write the frame again")
    parts = []
    for part in file.parts:
        channels = []
        for name, channel in part.channels.items():
            pixels = channel.pixels
            if (channel.xSampling, channel.ySampling) != (1, 1):
                pixels = None
            elif not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype == object:
                raise ClipError(
                    f"{path}: channel {name} is not a flat image; deep data cannot be read; save it flattened."
                )
            channels.append(ExrChannel(full_name(part.header, name, len(file.parts)), name, pixels))
        parts.append(ExrPart(dict(part.header), channels))
    return parts


def _check_header(path: Path, header: Mapping[str, Any]) -> None:
    window = header.get("dataWindow")
    if not isinstance(window, tuple) or len(window) != 2:
        raise DamagedFile(path, "the header has no data window; the file is damaged")
    low, high = (np.asarray(corner, np.int64) for corner in window)
    sides = high - low + 1
    tiles = header.get("tiles")
    if tiles is not None and tiles.mode != OpenEXR.ONE_LEVEL:
        raise ClipError(f"{path}: tiles in several levels (a mipmap) cannot be read; save it with one level.")
    try:
        names = {channel.name for channel in header.get("channels", ())}
    except UnicodeDecodeError as error:
        raise DamagedFile(path, "a channel has a name that is not in UTF-8; write the frame with another") from error
    if {"RY", "BY"} <= names:
        raise ClipError(f"{path}: luminance with chroma (Y, RY, BY) cannot be read; save it with R, G, B.")
    if sides.min() < 1 or sides.max() > _SIDE_LIMIT:
        raise DamagedFile(path, f"the header claims {sides[0]} x {sides[1]} pixels; the file is damaged")


def full_name(header: Mapping[str, object], name: str, parts: int) -> str:
    """The name of a channel that no other of a file of so many parts has."""
    part = str(header.get("name", ""))
    return name if parts == 1 or not part or name == part or name.startswith(part + ".") else f"{part}.{name}"
