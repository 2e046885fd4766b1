"""A denoised frame of another renderer: its own file with the beauty replaced, everything else as it was."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxdn.data.exr.exr import read_windows, rewrite_exr
from jaxdn.data.exr.windows import Window, cut
from jaxdn.data.foreign.layers import Channels, beauty, detect_channels, grouped, layer_of


def write_result(
    source: Path,
    target: Path,
    images: Mapping[str, np.ndarray],
    canvas: Window,
    *,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    only_beauty: bool = False,
) -> list[str]:
    """Write a file's denoised beauty, with all other layers, metadata, windows and parts of the file; or alone.

    Returns what could not be kept, in sentences. Raises as :func:`jaxdn.data.exr.exr.rewrite_exr` does.

    Args:
      source: the renderer's file.
      target: the file to write.
      images: layer -> denoised image [H, W, 3] of the canvas; "" is the beauty.
      canvas: which pixels of the picture the images are (:func:`jaxdn.data.foreign.import_exr.canvas_of`).
      channels: how the beauty was found, see :func:`jaxdn.data.foreign.layers.detect_channels`.
      layer: the same.
      only_beauty: write R, G, B, and A where there is one, and nothing else.
    """
    _, windows = read_windows(source)
    names = list(windows)
    place = beauty(names, detect_channels(names, channels=channels, layer=layer))
    groups = grouped(names)
    replaced = {}
    for name, image in images.items():
        for channel, pixels in zip(_color(groups, name) if name else place, np.moveaxis(image, -1, 0), strict=True):
            replaced[channel] = cut(pixels, canvas, windows[channel])
    if not only_beauty:
        return rewrite_exr(source, target, replaced)
    beside = groups[layer_of(place) if "." in place[0] else ""]
    alpha = beside.get("a") or groups.get("", {}).get("a")
    kept = dict(zip(place, "RGB", strict=True)) | ({} if alpha is None else {alpha: "A"})
    return rewrite_exr(source, target, replaced, only=kept)


def _color(groups: Mapping[str, Mapping[str, str]], layer: str) -> Channels:
    return tuple(groups[layer][letter] for letter in "rgb")
