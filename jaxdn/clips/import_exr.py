"""EXR sequences of other renderers: which channel is what, and which way their motion vectors point.

Channels are found by the names that Blender Cycles, pbrt, Arnold, RenderMan, Mitsuba, Corona and Open Image Denoise's
tools use, a view layer's name in front or not. Motion vectors differ in direction, unit and axes from one program to
the next, and nothing in the file says which: unless the layer is Cycles' own four-component ``Vector``, the caller
says so.
"""

import glob
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.clips.exr import read_exr
from jaxdn.clips.files import ClipError
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

_LAYERS: dict[str, tuple[str, ...]] = {
    "radiance": ("noisy image", "", "beauty", "rgba", "combined", "color", "ci"),
    "albedo": (
        "albedo",
        "denoising albedo",
        "diffuse_albedo",
        "diffuse_albedo_noice",
        "visiblediffuse",
        "diffcol",
        "diffuse",
    ),
    "normal": (
        "denoising normal",
        "normal",
        "normals",
        "sh_normal",
        "n",
        "ns",
        "n_noice",
        "visiblenormals",
        "optixnormals",
    ),
    "depth": ("depth", "denoising depth", "z"),
    "motion": ("vector", "motionvector", "motion", "mvec", "backward"),
    "ids": ("ids", "indexob", "shape_index", "object_id", "id"),
}
"""The buffers that other renderers have a name for, with the names of their layers: lower case, the first that is
there is taken."""

Channels = tuple[str, ...]
"""The full names of the channels that make up one buffer, in order."""


def _components(buffer: Buffer) -> tuple[Channels, ...]:
    """What the channels of such a buffer may be called within their layer, lower case; the first that fits is taken."""
    color = (("r", "g", "b"), ("red", "green", "blue"))
    if buffer.channels == 3:
        return (("x", "y", "z"), *color) if buffer.kind == "direction" else color
    if buffer.channels == 2:
        return (("x", "y"), ("r", "g"), ("u", "v"))
    if buffer.kind == "distance":
        return (("z",), ("v",), ("y",), ("",))
    return (("z",), ("y",), ("v",), ("x",), ("r",), ("i",), ("",))


def detect_channels(names: Sequence[str], *, channels: Mapping[str, str] | None = None) -> dict[str, Channels]:
    """Which channels make up which buffer, by their names; buffers without channels are left out.

    ``channels`` names the layer of a buffer outright, for example ``{"radiance": "ViewLayer.Combined"}``. Raises
    ClipError if two layers fit a buffer equally well, if a named layer is not there, or if there is no radiance.
    """
    groups: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, component = name.rpartition(".")
        groups.setdefault(layer, {})[component.lower()] = name
        if not layer:
            groups.setdefault(name, {})[""] = name  # a channel that is a layer of its own, such as "Z"
    stated = channels or {}
    unknown = set(stated) - set(_LAYERS)
    if unknown:
        raise ClipError(f"channels: expected buffers among {', '.join(_LAYERS)}, got {', '.join(sorted(unknown))}.")
    found = {}
    for buffer in _LAYERS:
        fitting = _named(groups, buffer, stated[buffer]) if buffer in stated else _detect(groups, buffer)
        if fitting:
            found[buffer] = fitting
    if "radiance" not in found:
        raise ClipError(f"no radiance among the channels {', '.join(sorted(names))}; {_name_it('radiance')}.")
    return found


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
    path: str | Path, *, motion_convention: str | None = None, channels: Mapping[str, str] | None = None
) -> tuple[list[Path], Iterator[Frame]]:
    """The files of another renderer's sequence, and their frames, each read when it is asked for.

    All frames have the size and the buffers of the first. ``motion_convention`` says what the motion vectors mean (a
    key of ``MOTION_CONVENTIONS``) and is needed as soon as there are any that are not Cycles' ``Vector``; ``"none"``
    leaves them out. ``channels``: see :func:`detect_channels`. Depth is taken for view-space z (far or infinite becomes
    ``FAR``); ids count from 1 with 0 for nothing, and are left out of all frames if they say nothing in the first.
    Normals are expected in world space.

    Raises ClipError at once where the files are no sequence, and, naming the file, when a frame is asked for that
    cannot be read or differs from the first.
    """
    if motion_convention not in (None, "none", *MOTION_CONVENTIONS):
        raise ClipError(f"motion_convention: {_conventions()}; got {motion_convention!r}.")
    files = sequence_files(path)
    return files, _frames(files, motion_convention, channels)


def _frames(
    files: Sequence[Path], motion_convention: str | None, channels: Mapping[str, str] | None
) -> Iterator[Frame]:
    first: _First | None = None
    for file in files:
        frame = _read(file, motion_convention, channels)
        if first is None:
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


def _read(file: Path, motion_convention: str | None, channels: Mapping[str, str] | None) -> Frame:
    there = read_exr(file)
    try:
        found = detect_channels(list(there), channels=channels)
        convention = _motion_convention(found, there, motion_convention)
    except ClipError as error:
        raise ClipError(f"{file}: {error}") from error
    if convention is None:
        found.pop("motion", None)
    images = {name: np.stack([there[channel] for channel in found[name]], axis=-1) for name in found}
    return Frame(**{name: _converted(image, BUFFERS[name], convention) for name, image in images.items()})


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


def _motion_convention(
    found: Mapping[str, Channels], there: Mapping[str, np.ndarray], stated: str | None
) -> str | None:
    """The convention of a file's motion vectors; None where there are none, or none are wanted."""
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


def _name_it(buffer: str) -> str:
    return f"name its layer: channels={{{buffer!r}: LAYER}} (jaxdn denoise --channels {buffer}=LAYER)"


def _fitting(group: Mapping[str, str], buffer: str) -> Channels | None:
    for wanted in _components(BUFFERS[buffer]):
        if all(component in group for component in wanted):
            return tuple(group[component] for component in wanted)
    return None


def _named(groups: Mapping[str, Mapping[str, str]], buffer: str, layer: str) -> Channels:
    channels = _fitting(groups.get(layer, {}), buffer)
    if channels is None:
        raise ClipError(f"channels: no {buffer} in layer {layer!r}; there are {', '.join(map(repr, sorted(groups)))}.")
    return channels


def _detect(groups: Mapping[str, Mapping[str, str]], buffer: str) -> Channels | None:
    for wanted in _LAYERS[buffer]:
        fitting = {}
        for layer, group in groups.items():
            lower = layer.lower()
            if lower == wanted or (wanted and lower.endswith("." + wanted)):
                channels = _fitting(group, buffer)
                if channels:
                    fitting[layer] = channels
        # Blender's compositor output stands next to the view layer that it was made from.
        rendered = {layer: channels for layer, channels in fitting.items() if not layer.startswith("Composite.")}
        fitting = rendered or fitting
        exact = {layer: channels for layer, channels in fitting.items() if layer.lower() == wanted}
        fitting = exact or fitting
        if len(set(fitting.values())) > 1:
            raise ClipError(
                f"{buffer}: {' and '.join(map(repr, sorted(fitting)))} fit equally well; {_name_it(buffer)}."
            )
        if fitting:
            return next(iter(fitting.values()))
    return None
