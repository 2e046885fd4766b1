"""``jaxdn inspect`` on files of other renderers: what is read from where, what is missing, and what is to be stated."""

import json
from collections.abc import Sequence
from pathlib import Path

from jaxdn.commands.channel_table import missing, show_channel_mapping
from jaxdn.data.clip.folder import refuse_unfinished
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import UNSTATED, read_channel_mapping
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.data.foreign.shots import find_sequence
from jaxdn.data.foreign.soundness import find_unusable
from jaxdn.data.foreign.vectors import CHOICES


def inspect_files(source: str, *, reads: frozenset[str] | None, as_json: bool, naming: ChannelNaming) -> None:
    """Print what is read of a sequence, what is missing, and which conventions motion vectors may have.

    Only the first two files are read, of the others the headers. Raises ClipError as
    :func:`jaxdn.data.foreign.channel_mapping.read_channel_mapping` and
    :meth:`jaxdn.data.foreign.import_exr.ForeignSequence.fitting_conventions` do, where no file is usable, and for a
    clip of ours that was not finished.

    Args:
      source: a folder of, a pattern for, or the name of EXR files.
      reads: what a denoiser reads; None: any.
      as_json: print only one JSON object, with the same.
      naming: what is stated about the channels.
    """
    refuse_unfinished(source)
    files = find_sequence(source)
    opened = [ExrFile(file) for file in files]
    unusable = {files[index].name: reason for index, reason in find_unusable(opened, naming).items()}
    opened = [file for file in opened if file.path.name not in unusable]
    sequence = ForeignSequence(opened, naming)
    notes: list[str] = []
    mapping = read_channel_mapping(sequence.files[0], naming, log=notes.append if as_json else print)
    if not as_json:
        show_channel_mapping(source, mapping, reads=reads)
    height, width = sequence.window.size
    unstated = any(mapped.convention == UNSTATED for mapped in mapping)
    fitting = sequence.fitting_conventions() if unstated else None
    if not as_json:
        print(f"{len(opened)} {'frame' if len(opened) == 1 else 'frames'} of {width} x {height} pixels")
        for name, reason in unusable.items():
            print(f"{name} counts as a missing frame: {reason}")
        if fitting is not None:
            print("\n".join(_to_state([file.path for file in opened], fitting)))
        return
    record = {
        "frames": len(opened),
        "width": width,
        "height": height,
        "sources": [mapped._asdict() for mapped in mapping],
        "missing": missing(mapping, reads),
        "notes": notes,
        "unusable": unusable,
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
