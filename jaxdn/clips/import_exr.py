"""EXR sequences of other renderers: their files, frames, and which way their motion vectors point.

Channels are found by their names (:mod:`jaxdn.clips.layers`). Motion vectors differ in direction, unit and axes from
one program to the next, and nothing in the file says which: unless the layer is Cycles' own four-component ``Vector``,
the caller says so. What surfaces reflect is derived where the file brings the parts of it
(:mod:`jaxdn.clips.reflectance`).
"""

import glob
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.clips.exr import read_exr, read_header
from jaxdn.clips.files import ClipError
from jaxdn.clips.layers import Channels, detect_channels, layer_of, unpaired_specular
from jaxdn.clips.reflectance import check_fraction, with_reflectance
from jaxdn.frame import BUFFERS, FAR, Buffer, Frame, present

MOTION_CONVENTIONS: dict[str, str] = {
    "previous-current": "pixels, previous minus current position, y down (ours; NTASD, Zeng et al., SVGF)",
    "current-previous": "pixels, current minus previous position, y down (OptiX flow)",
    "cycles": "pixels, previous minus current position, y up (Blender's Vector pass, first two components)",
    "uv": "fractions of the image, previous minus current, y down (Falcor, NRD, DLSS scaled to [-1, 1])",
    "ndc": "clip space [-1, 1], previous minus current, y up",
    "rows-columns": "pixels, previous minus current, (row, column) order (Noisebase)",
}
"""What ``motion_convention`` may be, in words."""


def convert_motion(motion: np.ndarray, convention: str) -> np.ndarray:
    """Motion vectors ``[H, W, 2]`` of one of ``MOTION_CONVENTIONS`` in ours. Raises ClipError for another name."""
    height, width = motion.shape[:2]
    if convention == "rows-columns":
        return motion[..., ::-1]
    scales: dict[str, tuple[float, float]] = {
        "previous-current": (1, 1),
        "current-previous": (-1, -1),
        "cycles": (1, -1),
        "uv": (width, height),
        "ndc": (width / 2, -height / 2),
    }
    if convention not in scales:
        raise ClipError(f"motion_convention: {_conventions()}; got {convention!r}.")
    return motion * np.asarray(scales[convention], motion.dtype)


