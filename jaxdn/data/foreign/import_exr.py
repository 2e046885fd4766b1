"""EXR sequences of other renderers: their files, and frames made from them.

Channels are found by their names (:mod:`jaxdn.data.foreign.layers`), motion vectors are converted to our convention
(:mod:`jaxdn.data.foreign.vectors`), and what surfaces reflect is derived where the file brings the parts of it
(:mod:`jaxdn.data.foreign.reflectance`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import BUFFERS, FAR, Buffer, Frame, present
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.exr import read_exr, read_header, read_windows
from jaxdn.data.exr.windows import Window, place, union
from jaxdn.data.foreign.layers import (
    UNSURE_ALBEDO,
    Channels,
    detect_channels,
    is_cryptomatte,
    last_name,
    layer_of,
    unpaired_specular,
)
from jaxdn.data.foreign.lighting import why_light
from jaxdn.data.foreign.measured_motion import fitting_conventions
from jaxdn.data.foreign.reflectance import check_fraction, with_reflectance
from jaxdn.data.foreign.shots import sequence_files
from jaxdn.data.foreign.vectors import (
    UnknownMotion,
    check_convention,
    contradicts_cycles,
    convert_motion,
    dual_of,
    forward_channels,
    forward_of_cycles,
    motion_convention_of,
)
from jaxdn.filters.time_reversal import turned


def plain_frames(
    path: str | Path | Sequence[Path],
    *,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    backwards: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[list[Path], Iterator[Frame]]:
    """The files of another renderer's sequence (or those given), and their frames, each read when it is asked for.

    All frames have the size of the picture and the buffers of the first; frames that store different parts of it (data
    windows) are put into one image. ``motion_convention`` says what the motion vectors mean (a key of
    ``MOTION_CONVENTIONS``) and is needed as soon as there are any that are not Cycles' ``Vector``; ``"none"`` leaves
    them out, as they are of a single image if nothing is stated. The four components of ``Vector`` give dual motion
    vectors too. With ``backwards``, frames come from the last to the first, with time turned around
    (:func:`jaxdn.filters.time_reversal.turned`). ``channels`` and ``layer``: see
    :func:`jaxdn.data.foreign.layers.detect_channels`; what they choose, see
    :func:`jaxdn.data.foreign.sources.sources_of`. ``log`` is called with lines about what is derived or left unused,
    when the first frame is read. Depth is taken for view-space z (0, far and infinite become ``FAR``); ids count from 1
    with 0 for nothing, or are those of a Cryptomatte, and are left out of all frames if they say nothing in the first.
    Normals are expected in world space, roughness linear (GGX alpha is its square).

    Raises ClipError at once where the files are no sequence, and, naming the file, when a frame is asked for that
    cannot be read or differs from the first.
    """
    check_convention(motion_convention)
    files = sequence_files(path) if isinstance(path, str | Path) else list(path)
    return files, _frames(files, motion_convention, channels, layer, backwards, log)


def _frames(
    files: Sequence[Path],
    motion_convention: str | None,
    channels: Mapping[str, str] | None,
    layer: str | None,
    backwards: bool,
    log: Callable[[str], None],
) -> Iterator[Frame]:
    canvas = canvas_of(files)
    first: _First | None = None
    forward: np.ndarray | None = None
    after: Frame | None = None
    # The first file decides for all, so it is read first in either direction.
    for turn, file in enumerate([files[0], *reversed(files)] if backwards else files):
        there = read_placed(file, canvas)
        try:
            # What the first frame decides is decided for all: a lighting pass is light in every frame.
            refused = None if first is None else first.refused
            options: dict[str, Any] = {"channels": channels, "layer": layer, "alone": len(files) == 1}
            chosen = choose(there, motion_convention=motion_convention, refused=refused, **options)
            frame, derived = _frame(file, there, chosen)
        except UnknownMotion as error:
            raise UnknownMotion(f"{file}: {_measured(files, canvas, channels, layer)}{error}") from error
        except ClipError as error:
            raise ClipError(f"{file}: {error}") from error
        before, forward = forward, None
        if chosen.forward:
            frame = frame._replace(dual_motion=dual_of(frame.motion, before))
            forward = forward_of_cycles(np.stack([there[name] for name in chosen.forward], axis=-1))
        if first is None:
            for line in [*chosen.notes, *derived]:
                log(line)
            # Renderers write zeros where nobody asked for ids. Whether all frames do is not known before the last one.
            silent = frame.ids is not None and bool(np.all(frame.ids < 0))
            first = _First(present(frame), silent, chosen.refused)
        _check_like_first(file, frame, first)
        frame = frame._replace(ids=None) if first.silent else frame
        # While the next file is read, nothing of this one is needed: of large frames, memory is what there is least of.
        del there
        if not backwards:
            yield frame
            del frame
        elif turn > 0:
            yield turned(frame, after, forward)
            after = frame


def fitting_files(
    files: Sequence[Path], canvas: Window, *, channels: Mapping[str, str] | None = None, layer: str | None = None
) -> list[str]:
    """The conventions of motion vectors that bring the first two files of a sequence onto each other, best first.

    As :func:`jaxdn.data.foreign.measured_motion.fitting_conventions` measures them; none for a single file.
    ``channels`` and ``layer`` as in :func:`plain_frames`. Raises ClipError for a second file without the channels of
    the first.
    """
    if len(files) < 2:
        return []
    before, now = (read_placed(file, canvas) for file in files[:2])
    found = detect_channels(list(before), channels=channels, layer=layer)
    absent = sorted({channel for each in found.values() for channel in each} - set(now))
    if absent:
        raise ClipError(f"{files[1]}: expected the channels of the first frame, but {', '.join(absent)} are missing.")
    return fitting_conventions(before, now, found)


def _measured(files: Sequence[Path], canvas: Window, channels: Mapping[str, str] | None, layer: str | None) -> str:
    """What the first two frames tell about the convention of their motion vectors, as a line; "" for nothing."""
    fitting = fitting_files(files, canvas, channels=channels, layer=layer)
    if not fitting:
        return ""
    named = " or ".join(f"--motion-convention {name}" for name in fitting)
    return f"{named} fits {files[0].name} and {files[1].name}.\n"


class _First(NamedTuple):
    """What all later frames have in common with the first."""

    buffers: tuple[str, ...]
    silent: bool
    """Its ids say nothing."""
    refused: frozenset[str]


class Chosen(NamedTuple):
    """What is read of a file, from which channels."""

    found: dict[str, Channels]
    """Buffer -> its channels."""
    convention: str | None
    """Of the motion vectors."""
    forward: Channels | None
    """The channels that dual motion vectors are made from, with those of the frame before."""
    refused: frozenset[str]
    """Buffers whose channels turned out to be something else."""
    notes: list[str]
    """What was left unused, and why, in words."""


def choose(
    there: Mapping[str, np.ndarray],
    *,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    refused: frozenset[str] | None = None,
    alone: bool = False,
) -> Chosen:
    """Which channels of a file make up which buffer, by their names and, where a name says too little, by their values.

    A layer called ``diffuse`` that is light (:func:`jaxdn.data.foreign.lighting.why_light`), and a Cryptomatte in half
    precision, are left out and noted. Raises ClipError as :func:`jaxdn.data.foreign.layers.detect_channels` does, for
    motion vectors whose convention nobody has stated, and for light that was named the albedo outright.

    Args:
      there: every channel of the file.
      motion_convention: see :func:`plain_frames`.
      channels: the same.
      layer: the same.
      refused: what an earlier frame of the sequence has decided; None: decide.
      alone: there is no other frame, so motion vectors that nobody has explained are left out and noted.
    """
    stated = channels or {}
    found = detect_channels(list(there), channels=channels, layer=layer)
    convention = motion_convention_of(found, there, motion_convention, alone=alone)
    vectors = found.pop("motion") if convention is None and "motion" in found else None
    decide = refused is None
    notes: dict[str, str] = _something_else(there, found, stated) if decide else {}
    refused = frozenset(notes) if refused is None else refused
    found = {name: channels for name, channels in found.items() if name not in refused}
    if decide and "albedo" in stated and "albedo" in found:
        why = why_light(_stack(there, found["albedo"]), _stack(there, found["radiance"]))
        if why is not None:
            notes["albedo"] = f"taken as you say: {layer_of(found['albedo'])!r}, but it looks like light: {why}"
    if "specular_reflectance" not in stated and (unpaired := unpaired_specular(list(there), found)) is not None:
        notes["specular_reflectance"] = (
            f"not used: {unpaired!r}, as the albedo may have this part in it already; if yours is the diffuse part "
            f"alone, name it: --channels specular_reflectance={unpaired}"
        )
    if vectors is not None and motion_convention is None:
        notes["motion"] = (
            f"not used: {layer_of(vectors)!r}, as nothing says what these vectors mean; a single image needs none"
        )
    if contradicts_cycles(found, there, convention):
        notes["motion"] = (
            f"{layer_of(found['motion'])!r} looks like Blender's, whose convention is 'cycles'; read as stated"
        )
    return Chosen(found, convention, forward_channels(found, there, convention), refused, list(notes.values()))


def _something_else(
    there: Mapping[str, np.ndarray], found: Mapping[str, Channels], stated: Mapping[str, str]
) -> dict[str, str]:
    """Buffers whose channels are not what their names promise, with the reason. Raises ClipError for one named so."""
    notes = {}
    albedo, ids = found.get("albedo"), found.get("ids")
    if albedo is not None and ("albedo" in stated or last_name(albedo) == UNSURE_ALBEDO):
        why = why_light(_stack(there, albedo), _stack(there, found["radiance"]))
        if why is not None and "albedo" not in stated:
            notes["albedo"] = f"not used: {layer_of(albedo)!r} is a lighting pass and no albedo: {why}"
        elif why is not None and "at most" in why:  # who names a layer knows better, except about this
            raise ClipError(
                f"albedo: {layer_of(albedo)!r} is no albedo: {why}; name another, or --channels albedo=none."
            )
    if ids is not None and is_cryptomatte(ids) and there[ids[0]].dtype != np.float32:
        notes["ids"] = f"not used: {layer_of(ids)!r}, as half precision has destroyed the ids in it"
    return notes


def canvas_of(files: Sequence[Path]) -> Window:
    """The pixels that a sequence has: the union of its data windows, from the headers alone.

    Raises ClipError for files whose pictures (display windows) differ. A file that cannot be read is left out here; it
    is an error when its frame is read.
    """
    windows: list[Window] = []
    picture: Window | None = None
    for file in files:
        try:
            display, found = read_windows(file)
        except ClipError:
            continue
        picture = picture or display
        if display != picture:
            raise ClipError(
                f"{file}: expected {picture.size[1]} x {picture.size[0]} pixels as in the first frame, "
                f"got {display.size[1]} x {display.size[0]}."
            )
        windows += found.values()
    return union(windows) if windows else Window(0, 0, 0, 0)


def read_placed(file: Path, canvas: Window) -> dict[str, np.ndarray]:
    """Every channel of a file as an image of the canvas; 0 where it has none."""
    there = read_exr(file)
    _, windows = read_windows(file)
    return {name: place(pixels, windows[name], canvas) for name, pixels in there.items()}


def _frame(file: Path, there: Mapping[str, np.ndarray], chosen: Chosen) -> tuple[Frame, list[str]]:
    """One frame, and in words what was derived, or left unused."""
    found = chosen.found
    buffers = {name: _converted(name, _stack(there, found[name]), found[name], chosen.convention) for name in found}
    for name in {"roughness", "specular_reflectance"} & set(found):
        buffers[name] = check_fraction(name, layer_of(found[name]), buffers[name])
    frame, derived = with_reflectance(Frame(**buffers), found, there, lambda: read_header(file))
    return frame, [] if derived is None else [derived]


def _stack(there: Mapping[str, np.ndarray], channels: Channels) -> np.ndarray:
    return np.stack([there[channel] for channel in channels], axis=-1)


def _converted(name: str, image: np.ndarray, channels: Channels, convention: str | None) -> np.ndarray:
    """One of their buffers as ours."""
    buffer: Buffer = BUFFERS[name]
    if buffer.kind == "id":
        if is_cryptomatte(channels):  # the bits of a hash; 0 is nothing
            bits = np.ascontiguousarray(image).view(np.uint32) & np.uint32(0x7FFFFFFF)
            return np.where(bits == 0, -1, bits.astype(np.int64)).astype(np.int32)
        ids = np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        return (np.clip(np.rint(ids), 0, 2**31 - 1) - 1).astype(np.int32)
    image = image.astype(buffer.dtype)
    if buffer.kind == "vector" and convention is not None:
        return convert_motion(image, convention)
    if buffer.kind == "distance":
        image = np.abs(image)  # some cameras look along -z
        # Where there is nothing, programs write 0, infinity or a large number.
        return np.where(np.isfinite(image) & (image > 0) & (image < FAR), image, np.float32(FAR))
    return image


def _check_like_first(file: Path, frame: Frame, first: _First) -> None:
    differing = sorted(set(present(frame)) ^ set(first.buffers))
    if differing:
        raise ClipError(f"{file}: expected the same buffers as in the first frame, but {', '.join(differing)} differs.")
