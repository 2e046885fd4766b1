"""One frame of a clip as one multi-layer OpenEXR file that any viewer opens.

Noisy radiance is stored as *independent* layers of 1, 2, 4, ... samples a pixel, so that one rendering gives every
sample count up to their sum: ``n`` samples are ``sum(2^k * layer_k) / n`` over the bits of ``n`` (Hasselgren et al.
2020, sec. 2.2). Where pixels were filtered, the guides that are means over samples (:data:`jaxdn.core.frame.AVERAGED`)
are stored for every layer: those of the layer with the fewest samples under their own names, those of the others and of
the reference behind that image's name (``noisy_4spp_albedo``, ``reference_albedo``); the guides of ``n`` samples are
combined as the radiance is. A buffer that is ``None`` has no channels in the file, and is read as ``None``. How a
buffer is stored follows from its row in :data:`jaxdn.core.frame.BUFFERS`.
"""

import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxdn.core.frame import AVERAGED, BUFFERS, GUIDES, OF_SAMPLES, Buffer, Frame
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.exr import read_exr, to_half, write_exr

_LIGHT = BUFFERS["radiance"]
"""How noisy layers and references are stored; the radiance itself is combined from the layers."""


class StoredFrame(NamedTuple):
    """What :func:`read_frame` finds: NumPy arrays with the dtypes of :attr:`jaxdn.core.frame.Buffer.dtype`."""

    frame: Frame
    """Its radiance has the requested number of samples."""
    layers: Mapping[int, np.ndarray] = MappingProxyType({})
    """Every independent noisy image [H, W, 3] by its number of samples."""
    reference: np.ndarray | None = None
    """[H, W, 3] the converged radiance."""
    reference_half: np.ndarray | None = None
    """[H, W, 3] the mean of the first half of the reference's samples, to measure the reference's noise."""
    draws: np.ndarray | None = None
    """[n, H, W, 6] n independent samples of indirect (first three channels) and direct light, for training."""
    layer_guides: Mapping[int, Mapping[str, np.ndarray]] = MappingProxyType({})
    """The guides of each noisy image that are means over its samples, by its number of samples; empty where pixels were
    not filtered."""
    reference_guides: Mapping[str, np.ndarray] = MappingProxyType({})
    """The same of the reference's samples: nearly free of noise."""


