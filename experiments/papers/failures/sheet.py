"""Small images side by side under their names: of one clip, or of all."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxdn.evaluation.report.images import displayed_bytes
from jaxdn.runtime.atomic_files import write_atomically

COLUMNS = 4
ENLARGED = 3
"""Pixels of the sheet for one of an image, across and down."""
_LINE = 16
"""Height of a name in pixels."""
_NAMES = 160
"""Width of the column of names in pixels."""


def make_sheet(images: Mapping[str, np.ndarray]) -> np.ndarray:
    """[H, W, 3] in 0..1 of display-encoded images [h, w, 3], all of one size, row by row, enlarged without a filter.

    Raises ValueError for images of different sizes, or none.
    """
    sizes = {image.shape for image in images.values()}
    if len(sizes) != 1:
        raise ValueError(f"images: expected one size, got {sorted(sizes)}; crop them.")
    height, width, _ = (ENLARGED * side for side in sizes.pop())
    rows = -(-len(images) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * width, rows * (height + _LINE)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default()
    for number, (name, image) in enumerate(images.items()):
        row, column = divmod(number, COLUMNS)
        left, top = column * width, row * (height + _LINE)
        draw.text((left + 2, top + 2), name, fill="black", font=font)
        large = displayed_bytes(image).repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
        sheet.paste(Image.fromarray(large), (left, top + _LINE))
    return np.asarray(sheet, np.float64) / 255.0


def make_table(rows: Mapping[str, Sequence[np.ndarray]], columns: Sequence[str]) -> np.ndarray:
    """[H, W, 3] in 0..1: a row of images [h, w, 3] for each name, as large as they are, under the columns' names.

    Raises ValueError for rows that have not an image for each column.
    """
    if wrong := [name for name, images in rows.items() if len(images) != len(columns)]:
        raise ValueError(f"rows: expected {len(columns)} images in each, got others in {', '.join(wrong)}.")
    height, width, _ = next(iter(rows.values()))[0].shape
    sheet = Image.new("RGB", (_NAMES + len(columns) * width, _LINE + len(rows) * height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default()
    for number, name in enumerate(columns):
        draw.text((_NAMES + number * width + 2, 2), name, fill="black", font=font)
    for row, (name, images) in enumerate(rows.items()):
        draw.text((2, _LINE + row * height + height // 2 - 6), name, fill="black", font=font)
        for number, image in enumerate(images):
            place = (_NAMES + number * width, _LINE + row * height)
            sheet.paste(Image.fromarray(displayed_bytes(image)), place)
    return np.asarray(sheet, np.float64) / 255.0


def save_webp(path: Path, image: np.ndarray) -> None:
    """Write a display-encoded image [H, W, 3] in 0..1 as a small file for a page."""
    file = io.BytesIO()
    Image.fromarray(displayed_bytes(image)).save(file, "WEBP", quality=90)
    write_atomically({path: file.getvalue()})
