"""References: means of renders with other seeds, kept as two halves so that their own noise is known."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

GUIDES = ("Denoising Albedo", "Denoising Normal", "Denoising Depth")
"""Passes of which a reference keeps the mean."""


class Reference(NamedTuple):
    """Two independent means of the radiance, ``first`` and ``second`` [H, W, 3], of ``samples`` a pixel each.

    ``guides`` [H, W, 7] is the mean of albedo, normal and depth; ``draws`` counts the renders of each half.
    """

    first: np.ndarray
    second: np.ndarray
    guides: np.ndarray
    samples: int
    draws: int

    @property
    def image(self) -> np.ndarray:
        """The reference: the mean of the halves."""
        return (self.first + self.second) / 2

    def __add__(self, other: "Reference") -> "Reference":  # type: ignore[override]
        """Both together, weighted by their samples."""
        total = self.samples + other.samples
        share = np.float64(other.samples / total)
        first, second, guides = (
            (1 - share) * mine + share * theirs for mine, theirs in zip(self[:3], other[:3], strict=True)
        )
        return Reference(first, second, guides, total, self.draws + other.draws)


def noise(reference: Reference) -> float:
    """The mean squared error that a reference itself has, in x / (1 + x).

    With halves A and B, the mean M = (A + B) / 2 has the standard deviation |A - B| / 2 = M - min(A, B). The error of
    the curve c is taken towards the darker side, c(M) - c(min(A, B)): where a firefly is in one half alone that is
    what it costs, while (c(A) - c(B)) / 2 would leave most of it out.
    """
    low = np.minimum(reference.first, reference.second)
    return float(np.mean((compress(reference.image) - compress(low)) ** 2))


def compress(radiance: np.ndarray) -> np.ndarray:
    """x / (1 + x) of the light that is not negative."""
    light = np.maximum(radiance.astype(np.float64), 0.0)
    return light / (1.0 + light)


def decibels(error: float) -> float:
    """The PSNR of a mean squared error with a peak of 1."""
    return float(-10 * np.log10(max(error, 1e-12)))


def more_samples(reference: Reference, target: float, seconds: float, spent: float) -> int:
    """Samples a pixel that each half still needs for a target in decibels, as noise falls with 1 / samples.

    No more than the processor time that is left buys, at the price so far; and at most sixteen times as many, because
    the noise of few samples is itself known badly. 0 where the target is reached or the time is spent.
    """
    wanted = 10 ** (-target / 10)
    missing = reference.samples * (noise(reference) / wanted - 1)
    price = spent / reference.samples
    count = min(1.05 * missing, (seconds - spent) / price if price > 0 else missing, 16 * reference.samples)
    return max(0, int(np.ceil(count))) if count >= max(4, 0.02 * reference.samples) else 0


def write(path: Path, reference: Reference, view: str = "ViewLayer") -> None:
    """A reference as a multi-layer OpenEXR file: the passes by Blender's names, and the halves' difference.

    ``Half Difference`` is (A - B) / 2, in half precision: A is the image plus it, B minus it.
    """
    import OpenEXR

    image = reference.image.astype(np.float32)
    layers = {f"{view}.Combined.{c}": image[..., i] for i, c in enumerate("RGB")}
    names = [f"Denoising Albedo.{c}" for c in "RGB"] + [f"Denoising Normal.{c}" for c in "XYZ"] + ["Denoising Depth.Z"]
    layers |= {f"{view}.{name}": reference.guides[..., i].astype(np.float32) for i, name in enumerate(names)}
    apart = ((reference.first - reference.second) / 2).clip(-65504, 65504).astype(np.float16)
    layers |= {f"{view}.Half Difference.{c}": apart[..., i] for i, c in enumerate("RGB")}
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "jaxdn samples": str(reference.samples),
        "jaxdn draws": str(reference.draws),
    }
    OpenEXR.File(header, {name: np.ascontiguousarray(values) for name, values in layers.items()}).write(str(path))


def read(path: Path, view: str = "ViewLayer") -> Reference:
    """A reference as it was written; the halves to half precision of their difference."""
    channels, header = read_channels(path)
    image = np.stack([channels[f"{view}.Combined.{c}"] for c in "RGB"], axis=-1).astype(np.float64)
    apart = np.stack([channels[f"{view}.Half Difference.{c}"] for c in "RGB"], axis=-1).astype(np.float64)
    draws = int(header["jaxdn draws"])
    return Reference(image + apart, image - apart, guides(channels, view), int(header["jaxdn samples"]), draws)


def guides(channels: dict[str, np.ndarray], view: str = "ViewLayer") -> np.ndarray:
    """Albedo, normal and depth of a file's channels [H, W, 7]."""
    names = [f"{view}.{name}." for name in GUIDES]
    found = [channels[name + c] for name, cs in zip(names, ("RGB", "XYZ", "Z"), strict=True) for c in cs]
    return np.stack(found, axis=-1).astype(np.float64)


def read_channels(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """All channels of all parts of an OpenEXR file, and the first part's header."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(c.pixels) for part in file.parts for name, c in part.channels.items()}
        return channels, dict(file.parts[0].header)
