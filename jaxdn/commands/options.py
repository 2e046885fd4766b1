"""What several commands make of their options."""

from pathlib import Path
from typing import TYPE_CHECKING

from jaxdn.commands.arguments import Denoise, Inspect

if TYPE_CHECKING:  # --help does not wait for jax
    from jaxdn.data.foreign.classify import ChannelNaming


def check_folder(out: Path) -> Path:
    """``-o`` of a command that writes into a folder. Raises ValueError for a file, and for what is plainly its name."""
    names = (".exr", ".png", ".safetensors", ".json", ".html", ".onnx", ".mlir", ".stablehlo")
    if out.is_file() or out.suffix.lower() in names:
        raise ValueError(f"-o {out}: expected a folder, got the name of a file.")
    return out


def name_channels(options: Inspect | Denoise) -> "ChannelNaming":
    """What is stated about the channels of other renderers' files."""
    from jaxdn.core.options import parse
    from jaxdn.data.foreign.classify import ChannelNaming

    return ChannelNaming(
        options.motion_convention,
        parse(options.channels, option="--channels", words=True),
        options.layer,
    )
