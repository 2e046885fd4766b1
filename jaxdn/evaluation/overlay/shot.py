"""Measure a shot, and write what was found: EXR layers beside each other, and one page."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.data.errors import ClipError, DamagedFile
from jaxdn.data.exr.exr import to_half, write_exr
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import CAMERA_SPACE, MappedBuffer
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.data.foreign.layers import last_name, stack_channels
from jaxdn.evaluation.overlay.findings import Finding, Known, find_all
from jaxdn.evaluation.overlay.geometry import Space
from jaxdn.evaluation.overlay.measure import FrameOverlay, Measurer
from jaxdn.evaluation.overlay.page import overlay_page
from jaxdn.evaluation.overlay.views import draw_views
from jaxdn.evaluation.report.film import FRAMES, encode_webp
from jaxdn.runtime.atomic_files import write_atomically

PAGE = "overlay.html"
PICTURES = 24_000_000
"""Bytes of pictures in one page; frames beyond have figures and EXR layers alone."""


class Overlay(NamedTuple):
    """What was written of a shot, and found in it."""

    page: Path
    findings: list[Finding]


@dataclass
class _Films:
    """Pictures of the first frames, as many as a page takes."""

    views: dict[str, list[bytes | None]] = field(default_factory=dict)
    frames: int = 0
    size: int = 0

    def add(self, frame: Frame, overlay: FrameOverlay) -> None:
        """The pictures of one more frame, while there is room."""
        if self.frames == FRAMES or self.size > PICTURES:
            return
        drawn = {name: encode_webp(picture) for name, picture in draw_views(frame, overlay.layers).items()}
        for name in (*self.views, *(name for name in drawn if name not in self.views)):
            film = self.views.setdefault(name, [None] * self.frames)
            film.append(drawn.get(name))
        self.frames += 1
        self.size += sum(map(len, drawn.values()))


def write_overlay(
    files: Sequence[ExrFile],
    naming: ChannelNaming,
    mapping: Sequence[MappedBuffer],
    out: Path,
    *,
    title: str,
    convention: str | None = None,
    unusable: Mapping[str, str] | None = None,
    missing: str = "",
    breaks: Collection[Path] = (),
    unexplained: Sequence[str] | None = None,
    on_frame: Callable[[Path], object] = lambda path: None,
) -> Overlay:
    """Write ``out/NAME.exr`` for each frame and ``out/overlay.html``; returns what was found.

    A file that cannot be decoded is a frame that differs; the history begins anew after it. Raises ValueError for a
    folder that the shot is read from, and ClipError as
    :meth:`jaxdn.data.foreign.import_exr.ForeignSequence.frames` does.

    Args:
      files: of the shot, those that can be its frames.
      naming: what is stated about the channels.
      mapping: what is read from which channels.
      out: the folder to write into.
      title: of the page.
      convention: of the motion vectors.
      unusable: file -> why it is no frame.
      missing: numbers of frames that are missing, in words.
      breaks: files whose frame before is not there: they have no history.
      unexplained: of vectors whose convention nobody has stated, the conventions that fit; they are left out. None:
        there are no such vectors.
      on_frame: called with each file of layers that was written.
    """
    if any(path.resolve().parent == out.resolve() for file in files for path in file.paths):
        raise ValueError(f"--overlay {out}: expected another folder than that of the shot; name one of its own.")
    out.mkdir(parents=True, exist_ok=True)
    unusable = dict(unusable or {})
    naming = naming if unexplained is None else replace(naming, motion_convention="none")
    kept = {mapped.buffer: mapped.channels for mapped in mapping if mapped.buffer in ("albedo", "depth")}
    space = _space_of_normals(mapping)
    measurer, films = Measurer(), _Films()
    names: list[str] = []
    figures: list[dict[str, float]] = []
    for file, frame, header, stored in _read(files, naming, kept, unusable, measurer.restart):
        if file.path in breaks:
            measurer.restart()
        overlay = measurer.add(label_file(file.path), frame, header=header, stored=stored, space=space)
        films.add(frame, overlay)
        path = out / Path(label_file(file.path).replace("/", "_")).with_suffix(".exr")
        _write_layers(path, overlay.layers)
        names.append(overlay.name)
        figures.append(overlay.figures)
        on_frame(path)
    if not names:
        raise ClipError(f"{title}: expected frames that can be read, found none.")
    layers = {mapped.buffer: mapped.layer for mapped in mapping}
    findings = find_all(names, figures, Known(convention, unusable, missing, unexplained, layers))
    facts = {mapped.buffer: f"{mapped.layer} ({', '.join(mapped.channels)}): {mapped.convention}" for mapped in mapping}
    page = overlay_page(title, names, figures, findings, films.views, facts)
    write_atomically({out / PAGE: page.encode("utf-8", "replace")})
    return Overlay(out / PAGE, findings)


def _space_of_normals(mapping: Sequence[MappedBuffer]) -> Space:
    """What normals are taken for. The worlds of Unreal and pbrt are left-handed."""
    normals = next((mapped for mapped in mapping if mapped.buffer == "normal"), None)
    if normals is None or normals.convention == CAMERA_SPACE:
        return "camera"
    name = last_name(normals.channels)
    return "either world" if name == "ns" or "worldnormal" in name else "world"


def _read(
    files: Sequence[ExrFile],
    naming: ChannelNaming,
    kept: Mapping[str, tuple[str, ...]],
    unusable: dict[str, str],
    restart: Callable[[], None],
) -> Iterator[tuple[ExrFile, Frame, Mapping[str, Any], dict[str, np.ndarray]]]:
    """The frames, with their files' headers and the ``kept`` buffers as stored; damaged ones get into ``unusable``."""
    left = list(files)
    while left:
        sequence = ForeignSequence(left, naming)
        reader = sequence.frames(keep_pixels=True)
        for index, file in enumerate(left):
            try:
                frame = next(reader)
            except DamagedFile as error:
                unusable[label_file(file.path)] = error.reason
                left = left[index + 1 :]
                restart()
                break
            pixels = file.placed(sequence.window)
            yield file, frame, file.header, {name: stack_channels(pixels, kept[name]) for name in kept}
            file.drop()
        else:
            return


_LETTERS = {1: "Y", 2: "XY", 3: "RGB"}


def _write_layers(path: Path, layers: Mapping[str, np.ndarray]) -> None:
    """Each layer in half precision, ``noise.Y``, ``motion.X`` ..."""
    channels = {
        f"{name}.{letter}": to_half(np.asarray(image[..., index], np.float32))
        for name, image in layers.items()
        for index, letter in enumerate(_LETTERS[image.shape[-1]])
    }
    write_exr(path, channels)
