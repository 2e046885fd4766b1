"""EXR sequences of other renderers: which channel is what, and which way their motion vectors point.

Channels are found by the names that Blender Cycles, pbrt, Arnold, RenderMan, Mitsuba, Corona and Open Image Denoise's
tools use, a view layer's name in front or not. Motion vectors differ in direction, unit and axes from one program to
the next, and nothing in the file says which: unless the layer is Cycles' own four-component ``Vector``, the caller
says so.
"""

import glob
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.clips.exr import read_exr
from jaxdn.clips.files import ClipError
from jaxdn.frame import FAR, Frame

MOTION_CONVENTIONS: dict[str, str] = {
    "previous-current": "pixels, previous minus current position, y down (ours; NTASD, Zeng et al., SVGF)",
    "current-previous": "pixels, current minus previous position, y down (OptiX flow)",
    "cycles": "pixels, previous minus current position, y up (Blender's Vector pass, first two components)",
    "uv": "fractions of the image, previous minus current, y down (Falcor, NRD, DLSS scaled to [-1, 1])",
    "ndc": "clip space [-1, 1], previous minus current, y up",
    "rows-columns": "pixels, previous minus current, (row, column) order (Noisebase)",
}
"""What ``motion_convention`` may be, in words."""

_COLOR = (("r", "g", "b"), ("red", "green", "blue"))
_VECTOR = (("x", "y", "z"), *_COLOR)
_SINGLE = (("z",), ("y",), ("v",), ("x",), ("r",), ("i",), ("",))
_PLANE = (("x", "y"), ("r", "g"), ("u", "v"))


class _Rule(NamedTuple):
    layers: tuple[str, ...]
    """Names in the order of preference, lower case."""
    components: tuple[tuple[str, ...], ...]


_RULES = {
    "radiance": _Rule(("noisy image", "", "beauty", "rgba", "combined", "color", "ci"), _COLOR),
    "albedo": _Rule(
        (
            "albedo",
            "denoising albedo",
            "diffuse_albedo",
            "diffuse_albedo_noice",
            "visiblediffuse",
            "diffcol",
            "diffuse",
        ),
        _COLOR,
    ),
    "normal": _Rule(
        ("denoising normal", "normal", "normals", "sh_normal", "n", "ns", "n_noice", "visiblenormals", "optixnormals"),
        _VECTOR,
    ),
    "depth": _Rule(("depth", "denoising depth", "z"), (("z",), ("v",), ("y",), ("",))),
    "motion": _Rule(("vector", "motionvector", "motion", "mvec", "backward"), _PLANE),
    "ids": _Rule(("ids", "indexob", "shape_index", "object_id", "id"), _SINGLE),
}


def detect_channels(names: Sequence[str], *, layers: Mapping[str, str] | None = None) -> dict[str, tuple[str, ...]]:
    """Which channels make up which buffer, by their names; buffers without channels are left out.

    ``layers`` names the layer of a buffer outright, for example ``{"radiance": "ViewLayer.Combined"}``. Raises
    ClipError if two layers fit a buffer equally well, if a named layer is not there, or if there is no radiance.
    """
    groups: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, component = name.rpartition(".")
        groups.setdefault(layer, {})[component.lower()] = name
        if not layer:
            groups.setdefault(name, {})[""] = name  # a channel that is a layer of its own, such as "Z"
    layers = layers or {}
    unknown = set(layers) - set(_RULES)
    if unknown:
        raise ClipError(f"layers: expected names among {', '.join(_RULES)}, got {', '.join(sorted(unknown))}.")
    found = {}
    for buffer, rule in _RULES.items():
        channels = _named(groups, buffer, rule, layers[buffer]) if buffer in layers else _detect(groups, buffer, rule)
        if channels:
            found[buffer] = channels
    if "radiance" not in found:
        raise ClipError(
            f"no radiance among the channels {', '.join(sorted(names))}; name its layer: layers={{'radiance': ...}}."
        )
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


