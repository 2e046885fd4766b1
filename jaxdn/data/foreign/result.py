"""A denoised frame of another renderer: its own file with the beauty replaced, everything else as it was."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxdn.data.exr.exr import rewrite_exr
from jaxdn.data.exr.file import ExrFile, Window, crop
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.layers import Channels, beauty_channels, find_alpha, group_layers


def write_result(
    source: ExrFile,
    target: Path,
    images: Mapping[str, np.ndarray],
    window: Window,
    naming: ChannelNaming,
    *,
    alpha: np.ndarray | None = None,
    only_beauty: bool = False,
) -> list[str]:
    """Write a file's denoised beauty, with all other layers, metadata, windows and parts of the file; or alone.

    Returns what could not be kept, in sentences. Raises as :func:`jaxdn.data.exr.exr.rewrite_exr` does.

    Args:
      source: the renderer's file.
      target: the file to write.
      images: layer -> denoised image [H, W, 3] of the window; "" is the beauty.
      window: which pixels of the picture the images are (:attr:`jaxdn.data.foreign.import_exr.ForeignSequence.window`).
      naming: how the beauty was found.
      alpha: denoised alpha [H, W] of the window, beside the beauty; None: it stays.
      only_beauty: write R, G, B, and A where there is one, and nothing else.
    """
    source.decode()  # first, as the windows are those of the decoded headers then
    windows = source.windows
    names = list(windows)
    beauty = beauty_channels(names, naming.detect(names))
    groups = group_layers(names)
    replaced = {}
    for layer, image in images.items():
        channels = _color(groups, layer) if layer else beauty
        for channel, pixels in zip(channels, np.moveaxis(image, -1, 0), strict=True):
            replaced[channel] = crop(pixels, window, windows[channel])
    beside = find_alpha(names, beauty)
    if alpha is not None and beside is not None:
        replaced[beside] = crop(alpha, window, windows[beside])
    if not only_beauty:
        return rewrite_exr(source, target, replaced)
    kept = dict(zip(beauty, "RGB", strict=True)) | ({} if beside is None else {beside: "A"})
    return rewrite_exr(source, target, replaced, only=kept)


def _color(groups: Mapping[str, Mapping[str, str]], layer: str) -> Channels:
    return tuple(groups[layer][letter] for letter in "rgb")
