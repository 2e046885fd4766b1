"""EXR sequences of other renderers: their files, and frames made from them.

Channels are found by their names (:mod:`jaxdn.data.foreign.layers`), motion vectors are converted to our convention
(:mod:`jaxdn.data.foreign.vectors`), and what surfaces reflect is derived where the file brings the parts of it
(:mod:`jaxdn.data.foreign.reflectance`).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from jaxdn.core.frame import BUFFERS, FAR, UNNUMBERED, Buffer, Frame
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.file import ExrFile, Window, union_of
from jaxdn.data.foreign.classify import ChannelMapping, ChannelNaming, classify_channels
from jaxdn.data.foreign.decisions import Decisions
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.data.foreign.layers import Channels, is_cryptomatte, layer_of, stack_channels
from jaxdn.data.foreign.measured_motion import fitting_conventions
from jaxdn.data.foreign.reflectance import derive_reflectance
from jaxdn.data.foreign.repairs import FRACTIONS, Repairs
from jaxdn.data.foreign.shot_files import find_sequence
from jaxdn.data.foreign.vectors import UnknownMotion, convert_cycles_forward, convert_motion, derive_dual_motion
from jaxdn.data.foreign.views import open_views, select_view
from jaxdn.filters.time_reversal import reverse_time

_LARGEST_UNION = 4
"""Pixels of a shot's frames as a multiple of the picture's, or of the largest data window's."""


