"""``jaxdn inspect`` on files of other renderers: what is read from where, what is missing, and what is to be stated."""

import itertools
import json
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxdn.commands.channel_table import list_missing, show_channel_mapping
from jaxdn.commands.progress import reporter
from jaxdn.data.clip.folder import refuse_unfinished
from jaxdn.data.errors import ClipError, DamagedFile
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import MappedBuffer, lacks_convention, read_channel_mapping
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.data.foreign.odd_values import choose_frames, find_odd_values
from jaxdn.data.foreign.passes import join_passes
from jaxdn.data.foreign.shots import Shot, find_missing, find_shots, ranges
from jaxdn.data.foreign.soundness import find_unusable
from jaxdn.data.foreign.vectors import CHOICES, MOTION_CONVENTIONS
from jaxdn.data.foreign.views import explain_views, open_views, select_view

if TYPE_CHECKING:
    from jaxdn.evaluation.overlay import Overlay

LEAST_SIDE = 4
"""Pixels; smaller frames have no slopes to measure motion and orientation by."""


def inspect_files(
    source: str | Sequence[Path],
    *,
    reads: frozenset[str] | None,
    as_json: bool,
    naming: ChannelNaming,
    overlay: Path | None = None,
) -> None:
    """Print what is read of each shot, what is missing, and which conventions motion vectors may have.

    Of a shot, the first two files and some others are read (:func:`jaxdn.data.foreign.odd_values.choose_frames`), of
    the rest the headers, unless there is an ``overlay``. Raises
    ClipError as :func:`jaxdn.data.foreign.channel_mapping.read_channel_mapping` and
    :meth:`jaxdn.data.foreign.import_exr.ForeignSequence.fitting_conventions` do, where no file is usable, and for a
    clip of ours that was not finished.

    Args:
      source: a folder of, a pattern for, or the name of EXR files; or several files.
      reads: what a denoiser reads; None: any.
      as_json: print only one JSON object, with the same; of several shots, one that lists theirs.
      naming: what is stated about the channels.
      overlay: folder for the validation page; of several shots, for a folder of each.
    """
    if isinstance(source, str):
        refuse_unfinished(source)
    shots, notes = join_passes(find_shots(source), naming.pass_files)
    opened = [(shot, open_views(shot, naming.view)) for shot in select_view(shots, naming.view)]
    notes += [note for shot, views in opened for note in explain_views(shot.label, views)]
    if not as_json:
        print("".join(f"{note}\n" for note in notes), end="")
    views = [(shot, view, files) for shot, there in opened for view, files in there.items()]
    folders = _overlay_folders([f"{shot.name or shot.files[0].stem} {view}" for shot, view, _ in views], overlay)
    records = {}
    # OpenEXR prints about damaged files, which would be no JSON.
    with redirect_stdout(sys.stderr) if as_json else nullcontext():
        for (shot, view, files), folder in zip(views, folders, strict=True):
            label = f"{shot.label}{view and f' ({view})'}"
            records[label] = _inspect_shot(shot, files, label, reads, naming, folder, quiet=as_json)
    if as_json:
        several = {"shots": [{"shot": label, **record} for label, record in records.items()]}
        print(json.dumps(several if len(records) > 1 else next(iter(records.values())), indent=1))


def _overlay_folders(names: Sequence[str], overlay: Path | None) -> list[Path | None]:
    """Of each shot or view of these names, the folder for its validation page."""
    if overlay is None or len(names) == 1:
        return [overlay] * len(names)
    plain = [re.sub(r"[^\w.-]+", "_", name).strip("._") or "shot" for name in names]
    return [overlay / (name if plain.count(name) == 1 else f"{name}_{index}") for index, name in enumerate(plain)]


