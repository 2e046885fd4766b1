"""``jaxdn inspect`` on files of other renderers: what is read from where, what is missing, and what is to be stated."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxdn.commands.sources import missing, show_sources
from jaxdn.data.clip.folder import refuse_unfinished
from jaxdn.data.foreign.import_exr import canvas_of, fitting_files
from jaxdn.data.foreign.shots import sequence_files
from jaxdn.data.foreign.sources import UNSTATED, sources_of
from jaxdn.data.foreign.vectors import CHOICES


def inspect_files(
    source: str,
    *,
    reads: frozenset[str] | None,
    as_json: bool,
    motion_convention: str | None,
    channels: Mapping[str, str] | None,
    layer: str | None,
) -> None:
    """Print what is read of a sequence, what is missing, and which conventions motion vectors may have.

    Only the first two files are read, of the others the headers. Raises ClipError as
    :func:`jaxdn.data.foreign.sources.sources_of` and :func:`jaxdn.data.foreign.import_exr.fitting_files` do, for files
    of different sizes, and for a clip of ours that was not finished.

    Args:
      source: a folder of, a pattern for, or the name of EXR files.
      reads: what a denoiser reads; None: any.
      as_json: print only one JSON object, with the same.
      motion_convention: as in :func:`jaxdn.clips.open_frames`.
      channels: the same.
      layer: the same.
    """
    refuse_unfinished(source)
    naming: dict[str, Any] = {"channels": channels, "layer": layer}
    notes: list[str] = []
    if as_json:
        found = sources_of(source, motion_convention=motion_convention, log=notes.append, **naming)
    else:
        found = show_sources(source, reads=reads, motion_convention=motion_convention, log=print, **naming)
    files = sequence_files(source)
    canvas = canvas_of(files)
    unstated = any(one.convention == UNSTATED for one in found)
    fitting = fitting_files(files, canvas, **naming) if unstated else None
    height, width = canvas.size
    if not as_json:
        print(f"{len(files)} {'frame' if len(files) == 1 else 'frames'} of {width} x {height} pixels")
        if fitting is not None:
            print("\n".join(_to_state(files, fitting)))
        return
    record = {
        "frames": len(files),
        "width": width,
        "height": height,
        "sources": [one._asdict() for one in found],
        "missing": missing(found, reads),
        "notes": notes,
        "fitting_conventions": fitting,
    }
    print(json.dumps(record, indent=1))


def _to_state(files: Sequence[Path], fitting: Sequence[str]) -> list[str]:
    """What to state about motion vectors, as lines: the conventions that fit, or all where nothing is known."""
    pair = " and ".join(file.name for file in files[:2])
    if fitting:
        order = ", the best first" if len(fitting) > 1 else ""
        request = f"State what brings {pair} onto each other{order}"
    elif len(files) == 1:
        request = "One frame alone does not tell, and needs no motion; for a shot, state one of these"
    else:
        request = f"None brings {pair} onto each other, as where too little moves; state one of these"
    lines = [f"  --motion-convention {name:<18}{CHOICES[name]}" for name in fitting or CHOICES]
    return [f"Nothing says what the motion vectors mean. {request}:", *lines]
