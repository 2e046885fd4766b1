"""Images as PNG: files for ``--preview``, data URLs for the page, error maps and zoom regions."""

import base64
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jaxdn.runtime.atomic_files import write_atomically

NOT_FINITE = (1.0, 0.0, 1.0)
"""NaN and infinite pixels are painted magenta, so that an invalid image cannot be mistaken for a black one."""

ERROR_COLORS = ((0, 0, 4), (48, 12, 92), (130, 31, 108), (206, 66, 68), (246, 143, 30), (252, 215, 92), (255, 255, 235))
"""sRGB bytes at equal steps from no error to the top of the scale; monotone in lightness."""


def save_png(path: str | os.PathLike[str], image: Any) -> None:
    """Write a display-encoded image [H, W, 3] or [H, W] in 0..1 as an 8-bit PNG.

    Values outside 0..1 are clamped, pixels that are not finite are painted magenta. The file is never
    incomplete (:func:`jaxdn.runtime.atomic_files.write_atomically`). Raises ValueError for another shape.
    """
    write_atomically({Path(path): encode_png(image)})


def encode_png(image: Any) -> bytes:
    """The bytes of an 8-bit PNG of a display-encoded image [H, W, 3] or [H, W] in 0..1."""
    return _encode(Image.fromarray(displayed_bytes(image)))


def displayed_bytes(image: Any) -> np.ndarray:
    """A display-encoded image [H, W, 3] or [H, W] in 0..1 as [H, W, 3] of 0..255, magenta where it is not finite.

    Raises ValueError for another shape.
    """
    pixels = np.asarray(image, np.float64)
    if pixels.ndim not in (2, 3) or 0 in pixels.shape or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise ValueError(f"image: expected [H, W, 3] or [H, W], got shape {pixels.shape}; pass one frame in RGB.")
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    finite = np.isfinite(pixels).all(axis=2, keepdims=True)
    pixels = np.where(finite, np.clip(np.nan_to_num(pixels), 0.0, 1.0), NOT_FINITE)
    return np.rint(pixels * 255.0).astype(np.uint8)


def error_map(image: Any, reference: Any) -> np.ndarray:
    """[H, W] float64: mean over channels of |image - reference|; NaN where that is not finite."""
    finite = np.isfinite(image).all(axis=2, keepdims=True)
    difference = np.abs(np.where(finite, image, 0.0) - np.asarray(reference, np.float64)).mean(axis=2)
    return np.where(finite[..., 0], difference, np.nan)


def error_scale(maps: list[np.ndarray]) -> float:
    """Upper end of a colour scale shared by all maps: their 99.5th percentile, rounded up to 1, 2 or 5 times 10^n.

    NaN does not count: one invalid image must not make all others black.
    """
    known = [values[~np.isnan(values)] for values in maps]
    top = float(np.percentile(np.concatenate(known), 99.5)) if sum(map(len, known)) else 0.0
    top = min(max(top, 1e-3), 1.0)
    power = 10.0 ** np.floor(np.log10(top))
    return float(min(step * power for step in (1, 2, 5, 10) if step * power >= top * (1 - 1e-9)))


def encode_error(error: np.ndarray, scale: float) -> bytes:
    """The bytes of a PNG with 64 palette colours: ``ERROR_COLORS`` over 0..scale, saturated above and where NaN."""
    steps = np.linspace(0.0, 1.0, 64)
    anchors = np.linspace(0.0, 1.0, len(ERROR_COLORS))
    palette = np.stack([np.interp(steps, anchors, channel) for channel in np.transpose(ERROR_COLORS)], axis=1)
    index = np.rint(np.clip(np.where(np.isnan(error), 1.0, error / scale), 0.0, 1.0) * 63.0).astype(np.uint8)
    picture = Image.fromarray(index)
    picture.putpalette(np.rint(palette).astype(np.uint8).ravel().tolist())
    return _encode(picture)


def encode_mask(mask: Any) -> bytes:
    """The bytes of a PNG that is cyan where the mask is true and transparent elsewhere."""
    chosen = np.asarray(mask, bool)
    pixels = np.zeros((*chosen.shape, 4), np.uint8)
    pixels[chosen] = (0, 229, 255, 255)
    return _encode(Image.fromarray(pixels))


def worst_crop(errors: list[np.ndarray], disoccluded: Any, *, size: int = 64) -> tuple[int, int, int, int]:
    """(x, y, width, height) of the window with the largest error in disoccluded pixels, summed over ``errors`` [H, W].

    Without disoccluded pixels, the window with the largest error of all; 4:3 in shape and inside the image.
    """
    mask = np.asarray(disoccluded, bool)
    rows, columns = mask.shape
    weight = np.sum(np.nan_to_num(np.asarray(errors, np.float64), nan=1.0), axis=0) if errors else np.ones(mask.shape)
    if mask.any():
        # The small constant keeps the window on disoccluded pixels even if they have no error.
        weight = np.where(mask, weight + 1e-9, 0.0)
    width, height = min(size, columns), min(size * 3 // 4, rows)
    total = np.pad(np.cumsum(np.cumsum(weight, axis=0), axis=1), ((1, 0), (1, 0)))
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    # Among windows of equal error the middle one is taken: it has the error in its centre, not in a corner.
    best = np.argwhere(sums >= sums.max() * (1 - 1e-6) - 1e-12)
    y, x = best[np.argmin(np.abs(best - best.mean(axis=0)).sum(axis=1))]
    return int(x), int(y), width, height


def data_address(file: bytes) -> str:
    """A PNG or WebP file as a ``data:`` URL, which needs neither file nor server."""
    kind = "webp" if file.startswith(b"RIFF") else "png"
    return f"data:image/{kind};base64," + base64.b64encode(file).decode("ascii")


def _encode(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