def sequence_files(path: str | Path) -> list[Path]:
    """The EXR files of one sequence in the order of their frame numbers.

    ``path`` is a folder, a glob pattern or one file. Raises ClipError if there are none, if they belong to several
    sequences, or if frame numbers are missing.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".exr" and file.name[0] != ".")
    elif path.is_file():
        files = [path]
    else:
        files = sorted(Path(name) for name in glob.glob(str(path)))
    if not files:
        raise ClipError(f"{path}: expected a folder of EXR files, a pattern that fits some, or one; found none.")
    if len(files) == 1:
        return files
    numbered: dict[str, dict[int, Path]] = {}
    for file in files:
        match = re.fullmatch(r"(.*?)(\d+)", file.stem)
        if match is None:
            raise ClipError(f"{file}: expected a file name that ends in a frame number, such as shot_0001.exr.")
        numbered.setdefault(match[1], {})[int(match[2])] = file
    if len(numbered) > 1:
        raise ClipError(f"{path}: expected one sequence, got several: {', '.join(sorted(numbered))}; use a pattern.")
    frames = next(iter(numbered.values()))
    missing = sorted(set(range(min(frames), max(frames) + 1)) - set(frames))
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (" ..." if len(missing) > 8 else "")
        raise ClipError(f"{path}: frames are missing between {min(frames)} and {max(frames)}: {shown}.")
    return [frames[number] for number in sorted(frames)]


def plain_frames(
    path: str | Path,
    *,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[list[Path], Iterator[Frame]]:
    """The files of another renderer's sequence, and their frames, each read when it is asked for.

    All frames have the size and the buffers of the first. ``motion_convention`` says what the motion vectors mean (a
    key of ``MOTION_CONVENTIONS``) and is needed as soon as there are any that are not Cycles' ``Vector``; ``"none"``
    leaves them out. ``channels`` and ``layer``: see :func:`jaxdn.clips.layers.detect_channels`; what they choose, see
    :func:`jaxdn.clips.sources.sources_of`. ``log`` is called with lines about what is derived or left unused, when the
    first frame is read. Depth is taken for view-space z (far or infinite
    becomes ``FAR``); ids count from 1 with 0 for nothing, and are left out of all frames if they say nothing in the
    first. Normals are expected in world space, roughness linear (GGX alpha is its square).

    Raises ClipError at once where the files are no sequence, and, naming the file, when a frame is asked for that
    cannot be read or differs from the first.
    """
    if motion_convention not in (None, "none", *MOTION_CONVENTIONS):
        raise ClipError(f"motion_convention: {_conventions()}; got {motion_convention!r}.")
    files = sequence_files(path)
    return files, _frames(files, motion_convention, channels, layer, log)


def _frames(
    files: Sequence[Path],
    motion_convention: str | None,
    channels: Mapping[str, str] | None,
    layer: str | None,
    log: Callable[[str], None],
) -> Iterator[Frame]:
    first: _First | None = None
    for file in files:
        frame, lines = _read(file, motion_convention, channels, layer)
        if first is None:
            for line in lines:
                log(line)
            # Renderers write zeros where nobody asked for ids. Whether all frames do is not known before the last one.
            silent = frame.ids is not None and bool(np.all(frame.ids < 0))
            first = _First(frame.radiance.shape, present(frame), silent)
        _check_like_first(file, frame, first)
        yield frame._replace(ids=None) if first.silent else frame


class _First(NamedTuple):
    """What all later frames have in common with the first."""

    shape: tuple[int, ...]
    buffers: tuple[str, ...]
    silent: bool
    """Its ids say nothing."""


def _read(
    file: Path, motion_convention: str | None, channels: Mapping[str, str] | None, layer: str | None
) -> tuple[Frame, list[str]]:
    """One frame, and in words what was derived, or left unused."""
    there = read_exr(file)
    try:
        found = detect_channels(list(there), channels=channels, layer=layer)
        convention = motion_convention_of(found, there, motion_convention)
        if convention is None:
            found.pop("motion", None)
        images = {name: np.stack([there[channel] for channel in found[name]], axis=-1) for name in found}
        buffers = {name: _converted(image, BUFFERS[name], convention) for name, image in images.items()}
        for name in {"roughness", "specular_reflectance"} & set(found):
            buffers[name] = check_fraction(name, layer_of(found[name]), buffers[name])
        frame, derived = with_reflectance(Frame(**buffers), found, there, lambda: read_header(file))
    except ClipError as error:
        raise ClipError(f"{file}: {error}") from error
    lines = []
    unpaired = None if "specular_reflectance" in (channels or {}) else unpaired_specular(list(there), found)
    if unpaired is not None:
        lines.append(
            f"not used: {unpaired!r}, as the albedo may have this part in it already; if yours is the diffuse part "
            f"alone, name it: --channels specular_reflectance={unpaired}"
        )
    return frame, lines if derived is None else [*lines, derived]


def _converted(image: np.ndarray, buffer: Buffer, convention: str | None) -> np.ndarray:
    """One of their buffers as ours."""
    if buffer.kind == "id":
        ids = np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        return (np.clip(np.rint(ids), 0, 2**31 - 1) - 1).astype(np.int32)
    image = image.astype(buffer.dtype)
    if buffer.kind == "vector" and convention is not None:
        return convert_motion(image, convention)
    if buffer.kind == "distance":
        return np.where(np.isfinite(image) & (image < FAR), image, np.float32(FAR))
    return image


def motion_convention_of(found: Mapping[str, Channels], there: Collection[str], stated: str | None) -> str | None:
    """The convention of the motion vectors among a file's channels; None where there are none, or none are wanted.

    Raises ClipError where nobody has stated it and the names do not tell.
    """
    if "motion" not in found or stated == "none":
        return None
    if stated is not None:
        return stated
    layer = found["motion"][0].rpartition(".")[0]
    four = all(f"{layer}.{component}" in there for component in "XYZW")
    if four and layer.rpartition(".")[2].lower() == "vector":
        return "cycles"
    raise ClipError(
        f"{', '.join(found['motion'])}: nothing in the file says what these motion vectors mean; state "
        f"motion_convention (jaxdn denoise --motion-convention): {_conventions()}."
    )


def _conventions() -> str:
    words = "; ".join(f"{name!r}: {meaning}" for name, meaning in MOTION_CONVENTIONS.items())
    return f"expected one of {words}; 'none': leave the motion out"


def _check_like_first(file: Path, frame: Frame, first: _First) -> None:
    if frame.radiance.shape != first.shape:
        raise ClipError(
            f"{file}: expected {first.shape[1]} x {first.shape[0]} pixels as in the first frame, "
            f"got {frame.radiance.shape[1]} x {frame.radiance.shape[0]}."
        )
    differing = sorted(set(present(frame)) ^ set(first.buffers))
    if differing:
        raise ClipError(f"{file}: expected the same buffers as in the first frame, but {', '.join(differing)} differs.")