def write_frame(
    path: str | Path,
    frame: Frame,
    *,
    layers: Mapping[int, Any] | None = None,
    reference: Any = None,
    reference_half: Any = None,
    draws: Any = None,
    layer_guides: Mapping[int, Mapping[str, Any]] = MappingProxyType({}),
    reference_guides: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write one frame, completely or not at all.

    ``layers`` maps numbers of samples (1, 2, 4, ...) to independent noisy images [H, W, 3]; ``frame.radiance`` is
    not stored then. Without ``layers``, ``frame.radiance`` becomes the layer of one sample. ``draws`` [n, H, W, 6] are
    further samples of indirect and direct light, one each. ``layer_guides`` are guides by the numbers of samples of the
    layers that they belong to; those of the layer with the fewest are in ``frame``. Each buffer is stored as
    :attr:`jaxdn.core.frame.Buffer.stored` says: light, fractions and directions in half precision (finite values beyond
    65504 are clamped; NaN and infinities are kept), distances and vectors in single precision. Raises ValueError for
    shapes that do not fit each other, OSError if the file cannot be written.
    """
    layers = {1: frame.radiance} if layers is None else layers
    given = StoredFrame(frame, layers, reference, reference_half, draws, layer_guides, reference_guides)
    write_exr(path, encode_frame(path, given))


def encode_frame(path: str | Path, given: StoredFrame) -> dict[str, np.ndarray]:
    """The channels [H, W] of a frame's file, in the precision in which they are stored.

    Raises ValueError as :func:`write_frame` does.
    """
    layers = given.layers
    if not layers:
        raise ValueError(f"{path}: expected at least one noisy layer, got none.")
    if any(isinstance(samples, bool) or not isinstance(samples, int) or samples < 1 for samples in layers):
        raise ValueError(f"{path}: layers: expected whole numbers of samples, got {list(layers)}.")
    images: dict[str, tuple[Any, Buffer]] = {
        f"noisy_{samples}spp": (image, _LIGHT) for samples, image in sorted(layers.items())
    }
    images |= {"reference": (given.reference, _LIGHT), "reference_half": (given.reference_half, _LIGHT)}
    for index, draw in enumerate(() if given.draws is None else given.draws):
        images |= {name: (draw[..., part], _LIGHT) for name, part in _draw_names(index).items()}
    images |= {name: (getattr(given.frame, name), BUFFERS[name]) for name in GUIDES}
    for samples, guides in given.layer_guides.items():
        images |= {f"noisy_{samples}spp_{name}": (image, BUFFERS[name]) for name, image in guides.items()}
    images |= {f"reference_{name}": (image, BUFFERS[name]) for name, image in given.reference_guides.items()}
    size = np.shape(next(iter(layers.values())))[:2]
    channels: dict[str, np.ndarray] = {}
    for name, (image, buffer) in images.items():
        if image is None:
            continue
        image = np.asarray(image)
        expected = (*size, buffer.channels)
        if image.shape != expected:
            raise ValueError(f"{path}: {name}: expected shape {expected}, got {image.shape}.")
        stored = _encode(f"{path}: {name}", image, buffer)
        channels |= {f"{name}.{letter}": stored[..., i] for i, letter in enumerate(buffer.letters)}
    return channels


def read_frame(path: str | Path, *, spp: int = 1) -> StoredFrame:
    """Read one frame with ``spp`` samples a pixel of noise.

    The buffers of samples (:data:`jaxdn.core.frame.OF_SAMPLES`) belong to the layer with the fewest: with any other
    number they are None, and a warning says so.

    Raises ClipError, naming the file and the reason, if it is unreadable, a channel is missing, or ``spp`` cannot be
    made of the layers.
    """
    channels = read_exr(path)
    layers = {n: _required(path, channels, f"noisy_{n}spp", _LIGHT) for n in stored_layers(channels)}
    chosen = layers_for(spp, layers, path)
    buffers = {name: _optional(path, channels, name, BUFFERS[name]) for name in GUIDES}
    guides = _read_layer_guides(path, channels, layers, buffers)
    buffers |= {name: combine({n: guides[n][name] for n in chosen}) for name in guides.get(chosen[0], {})}
    others = [name for name in OF_SAMPLES if buffers[name] is not None]
    if others and chosen != [min(layers)]:
        buffers |= dict.fromkeys(others)
        left_out = ", ".join(sorted(others))
        warnings.warn(f"spp {spp}: left out {left_out}, which belong to the layer of {min(layers)} spp.", stacklevel=2)
    return StoredFrame(
        Frame(radiance=combine({n: layers[n] for n in chosen}), **buffers),
        layers,
        _optional(path, channels, "reference", _LIGHT),
        _optional(path, channels, "reference_half", _LIGHT),
        _read_draws(path, channels),
        guides,
        _read_guides(path, channels, "reference"),
    )


def _read_layer_guides(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    layers: Iterable[int],
    buffers: Mapping[str, np.ndarray | None],
) -> dict[int, dict[str, np.ndarray]]:
    """The guides of each layer, if the layers have their own; of the one with the fewest samples they are ``buffers``.

    A clip with one layer alone has none beside its buffers.
    """
    fewest, *others = sorted(layers)
    found = {samples: _read_guides(path, channels, f"noisy_{samples}spp") for samples in others}
    names = found[others[0]] if others else {}
    if not names:
        return {}
    own = {name: buffer for name in names if (buffer := buffers[name]) is not None}
    found = {fewest: own} | found
    for samples, guides in found.items():
        if set(guides) != set(names):
            missing = ", ".join(sorted(set(names) ^ set(guides)))
            raise ClipError(f"{path}: expected the same guides of every layer; {missing} differs in {samples} spp.")
    return found


def _read_guides(path: str | Path, channels: Mapping[str, np.ndarray], image: str) -> dict[str, np.ndarray]:
    """The guides that belong to one image."""
    found = {name: _optional(path, channels, f"{image}_{name}", BUFFERS[name]) for name in AVERAGED}
    return {name: guide for name, guide in found.items() if guide is not None}


def _draw_names(index: int) -> dict[str, slice]:
    """The layers of one draw: indirect and direct light, and their channels in the array."""
    return {f"draw_{index}": slice(0, 3), f"draw_{index}_direct": slice(3, 6)}


def _read_draws(path: str | Path, channels: Mapping[str, np.ndarray]) -> np.ndarray | None:
    draws: list[np.ndarray] = []
    while f"draw_{len(draws)}.R" in channels:
        parts = [_required(path, channels, name, _LIGHT) for name in _draw_names(len(draws))]
        draws.append(np.concatenate(parts, axis=-1))
    return np.stack(draws) if draws else None


def stored_layers(channels: Iterable[str]) -> list[int]:
    """The sample counts of the noisy layers among channel names, ascending."""
    found = set()
    for name in channels:
        head, _, _ = name.partition(".")
        count = head.removeprefix("noisy_").removesuffix("spp")
        if head == f"noisy_{count}spp" and count.isdecimal():
            found.add(int(count))
    return sorted(found)


def doubling_layers(available: Iterable[int], where: str | Path) -> list[int]:
    """The layers of 1, 2, 4, ... samples up to the first that is missing: any number of samples is combined from these.

    Raises ClipError if there is none of 1 sample.
    """
    counts = set(available)
    found: list[int] = []
    while 1 << len(found) in counts:
        found.append(1 << len(found))
    if not found:
        raise ClipError(
            f"{where}: expected independent noisy layers of 1, 2, 4, ... samples a pixel, got "
            f"{', '.join(map(str, sorted(counts))) or 'none'}; render the clip with --layers 1 2 4."
        )
    return found


def combine(layers: Mapping[int, np.ndarray]) -> np.ndarray:
    """The float32 mean of independent images, each weighted with its number of samples."""
    if len(layers) == 1:
        return np.asarray(next(iter(layers.values())), np.float32)
    with np.errstate(invalid="ignore"):  # Inf - Inf: invalid values of a layer stay visible in the sum
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
            "pixel: request one of these or, of powers of two, a sum of them."
        )
    return chosen


def _encode(where: str, image: np.ndarray, buffer: Buffer) -> np.ndarray:
    if buffer.stored == "half":
        return to_half(image)
    if buffer.stored == "single":
        return image.astype(np.float32)
    if buffer.stored == "flag":
        return (image != 0).astype(np.float16)
    if not np.issubdtype(image.dtype, np.integer):
        raise ValueError(f"{where}: expected whole numbers, got {image.dtype}.")
    if image.min() < -1 or image.max() > np.iinfo(np.int32).max:
        raise ValueError(f"{where}: expected ids from -1 to 2^31 - 1, got {image.min()} to {image.max()}.")
    return (image.astype(np.int64) + 1).astype(np.uint32)


def _decode(image: np.ndarray, buffer: Buffer) -> np.ndarray:
    if buffer.stored == "flag":
        return image > 0.5
    if buffer.stored == "id":
        image = image.astype(np.int64) - 1
    return image.astype(buffer.dtype)


def _required(path: str | Path, channels: Mapping[str, np.ndarray], name: str, buffer: Buffer) -> np.ndarray:
    missing = [f"{name}.{letter}" for letter in buffer.letters if f"{name}.{letter}" not in channels]
    if missing:
        raise ClipError(f"{path}: expected the channels {', '.join(missing)}, found {', '.join(sorted(channels))}.")
    return _decode(np.stack([channels[f"{name}.{letter}"] for letter in buffer.letters], axis=-1), buffer)


def _optional(path: str | Path, channels: Mapping[str, np.ndarray], name: str, buffer: Buffer) -> np.ndarray | None:
    # One channel of a group is a damaged group, not an absent effect.
    there = any(f"{name}.{letter}" in channels for letter in buffer.letters)
    return _required(path, channels, name, buffer) if there else None