def _inspect_shot(
    shot: Shot,
    every: Sequence[ExrFile],
    label: str,
    reads: frozenset[str] | None,
    naming: ChannelNaming,
    overlay: Path | None,
    *,
    quiet: bool,
) -> dict[str, Any]:
    """What is read of a shot, or of one view of it, for JSON; printed too unless ``quiet``."""
    unusable = {label_file(every[index].path): reason for index, reason in find_unusable(every, naming).items()}
    opened = [file for file in every if label_file(file.path) not in unusable]
    notes: list[str] = []
    mapping: list[MappedBuffer] | None = None
    while mapping is None:
        try:
            mapping = read_channel_mapping(opened[0], naming, log=notes.append)
        except DamagedFile as error:
            unusable[label_file(error.path)] = error.reason
            if len(opened) == 1:
                raise
            del opened[0]
    height, width = ForeignSequence(opened, naming).window.size
    if overlay is not None and min(height, width) < LEAST_SIDE:
        raise ClipError(
            f"--overlay: expected {LEAST_SIDE} pixels a side or more, got {width} x {height}; leave it out."
        )
    # Vectors of 0, as a first frame has them, count as missing in its table.
    unstated = lacks_convention(opened[0], naming)
    fitting: list[str] | None = None
    while unstated and fitting is None:
        try:
            fitting = ForeignSequence(opened, naming).fitting_conventions()
        except DamagedFile as error:  # the second one: the first is decoded already
            unusable[label_file(error.path)] = error.reason
            del opened[1]
    looked = choose_frames(opened)
    odd = [line for line in find_odd_values(looked, naming, unexplained=unstated) if line not in notes]
    gaps = f"{ranges(find_missing(shot.numbers))} missing" if find_missing(shot.numbers) else None
    if not quiet:
        for note in notes:
            print(note)
        show_channel_mapping(label, mapping, reads=reads)
        print(f"{len(opened)} {'frame' if len(opened) == 1 else 'frames'} of {width} x {height} pixels")
        for name, reason in unusable.items():
            print(f"{name} counts as a missing frame: {reason}")
        if gaps is not None:
            print(f"{gaps}; after a gap there is no history at first")
        for line in odd:
            print(line)
        print(f"values were looked at in {_list_names(looked, len(opened))}")
        if fitting is not None:
            print("\n".join(_to_state([file.path for file in opened], fitting)))
    checked = (
        None
        if overlay is None
        else _check(shot, label, opened, naming, mapping, unusable, gaps, fitting, overlay, quiet=quiet)
    )
    return {
        "frames": len(opened),
        "width": width,
        "height": height,
        "sources": [mapped._asdict() for mapped in mapping],
        "missing": list_missing(mapping, reads),
        "notes": [*notes, *odd, *([] if gaps is None else [gaps])],
        "looked_at": [label_file(file.path) for file in looked],
        "unusable": unusable,
        "fitting_conventions": fitting,
    } | ({} if checked is None else {"overlay": str(checked.page), "findings": [f._asdict() for f in checked.findings]})


def _list_names(looked: Sequence[ExrFile], count: int) -> str:
    """The frames whose values were looked at, in words."""
    names = ", ".join(label_file(file.path) for file in looked)
    return f"all frames ({names})" if len(looked) == count > 1 else names


def _check(
    shot: Shot,
    label: str,
    opened: Sequence[ExrFile],
    naming: ChannelNaming,
    mapping: Sequence[MappedBuffer],
    unusable: Mapping[str, str],
    gaps: str | None,
    fitting: Sequence[str] | None,
    out: Path,
    *,
    quiet: bool,
) -> "Overlay":
    """The validation page of a shot; what was found is printed unless ``quiet``."""
    from jaxdn.evaluation.overlay import write_overlay  # --help and the table do not wait for jax

    said = next((mapped.convention for mapped in mapping if mapped.buffer == "motion"), None)
    count = itertools.count(1)
    with nullcontext() if quiet else reporter("overlay") as report:
        checked = write_overlay(
            opened,
            naming,
            mapping,
            out,
            title=label,
            convention=next((name for name, words in MOTION_CONVENTIONS.items() if words == said), None),
            unusable=unusable,
            missing=(gaps or "").removesuffix(" missing"),
            breaks=_without_one_before(shot, opened),
            unexplained=fitting,
            on_frame=lambda path: None if report is None else report.on_frame(path, next(count), len(opened)),
        )
    if not quiet:
        for finding in checked.findings:
            print(f"{finding.name}: {finding.evidence} {finding.remedy}")
        print(f"{len(checked.findings)} finding{'s' * (len(checked.findings) != 1)}; page: {checked.page}")
    return checked


def _without_one_before(shot: Shot, opened: Sequence[ExrFile]) -> set[Path]:
    """The files that are frames of a shot and do not follow another one."""
    numbers = dict(zip(shot.files, shot.numbers, strict=False))
    there = {numbers[file.path] for file in opened if file.path in numbers}
    return {file.path for file in opened if file.path in numbers and numbers[file.path] - shot.step not in there}


def _to_state(files: Sequence[Path], fitting: Sequence[str]) -> list[str]:
    """What to state about motion vectors, as lines: the conventions that fit, or all where nothing is known."""
    pair = " and ".join(map(label_file, files[:2]))
    if fitting:
        order = ", the best first" if len(fitting) > 1 else ""
        request = f"State what brings {pair} onto each other{order}"
    elif len(files) == 1:
        request = "One frame alone does not tell, and needs no motion; for a shot, state one of these"
    else:
        request = f"None brings {pair} onto each other, as where too little moves; state one of these"
    lines = [f"  --motion-convention {name:<18}{CHOICES[name]}" for name in fitting or CHOICES]
    return [f"Nothing says what the motion vectors mean. {request}:", *lines]