def read_plain_frames(
    path: str | Path, *, motion_convention: str | None = None, layers: Mapping[str, str] | None = None
) -> list[Frame]:
    """The frames of another renderer's sequence, all with the same buffers.

    ``motion_convention`` says what the motion vectors mean (a key of ``MOTION_CONVENTIONS``) and is needed as soon as
    there are any that are not Cycles' ``Vector``; ``"none"`` leaves them out. ``layers``: see :func:`detect_channels`.
    Depth is taken for view-space z (far or infinite becomes ``FAR``); ids count from 1 with 0 for nothing, and are
    left out if they say nothing. Normals are expected in world space.
    Raises ClipError, naming the file, where the files do not make one clip.
    """
    files = sequence_files(path)
    frames: list[Frame] = []
    for file in files:
        channels = read_exr(file)
        try:
            found = detect_channels(list(channels), layers=layers)
            convention = _motion_convention(found, channels, motion_convention)
        except ClipError as error:
            raise ClipError(f"{file}: {error}") from error
        if convention is None:
            found.pop("motion", None)
        images = {name: np.stack([channels[c] for c in found[name]], axis=-1) for name in found}
        frames.append(_frame(images, convention))
        _check_like_first(file, frames[-1], frames[0])
    if all(frame.ids is None or np.all(frame.ids < 0) for frame in frames):
        frames = [frame._replace(ids=None) for frame in frames]
    return frames


def _frame(images: Mapping[str, np.ndarray], convention: str | None) -> Frame:
    buffers = {name: image.astype(np.float32) for name, image in images.items() if name != "ids"}
    if convention is not None:
        buffers["motion"] = convert_motion(buffers["motion"], convention)
    if "depth" in buffers:
        depth = buffers["depth"]
        buffers["depth"] = np.where(np.isfinite(depth) & (depth < FAR), depth, np.float32(FAR))
    if "ids" in images:
        ids = np.nan_to_num(images["ids"].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        buffers["ids"] = (np.clip(np.rint(ids), 0, 2**31 - 1) - 1).astype(np.int32)
    return Frame(**buffers)


def _motion_convention(
    found: Mapping[str, tuple[str, ...]], channels: Mapping[str, np.ndarray], stated: str | None
) -> str | None:
    if stated is not None and stated != "none" and stated not in MOTION_CONVENTIONS:
        raise ClipError(f"motion_convention: {_conventions()}; got {stated!r}.")
    if "motion" not in found or stated == "none":
        return None
    if stated is not None:
        return stated
    layer = found["motion"][0].rpartition(".")[0]
    four = all(f"{layer}.{component}" in channels for component in "XYZW")
    if four and layer.rpartition(".")[2].lower() == "vector":
        return "cycles"
    raise ClipError(f"{', '.join(found['motion'])}: state motion_convention, the file does not: {_conventions()}.")


def _conventions() -> str:
    words = "; ".join(f"{name!r}: {meaning}" for name, meaning in MOTION_CONVENTIONS.items())
    return f"expected one of {words}; 'none': leave the motion out"


def _check_like_first(file: Path, frame: Frame, first: Frame) -> None:
    if frame.radiance.shape != first.radiance.shape:
        raise ClipError(
            f"{file}: expected {first.radiance.shape[1]} x {first.radiance.shape[0]} pixels as in the first frame, "
            f"got {frame.radiance.shape[1]} x {frame.radiance.shape[0]}."
        )
    differing = [name for name in Frame._fields if (getattr(frame, name) is None) != (getattr(first, name) is None)]
    if differing:
        raise ClipError(f"{file}: expected the same buffers as in the first frame, but {', '.join(differing)} differs.")


def _components(group: Mapping[str, str], rule: _Rule) -> tuple[str, ...] | None:
    for wanted in rule.components:
        if all(component in group for component in wanted):
            return tuple(group[component] for component in wanted)
    return None


def _named(groups: Mapping[str, Mapping[str, str]], buffer: str, rule: _Rule, layer: str) -> tuple[str, ...]:
    channels = _components(groups.get(layer, {}), rule)
    if channels is None:
        raise ClipError(f"layers: no {buffer} in layer {layer!r}; there are {', '.join(map(repr, sorted(groups)))}.")
    return channels


def _detect(groups: Mapping[str, Mapping[str, str]], buffer: str, rule: _Rule) -> tuple[str, ...] | None:
    for wanted in rule.layers:
        fitting = {}
        for layer, group in groups.items():
            lower = layer.lower()
            if lower == wanted or (wanted and lower.endswith("." + wanted)):
                channels = _components(group, rule)
                if channels:
                    fitting[layer] = channels
        # Blender's compositor output stands beside the view layer that it was made from.
        rendered = {layer: channels for layer, channels in fitting.items() if not layer.startswith("Composite.")}
        fitting = rendered or fitting
        exact = {layer: channels for layer, channels in fitting.items() if layer.lower() == wanted}
        fitting = exact or fitting
        if len(set(fitting.values())) > 1:
            raise ClipError(
                f"{buffer}: {' and '.join(map(repr, sorted(fitting)))} fit equally well; "
                f"name one: layers={{{buffer!r}: ...}}."
            )
        if fitting:
            return next(iter(fitting.values()))
    return None
