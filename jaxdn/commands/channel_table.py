"""The table that ``jaxdn denoise`` and ``jaxdn inspect`` begin with: what is read from where, and what is missing."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.table import Table

from jaxdn.data.foreign.channel_mapping import MappedBuffer
from jaxdn.data.foreign.layers import LAYERS
from jaxdn.planning.plan import COMPOSED
from jaxdn.runtime.terminal import plain_console

CONSEQUENCES: dict[str, str] = {
    "albedo": "textures are blurred together with the noise",
    "normal": "edges where two surfaces of one depth meet are blurred",
    "depth": "edges between near and far are blurred, and what comes into view may keep a wrong history",
    "roughness": "every surface counts as diffuse: sharp reflections are blurred",
    "motion": "it is measured from albedo or normals; without those too, everything that moves leaves trails",
    "ids": "things that touch are told apart by their normals and depths alone",
    "specular_hit_distance": "reflections are looked for where their surface was",
    "specular_reflectance": "light is divided by the albedo alone: more noise stays on glossy surfaces",
}
"""What it costs not to have a buffer that other renderers have a name for."""


def list_missing(mapping: Iterable[MappedBuffer], reads: frozenset[str] | None) -> dict[str, str]:
    """Buffer -> the consequence of its absence, for those that a denoiser reads (None: any) and files may have."""
    there = {mapped.buffer for mapped in mapping}
    wanted = [name for name in LAYERS if name in CONSEQUENCES and name not in there]
    return {name: CONSEQUENCES[name] for name in wanted if reads is None or name in reads}


def show_channel_mapping(
    path: str | Path,
    mapping: Sequence[MappedBuffer],
    *,
    reads: frozenset[str] | None = None,
    single: bool = False,
) -> None:
    """Print the table of a sequence for a denoiser that reads some buffers (None: any denoiser).

    A ``single`` image needs no motion.
    """
    table = Table(title=f"{path}: what is read", title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("buffer", "from layer", "channels", "taken for"):
        table.add_column(column, overflow="fold")
    for mapped in mapping:
        used = reads is None or mapped.buffer in reads | {"radiance"}
        note = "" if used else " (added back)" if mapped.buffer in COMPOSED else " (not used)"
        letters = ", ".join(name.rpartition(".")[2] for name in mapped.channels)
        table.add_row(mapped.buffer + note, mapped.layer, letters, mapped.convention)
    for name, consequence in list_missing(mapping, reads).items():
        if single and name == "motion":
            continue
        table.add_row(name, "missing", "", consequence, style="yellow")
    plain_console().print(table)
