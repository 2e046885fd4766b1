"""One frame of a clip as one multi-layer OpenEXR file that any viewer opens.

Noisy radiance is stored as *independent* layers of 1, 2, 4, ... samples a pixel, so that one rendering gives every
sample count up to their sum: ``n`` samples are ``sum(2^k * layer_k) / n`` over the bits of ``n`` (Hasselgren et al.
2020, sec. 2.2). A buffer that is ``None`` has no channels in the file, and comes back as ``None``.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn.clips.exr import read_exr, to_half, write_exr
from jaxdn.clips.files import ClipError
from jaxdn.frame import Frame


class _Layout(NamedTuple):
    channels: str
    """The last letter of each channel's name."""
    kind: str
    """"half", "float", "ids" (int32 stored as uint32, one up, so that 0 is nothing) or "bool"."""


LAYOUT = {
    "albedo": _Layout("RGB", "half"),
    "normal": _Layout("XYZ", "half"),
    "depth": _Layout("Z", "float"),
    "roughness": _Layout("Y", "half"),
    "motion": _Layout("XY", "float"),
    "dual_motion": _Layout("XY", "float"),
    "visible": _Layout("Y", "bool"),
    "previous_depth": _Layout("Z", "float"),
    "ids": _Layout("Y", "ids"),
    "direct": _Layout("RGB", "half"),
    "emission": _Layout("RGB", "half"),
}
"""How every buffer of a Frame but the radiance lies in the file."""

_LIGHT = _Layout("RGB", "half")


class StoredFrame(NamedTuple):
    """What :func:`read_frame` finds: numpy arrays, float32 but for ``ids`` (int32) and ``visible`` (bool)."""

    frame: Frame
    """Its radiance has the number of samples that was asked for."""
    layers: dict[int, np.ndarray]
    """Every independent noisy image [H, W, 3] by its number of samples."""
    reference: np.ndarray | None
    """[H, W, 3] the converged radiance."""
    reference_half: np.ndarray | None
    """[H, W, 3] the mean of the first half of the reference's samples: what the reference's own noise is."""


def write_frame(
    path: str | Path,
    frame: Frame,
    *,
    layers: Mapping[int, Any] | None = None,
    reference: Any = None,
    reference_half: Any = None,
) -> None:
    """Write one frame, whole or not at all.

    ``layers`` maps numbers of samples (1, 2, 4, ...) to independent noisy images [H, W, 3]; ``frame.radiance`` is
    not stored then. Without ``layers``, ``frame.radiance`` becomes the layer of one sample. Light, albedo, normals and
    roughness are stored in half precision (finite values beyond 65504 are clamped; NaN and infinities are kept), depths
    and motion vectors in single precision. Raises ValueError for shapes that do not fit each other, OSError if the file
    cannot be written.
    """
    layers = {1: frame.radiance} if layers is None else layers
    if not layers:
        raise ValueError(f"{path}: expected at least one noisy layer, got none.")
    if any(isinstance(samples, bool) or not isinstance(samples, int) or samples < 1 for samples in layers):
        raise ValueError(f"{path}: layers: expected whole numbers of samples, got {list(layers)}.")
    images = {f"noisy_{samples}spp": (image, _LIGHT) for samples, image in sorted(layers.items())}
    images |= {"reference": (reference, _LIGHT), "reference_half": (reference_half, _LIGHT)}
    images |= {name: (getattr(frame, name), layout) for name, layout in LAYOUT.items()}
    size = np.shape(next(iter(layers.values())))[:2]
    channels: dict[str, np.ndarray] = {}
    for name, (image, layout) in images.items():
        if image is None:
            continue
        image = np.asarray(image)
        expected = (*size, len(layout.channels))
        if image.shape != expected:
            raise ValueError(f"{path}: {name}: expected shape {expected}, got {image.shape}.")
        stored = _encode(f"{path}: {name}", image, layout.kind)
        channels |= {f"{name}.{letter}": stored[..., i] for i, letter in enumerate(layout.channels)}
    write_exr(path, channels)


