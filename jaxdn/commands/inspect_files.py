"""``jaxdn inspect`` on files of other renderers: what is read from where, what is missing, and what is to be stated."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxdn.commands.channel_table import missing, show_channel_mapping
from jaxdn.data.clip.folder import refuse_unfinished
from jaxdn.data.errors import DamagedFile
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import UNSTATED, MappedBuffer, read_channel_mapping
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.data.foreign.passes import join_passes
from jaxdn.data.foreign.shots import Shot, find_shots, ranges
from jaxdn.data.foreign.shots import missing as missing_numbers
from jaxdn.data.foreign.soundness import find_unusable
from jaxdn.data.foreign.vectors import CHOICES
from jaxdn.data.foreign.views import open_views, select_view


def inspect_files(
    source: str | Sequence[Path], *, reads: frozenset[str] | None, as_json: bool, naming: ChannelNaming
) -> None:
    """Print what is read of each shot, what is missing, and which conventions motion vectors may have.

    Only the first two files of a shot are read, of the others the headers. Raises ClipError as
    :func:`jaxdn.data.foreign.channel_mapping.read_channel_mapping` and
    :meth:`jaxdn.data.foreign.import_exr.ForeignSequence.fitting_conventions` do, where no file is usable, and for a
    clip of ours that was not finished.

    Args:
      source: a folder of, a pattern for, or the name of EXR files; or several files.
      reads: what a denoiser reads; None: any.
      as_json: print only one JSON object, with the same; of several shots, one that lists theirs.
      naming: what is stated about the channels.
    """
    if isinstance(source, str):
        refuse_unfinished(source)
    shots, notes = join_passes(find_shots(source), naming.pass_files)
    if not as_json:
        print("".join(f"{note}\n" for note in notes), end="")
    records = {}
    for shot in select_view(shots, naming.view):
        for view, files in open_views(shot, naming.view).items():
            label = f"{shot.label}{view and f' ({view})'}"
            records[label] = _inspect_shot(shot, files, label, reads, naming, quiet=as_json)
    if as_json:
        several = {"shots": [{"shot": label, **record} for label, record in records.items()]}
        print(json.dumps(several if len(records) > 1 else next(iter(records.values())), indent=1))


def _inspect_shot(
    shot: Shot,
    every: Sequence[ExrFile],
    label: str,
    reads: frozenset[str] | None,
    naming: ChannelNaming,
    *,
    quiet: bool,
) -> dict[str, Any]:
    """What is read of a shot, or of one view of it, for JSON; printed too unless ``quiet``."""
    unusable = {every[index].path.name: reason for index, reason in find_unusable(every, naming).items()}
    opened = [file for file in every if file.path.name not in unusable]
    notes: list[str] = []
    mapping: list[MappedBuffer] | None = None
    while mapping is None:
        try:
            mapping = read_channel_mapping(opened[0], naming, log=notes.append)
        except DamagedFile as error:
            unusable[error.path.name] = error.reason
            if len(opened) == 1:
                raise
            del opened[0]
    sequence = ForeignSequence(opened, naming)
    height, width = sequence.window.size
    unstated = any(mapped.convention == UNSTATED for mapped in mapping)
    fitting = sequence.fitting_conventions() if unstated else None
    gaps = f"{ranges(missing_numbers(shot.numbers))} missing" if missing_numbers(shot.numbers) else None
    if not quiet:
        for note in notes:
            print(note)
        show_channel_mapping(label, mapping, reads=reads)
        print(f"{len(opened)} {'frame' if len(opened) == 1 else 'frames'} of {width} x {height} pixels")
        for name, reason in unusable.items():
            print(f"{name} counts as a missing frame: {reason}")
        if gaps is not None:
            print(f"{gaps}; after a gap there is no history at first")
        if fitting is not None:
            print("\n".join(_to_state([file.path for file in opened], fitting)))
    return {
        "frames": len(opened),
        "width": width,
        "height": height,
        "sources": [mapped._asdict() for mapped in mapping],
        "missing": missing(mapping, reads),
        "notes": notes if gaps is None else [*notes, gaps],
        "unusable": unusable,
        "fitting_conventions": fitting,
    }


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
