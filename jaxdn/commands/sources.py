"""The table that ``jaxdn denoise`` and ``jaxdn inspect`` begin with: what is read from where, and what is missing."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from jaxdn.data.foreign.layers import LAYERS
from jaxdn.data.foreign.sources import Source, sources_of
from jaxdn.planning.plan import COMPOSED

CONSEQUENCES: dict[str, str] = {
    "albedo": "textures are blurred together with the noise",
    "normal": "edges where two surfaces of one depth meet are blurred",
    "depth": "edges between near and far are blurred, and what comes into view may keep a wrong history",
    "roughness": "every surface counts as diffuse: sharp reflections are blurred",
    "motion": "everything counts as still: what moves leaves trails",
    "ids": "things that touch are told apart by their normals and depths alone",
    "specular_reflectance": "light is divided by the albedo alone: more noise stays on glossy surfaces",
}
"""What it costs not to have a buffer that other renderers have a name for."""


def missing(found: Iterable[Source], reads: frozenset[str] | None) -> dict[str, str]:
    """Buffer -> the consequence of its absence, for those that a denoiser reads (None: any) and files may have."""
    there = {source.buffer for source in found}
    wanted = [name for name in LAYERS if name in CONSEQUENCES and name not in there]
    return {name: CONSEQUENCES[name] for name in wanted if reads is None or name in reads}


def show_sources(
    path: str | Path,
    *,
    reads: frozenset[str] | None = None,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    alone: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> list[Source]:
    """Print the table for a sequence and a denoiser that reads some buffers (None: any denoiser); returns its sources.

    An image that is ``alone`` needs no motion. Raises as :func:`jaxdn.data.foreign.sources.sources_of` does.
    """
    naming: Any = {"motion_convention": motion_convention, "channels": channels, "layer": layer}
    found = sources_of(path, alone=alone, log=log, **naming)
    table = Table(title=f"{path}: what is read", title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("buffer", "from layer", "channels", "taken for"):
        table.add_column(column, overflow="fold")
    for source in found:
        used = reads is None or source.buffer in reads | {"radiance"}
        note = "" if used else " (added back)" if source.buffer in COMPOSED else " (not used)"
        letters = ", ".join(name.rpartition(".")[2] for name in source.channels)
        table.add_row(source.buffer + note, source.layer, letters, source.convention)
    for name, consequence in missing(found, reads).items():
        if alone and name == "motion":
            continue
        table.add_row(name, "missing", "", consequence, style="yellow")
    Console().print(table)
    return found
