"""Films: the frames of a clip as each method denoised them, and their errors, small enough for one page.

A frame is a lossy WebP of the display-encoded image. Its error map is computed from the exact images, and stored as the
square root of the error in 8 bits of grey, also lossy: the page squares it, divides by its colour scale and paints.
"""

import io
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jaxdn.evaluation.report.images import displayed_bytes, error_map

FRAMES = 60
"""The most frames of a film: six seconds of ten frames."""

WIDTH = 480
"""Pixels; wider frames are halved, by means of 2 x 2 pixels, until they fit."""

QUALITY = 80
"""Of the lossy WebP. A picture of 320 x 180 pixels takes 7 to 30 kB, an error map 5 to 15 kB."""


class Film(NamedTuple):
    """One label's frames, as files of lossy WebP."""

    pictures: list[bytes]
    errors: list[bytes]
    """One for each picture; empty for the reference."""


def film(images: Any, reference: Any | None) -> Film:
    """The film of display-encoded images [T, H, W, 3] in 0..1, of which at most the first ``FRAMES`` are taken.

    ``reference`` [T, H, W, 3] gives the errors; None leaves them out.
    """
    pictures = [encode_webp(image) for image in images[:FRAMES]]
    if reference is None:
        return Film(pictures, [])
    pairs = zip(images[:FRAMES], reference[:FRAMES], strict=True)
    return Film(pictures, [_grey(error_map(np.asarray(image), wanted)) for image, wanted in pairs])


def frames_within(films: Mapping[str, Film], budget: int) -> int:
    """How many first frames of all films together take at most ``budget`` bytes as text in base64."""
    sizes = [[len(file) for file in files] for each in films.values() for files in each if files]
    if not sizes:
        return 0
    spent = np.cumsum([sum(4 * ((size + 2) // 3) for size in frame) for frame in zip(*sizes, strict=True)])
    return int(np.searchsorted(spent, budget, side="right"))


def encode_webp(image: Any) -> bytes:
    """The bytes of a lossy WebP of a display-encoded image [H, W, 3] in 0..1, at most ``WIDTH`` pixels wide.

    Pixels that are not finite are painted as in :func:`jaxdn.evaluation.report.images.encode_png`.
    """
    return _webp(_fitted(displayed_bytes(image)))


def _grey(error: np.ndarray) -> bytes:
    """An error map [H, W] in 0..1 as the square root of its values, full where not finite."""
    root = np.sqrt(np.clip(np.where(np.isnan(error), 1.0, error), 0.0, 1.0))
    grey = np.rint(255.0 * root).astype(np.uint8)
    return _webp(_fitted(np.repeat(grey[..., None], 3, axis=2)))


def _fitted(pixels: np.ndarray) -> Image.Image:
    picture = Image.fromarray(pixels)
    while picture.width > WIDTH:
        picture = picture.reduce(2)
    return picture


def _webp(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="WEBP", quality=QUALITY, method=4)
    return buffer.getvalue()
