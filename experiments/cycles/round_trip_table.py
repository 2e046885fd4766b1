"""The rows of ``experiments.cycles.round_trip`` as a table of docs/results: ``files-blender.json``.

    python -m experiments.cycles.round_trip_table runs/round-trip -o runs

It runs with the Python that has jaxdn, at the revision that made the rows.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.measurement import describe_measurement
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json

COLUMNS: dict[str, dict[str, Any]] = {
    "kind": {"name": "kind"},
    "parts": {"name": "parts"},
    "changed": {"name": "channels changed"},
    "kept": {"name": "kept"},
    "noisy": {"name": "PSNR, noisy", "decimals": 2},
    "denoised": {"name": "denoised", "decimals": 2},
    "bytes in": {"name": "bytes in"},
    "bytes out": {"name": "bytes out"},
    "inspect, s": {"name": "inspect, s", "decimals": 1},
    "denoise, s": {"name": "denoise, s", "decimals": 1},
    "frame, s": {"name": "a frame, s", "decimals": 2},
    "page, s": {"name": "page, s", "decimals": 1},
    "page, bytes": {"name": "page, bytes"},
    "OpenImageIO": {"name": "OpenImageIO differs by"},
    "Blender": {"name": "Blender differs by"},
}
"""Key of a row -> column."""
WHAT = (
    "Three frames of {size} that Blender {blender} writes, {samples} sample{s} a pixel, through `jaxdn denoise` by "
    "{method}, and opened again. Every other channel, type, size and attribute is as it was (checked bit by bit). PSNR "
    "of x / (1 + x) in dB of the last frame, against {reference} samples. Bytes are of one file with the beauty. "
    "Seconds are those of whole processes (*denoise*: three frames, with its start), but *a frame*, which is the time "
    "between two results; *page* is `jaxdn inspect --overlay`. *Differs* is the largest difference of any channel "
    "(OpenImageIO) or of the beauty (the image node of Blender's compositor) from what OpenEXR reads."
)


@dataclass
class Options:
    """Write the table of a run."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("runs")
    """Folder that gets files-blender.json."""
    note: str = ""
    """A sentence on the machine's load."""


def table(run: Mapping[str, Any], note: str = "") -> dict[str, Any]:
    """The measurement of a run: its settings and rows."""
    settings = run["settings"]
    what = WHAT.format(**settings | {"size": "{} x {}".format(*settings["size"])}, s="s" * (settings["samples"] != 1))
    rows: Sequence[Mapping[str, Any]] = run["rows"]
    described = describe_measurement(
        "table",
        "Files of Blender, there and back",
        "Sequences",
        216,
        command="python -m experiments.cycles.round_trip runs/round-trip",
        what=f"{what} {note}".strip(),
        rows=[[row[key] for key in COLUMNS] for row in rows],
    )
    return {**described, "columns": list(COLUMNS.values())}


def main(options: Options) -> int:
    """Write the table."""
    run = json.loads((options.folder / "round-trip.json").read_text("utf-8"))
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "files-blender.json", table(run, options.note))
    return 0


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