def plain_frames(
    path: str | Path | Sequence[Path],
    *,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    view: str | None = None,
    backwards: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[list[Path], Iterator[Frame]]:
    """The files of another renderer's sequence (or those given), and their frames, each read when it is asked for.

    All frames have the size of the picture and the buffers of the first; frames that store different parts of it (data
    windows) are put into one image. ``motion_convention`` says what the motion vectors mean (a key of
    ``MOTION_CONVENTIONS``) and is needed as soon as there are any that are not Cycles' ``Vector``; ``"none"`` leaves
    them out, as they are of a single image if nothing is stated. The four components of ``Vector`` give dual motion
    vectors too. With ``backwards``, frames come from the last to the first, with time turned around
    (:func:`jaxdn.filters.time_reversal.reverse_time`). ``channels`` and ``layer``: see
    :func:`jaxdn.data.foreign.layers.detect_channels`; what they choose, see
    :func:`jaxdn.data.foreign.channel_mapping.read_channel_mapping`. Of files with several views (stereo), ``view`` is
    read, by default the first (:mod:`jaxdn.data.foreign.views`). ``log`` is called with lines about what is derived
    or left unused, when the first frame is read. Depth is taken for view-space z (0, far and infinite become ``FAR``);
    ids count from 1, 0 is nothing or a surface that has no number (:func:`_mark_unnumbered`), or they are those of a
    Cryptomatte. A buffer in which no frame has had anything yet
    is left out (:mod:`jaxdn.data.foreign.decisions`); values that are no fractions are clamped and counted
    (:mod:`jaxdn.data.foreign.repairs`). Normals are expected in world space, roughness linear (GGX alpha is its
    square).

    Raises ClipError at once where the files are no sequence, and, naming the file, when a frame is asked for that
    cannot be read or differs from the first.
    """
    naming = ChannelNaming(motion_convention, channels, layer, view)
    if isinstance(path, str | Path):
        (shot,) = select_view([find_sequence(path, naming.pass_files)], view)
        opened = next(iter(open_views(shot, view).values()))
    else:
        opened = tuple(ExrFile(file) for file in path)
    return [file.path for file in opened], ForeignSequence(opened, naming).frames(backwards=backwards, log=log)


class ForeignSequence:
    """Consecutive frames of another renderer; each file is decoded when its frame is read."""

    def __init__(self, files: Sequence[ExrFile], naming: ChannelNaming) -> None:
        self.files, self.naming = files, naming
        self.repairs = Repairs()
        self._decisions = Decisions()
        self._named: tuple[str, ...] | None = None
        self._told: set[str] = set()
        self._lacks_motion = False

    @cached_property
    def window(self) -> Window:
        """The pixels that the frames have: the union of their data windows, from the headers alone.

        Raises ClipError for files whose pictures (display windows) differ, and for a window that lies so far away that
        the union would be many times the picture. A file that cannot be read is left out
        here; it is an error when its frame is read.
        """
        windows: dict[Window, Path] = {}
        picture: Window | None = None
        for file in self.files:
            try:
                display, stored = file.display, set(file.windows.values())
            except ClipError:
                continue
            picture = picture or display
            if display != picture:
                raise ClipError(
                    f"{file.path}: expected {picture.size[1]} x {picture.size[0]} pixels as in the first frame, "
                    f"got {display.size[1]} x {display.size[0]}."
                )
            windows = dict.fromkeys(stored, file.path) | windows
            file.drop_windows()
        if picture is None:
            return Window(0, 0, 0, 0)
        union = union_of(windows)
        _check_union(union, windows, picture)
        return union

    @property
    def lacks_motion(self) -> bool:
        """Whether the frame that was read last has no motion: there are no vectors, or they were 0 everywhere so far.

        Not where none are to be read (``motion_convention="none"``).
        """
        return self._lacks_motion and self.naming.motion_convention != "none"

    def frames(
        self,
        *,
        backwards: bool = False,
        keep_pixels: bool = False,
        log: Callable[[str], None] = lambda line: None,
    ) -> Iterator[Frame]:
        """The frames as :func:`plain_frames` describes them.

        With ``keep_pixels``, the file of a frame that is given stays decoded until the caller drops it.
        """
        self.repairs.restart()
        forward: np.ndarray | None = None
        after: Frame | None = None
        # The first file says which buffers all have, so it is read first in either direction.
        for turn, file in enumerate([self.files[0], *reversed(self.files)] if backwards else self.files):
            before = forward
            frame, lines, forward = self._read(file, before)
            for line in lines:
                log(line if file is self.files[0] else f"{label_file(file.path)}: {line}")
            # Of large frames, memory is what there is least of.
            if not keep_pixels:
                file.drop()
            if not backwards:
                yield frame
                del frame
            elif turn > 0:
                yield reverse_time(frame, after, forward)
                after = frame

    def fitting_conventions(self) -> list[str]:
        """The conventions of motion vectors that bring the first two files onto each other, best first.

        As :func:`jaxdn.data.foreign.measured_motion.fitting_conventions` measures them; none for a single file. Raises
        ClipError for a second file without the channels of the first.
        """
        if len(self.files) < 2:
            return []
        before, now = (file.placed(self.window) for file in self.files[:2])
        buffers = self.naming.detect(list(before))
        absent = sorted({channel for channels in buffers.values() for channel in channels} - set(now))
        if absent:
            missing = f"expected the channels of the first frame, but {', '.join(absent)} are missing."
            raise ClipError(f"{self.files[1].path}: {missing}")
        return fitting_conventions(before, now, buffers)

    def _read(self, file: ExrFile, forward: np.ndarray | None) -> tuple[Frame, list[str], np.ndarray | None]:
        """A frame, what was derived or left out in words, and its forward displacement; that of the frame before."""
        pixels = file.placed(self.window)
        try:
            single = len(self.files) == 1
            mapping = classify_channels(pixels, self.naming, decisions=self._decisions, single=single)
            if self._named is None:
                self._named = mapping.named
            _check_like_first(mapping.named, self._named)
            frame, derived = _make_frame(file, pixels, mapping, self.repairs)
            self._lacks_motion = frame.motion is None
        except UnknownMotion as error:
            raise UnknownMotion(f"{file.path}: {self._advise_convention()}{error}") from error
        except ClipError as error:
            raise ClipError(f"{file.path}: {error}") from error
        said = [*mapping.notes, *derived]
        lines = [*(line for line in said if line not in self._told), *self.repairs.news()]
        self._told.update(said)
        if mapping.forward is None:
            return frame, lines, None
        frame = frame._replace(dual_motion=derive_dual_motion(np.asarray(frame.motion), forward))
        return frame, lines, convert_cycles_forward(stack_channels(pixels, mapping.forward))

    def _advise_convention(self) -> str:
        """What the first two frames tell about the convention of their motion vectors, as a line; "" for nothing."""
        try:
            fitting = self.fitting_conventions()
        except ClipError:  # the second file is told of when its turn comes
            return ""
        if not fitting:
            return ""
        named = " or ".join(f"--motion-convention {name}" for name in fitting)
        return f"{named} fits {label_file(self.files[0].path)} and {label_file(self.files[1].path)}.\n"


def _make_frame(
    file: ExrFile, pixels: Mapping[str, np.ndarray], mapping: ChannelMapping, repairs: Repairs
) -> tuple[Frame, list[str]]:
    """One frame, and in words what was derived, or left unused."""
    buffers = {}
    for name, channels in mapping.buffers.items():
        values = stack_channels(pixels, channels)
        if BUFFERS[name].kind == "distance" and name != "specular_hit_distance":  # there NaN is unknown, as 0 is
            values = repairs.replace_nan(name, layer_of(channels), values)
        buffers[name] = _converted(name, values, channels, mapping.convention)
    for name in set(FRACTIONS) & set(buffers):
        buffers[name] = repairs.clamp(name, layer_of(mapping.buffers[name]), buffers[name])
    if "ids" in buffers and not is_cryptomatte(mapping.buffers["ids"]):
        buffers["ids"] = _mark_unnumbered(buffers["ids"], buffers.get("depth"), buffers.get("normal"))
    frame, derived = derive_reflectance(Frame(**buffers), mapping.buffers, pixels, file.header, repairs)
    return frame, [] if derived is None else [derived]


def _converted(name: str, image: np.ndarray, channels: Channels, convention: str | None) -> np.ndarray:
    """One of their buffers as ours."""
    buffer: Buffer = BUFFERS[name]
    if buffer.kind == "id":
        if is_cryptomatte(channels):  # the bits of a hash; 0 is nothing
            bits = np.ascontiguousarray(image).view(np.uint32) & np.uint32(0x7FFFFFFF)
            return np.where(bits == 0, -1, bits.astype(np.int64)).astype(np.int32)
        ids = np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        return (np.clip(np.rint(ids), 0, 2**31 - 1) - 1).astype(np.int32)
    image = image.astype(buffer.dtype, copy=False)
    if buffer.kind == "vector" and convention is not None:
        return convert_motion(image, convention)
    if buffer.kind == "distance":
        if name == "specular_hit_distance":  # here 0 is unknown, and not far away
            return np.clip(np.nan_to_num(image, posinf=FAR, neginf=0), 0, np.float32(FAR))
        image = np.abs(image)  # some cameras look along -z
        # Where there is nothing, programs write 0, infinity or a large number.
        return np.where(np.isfinite(image) & (image > 0) & (image < FAR), image, np.float32(FAR))
    return image


def _check_union(union: Window, windows: Mapping[Window, Path], picture: Window) -> None:
    """Raise ClipError, naming the file, where the union of data windows is far larger than the picture and each window.

    With overscan of half the picture on every side it is four times as large.
    """
    if math.prod(union.size) <= _LARGEST_UNION * max(math.prod(each.size) for each in (picture, *windows)):
        return

    def distance(window: Window) -> int:
        return max(abs(end - other) for end, other in zip(window, picture, strict=True))

    odd = max(windows, key=distance)
    (height, width), (rows, columns) = picture.size, union.size
    raise ClipError(
        f"{windows[odd]}: expected a data window near the picture of {width} x {height} pixels, got {tuple(odd)}: all "
        f"frames would have {columns} x {rows} pixels; leave the file out, or write it again."
    )


def _mark_unnumbered(ids: np.ndarray, depth: np.ndarray | None, normal: np.ndarray | None) -> np.ndarray:
    """The ids [H, W, 1] with :data:`UNNUMBERED` in place of -1 where there is a surface.

    Blender's objects have the index 0 until somebody numbers them. Where there is a surface, depth tells, or normals,
    which are 0 where nothing is. Where neither is there, all counts as a surface: filters leave out what is none.
    """
    surface = np.ones(ids.shape, bool)
    if depth is not None:
        surface = depth < np.float32(FAR)
    elif normal is not None:
        surface = np.any(normal != 0, axis=-1, keepdims=True)
    return np.where((ids < 0) & surface, np.int32(UNNUMBERED), ids)


def _check_like_first(named: tuple[str, ...], first: tuple[str, ...]) -> None:
    differing = sorted(set(named) ^ set(first))
    if differing:
        raise ClipError(f"expected the same buffers as in the first frame, but {', '.join(differing)} differs.")