def read_frame(path: str | Path, *, spp: int = 1) -> StoredFrame:
    """Read one frame with ``spp`` samples a pixel of noise.

    Raises ClipError, naming the file and the reason, if it is unreadable, a channel is missing, or ``spp`` cannot be
    made of the layers.
    """
    channels = read_exr(path)
    layers = {n: _required(path, channels, f"noisy_{n}spp", _LIGHT) for n in stored_layers(channels)}
    chosen = layers_for(spp, layers, path)
    buffers = {name: _optional(path, channels, name, layout) for name, layout in LAYOUT.items()}
    return StoredFrame(
        Frame(radiance=combine({n: layers[n] for n in chosen}), **buffers),
        layers,
        _optional(path, channels, "reference", _LIGHT),
        _optional(path, channels, "reference_half", _LIGHT),
    )


def stored_layers(channels: Iterable[str]) -> list[int]:
    """The sample counts of the noisy layers among channel names, ascending."""
    found = set()
    for name in channels:
        head, _, _ = name.partition(".")
        count = head.removeprefix("noisy_").removesuffix("spp")
        if head == f"noisy_{count}spp" and count.isdecimal():
            found.add(int(count))
    return sorted(found)


def combine(layers: Mapping[int, np.ndarray]) -> np.ndarray:
    """The float32 mean of independent images, each weighted with its number of samples."""
    if len(layers) == 1:
        return np.asarray(next(iter(layers.values())), np.float32)
    with np.errstate(invalid="ignore"):  # Inf - Inf: what is broken in a layer stays visible in the sum
        total = sum(np.float32(samples) * image.astype(np.float32) for samples, image in layers.items())
        return np.asarray(total / np.float32(sum(layers)), np.float32)


def layers_for(spp: int, available: Iterable[int], where: str | Path) -> list[int]:
    """The layers whose samples add up to ``spp``: its bits, or a layer of just that many.

    Raises ClipError, saying what there is, if ``spp`` cannot be had.
    """
    available = sorted(available)
    if isinstance(spp, bool) or not isinstance(spp, int) or spp < 1:
        raise ClipError(f"{where}: spp: expected a whole number of at least 1, got {spp!r}.")
    chosen = [1 << bit for bit in range(spp.bit_length()) if spp >> bit & 1]
    if not set(chosen) <= set(available) and spp in available:
        return [spp]
    if not set(chosen) <= set(available):
        layers = ", ".join(map(str, available)) or "none"
        raise ClipError(
            f"{where}: {spp} samples a pixel are not available; there are independent layers of {layers} samples a "
            "pixel: ask for one of these or, of powers of two, for their sums."
        )
    return chosen


def _encode(where: str, image: np.ndarray, kind: str) -> np.ndarray:
    if kind == "half":
        return to_half(image)
    if kind == "float":
        return image.astype(np.float32)
    if kind == "bool":
        return (image != 0).astype(np.float16)
    if not np.issubdtype(image.dtype, np.integer):
        raise ValueError(f"{where}: expected whole numbers, got {image.dtype}.")
    if image.min() < -1 or image.max() > np.iinfo(np.int32).max:
        raise ValueError(f"{where}: expected ids from -1 to 2^31 - 1, got {image.min()} to {image.max()}.")
    return (image.astype(np.int64) + 1).astype(np.uint32)


def _decode(image: np.ndarray, kind: str) -> np.ndarray:
    if kind == "bool":
        return image > 0.5
    if kind == "ids":
        return (image.astype(np.int64) - 1).astype(np.int32)
    return image.astype(np.float32)


def _required(path: str | Path, channels: Mapping[str, np.ndarray], name: str, layout: _Layout) -> np.ndarray:
    missing = [f"{name}.{letter}" for letter in layout.channels if f"{name}.{letter}" not in channels]
    if missing:
        raise ClipError(f"{path}: expected the channels {', '.join(missing)}, found {', '.join(sorted(channels))}.")
    return _decode(np.stack([channels[f"{name}.{letter}"] for letter in layout.channels], axis=-1), layout.kind)


def _optional(path: str | Path, channels: Mapping[str, np.ndarray], name: str, layout: _Layout) -> np.ndarray | None:
    # One channel of a group is a damaged group, not an absent effect.
    there = any(f"{name}.{letter}" in channels for letter in layout.channels)
    return _required(path, channels, name, layout) if there else None
