"""A denoised frame of another renderer: its own file with the beauty replaced, everything else as it was."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.data.exr.exr import rewrite_exr
from jaxdn.data.exr.file import ExrFile, Window, crop
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.layers import Channels, beauty_channels, find_alpha, group_layers


class NewPixels(NamedTuple):
    """What is new in a file; channels by the names that they have in it."""

    replaced: dict[str, np.ndarray]
    """Channel -> pixels of its data window."""
    beauty: dict[str, str]
    """Channel -> R, G, B (or Y, without colours) or A, of the beauty and of the alpha beside it."""

    def with_view(self, view: str, other: "NewPixels") -> "NewPixels":
        """These with those of another view of the same file."""
        named = {channel: f"{view}.{letter}" for channel, letter in other.beauty.items()}
        return NewPixels(self.replaced | other.replaced, self.beauty | named)


def replace_channels(
    source: ExrFile,
    images: Mapping[str, np.ndarray],
    window: Window,
    naming: ChannelNaming,
    *,
    alpha: np.ndarray | None = None,
) -> NewPixels:
    """What denoised images are in their file. Raises as its channels do.

    Args:
      source: the renderer's file, or a view of it.
      images: layer -> denoised image [H, W, 3] of the window; "" is the beauty.
      window: which pixels of the picture the images are (:attr:`jaxdn.data.foreign.import_exr.ForeignSequence.window`).
      naming: how the beauty was found.
      alpha: denoised alpha [H, W] of the window, beside the beauty; None: it stays.
    """
    source.decode()  # first, as the windows are those of the decoded headers then
    windows = source.windows
    names = list(windows)
    beauty = beauty_channels(names, naming.detect(names))
    groups = group_layers(names)
    replaced = {}
    for layer, image in images.items():
        channels = _color(groups, layer) if layer else beauty
        if len(set(channels)) == 1:  # a picture without colours
            image = np.repeat(image.mean(axis=-1, keepdims=True), 3, axis=-1)
        for channel, pixels in zip(channels, np.moveaxis(image, -1, 0), strict=True):
            replaced[channel] = crop(pixels, window, windows[channel])
    beside = find_alpha(names, beauty)
    if alpha is not None and beside is not None:
        replaced[beside] = crop(alpha, window, windows[beside])
    kept = dict(zip(beauty, "RGB" if len(set(beauty)) > 1 else "YYY", strict=True)) | (
        {} if beside is None else {beside: "A"}
    )
    return NewPixels(
        {source.full_name(name): pixels for name, pixels in replaced.items()},
        {source.full_name(name): letter for name, letter in kept.items()},
    )


def write_result(source: ExrFile, target: Path, new: NewPixels, *, only_beauty: bool = False) -> list[str]:
    """Write a file with new pixels, and all other layers, metadata, windows and parts of it.

    Returns what could not be kept, in sentences. Raises as :func:`jaxdn.data.exr.exr.rewrite_exr` does.

    Args:
      source: the renderer's file.
      target: the file to write.
      new: what is new.
      only_beauty: write R, G, B, and A where there is one, and nothing else.
    """
    return rewrite_exr(source, target, new.replaced, only=new.beauty if only_beauty else None)


def _color(groups: Mapping[str, Mapping[str, str]], layer: str) -> Channels:
    return tuple(groups[layer][letter] for letter in "rgb")
