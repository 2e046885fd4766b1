"""Frame numbers in the names of files: ``shot_0001.exr``, ``shot.-003.exr``, ``0001_L.exr``, ``shot.0001.beauty.exr``.

Which of several numbers counts the frames is told by the files together: it is the last one that differs among names
that are otherwise alike. Numbers between dots may be subframes, ``shot.12.50.exr``.
"""

import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

_RUN = re.compile(r"(?:(?:^|(?<=[._-]))-)?\d+")
"""A number; a minus belongs to it after a separator or at the beginning."""
_INSIDE = 4
"""Digits of a number that counts frames though letters touch it and more follows, as in ``frame0001_left``."""


class FrameName(NamedTuple):
    """What a name says about a file."""

    file: Path
    shot: str
    """The name with ``#`` in place of the frame's number, without the suffix."""
    number: Fraction | None
    """None: there is no frame number in the name."""


def read_frame_names(files: Iterable[Path]) -> list[FrameName]:
    """The shot and the frame number of each file, in the order of the files."""
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for file in files:
        groups.setdefault((file.parent, _RUN.sub("#", file.stem), file.suffix.lower()), []).append(file)
    named = {name.file: name for group in groups.values() for name in _read_group(group)}
    return [named[file] for group in groups.values() for file in group]


def _read_group(files: Sequence[Path]) -> list[FrameName]:
    """Names that are alike but for their numbers."""
    runs = [list(_RUN.finditer(file.stem)) for file in files]
    values = [[int(run[0]) for run in each] for each in runs]
    places = range(len(runs[0]))
    varying = [place for place in places if len({each[place] for each in values}) > 1]
    ranks = {place: _rank(runs[0], place, files[0].stem) for place in places}
    # A number that differs comes first, but for one that letters touch: of sh0010_0001, sh0020_0001 it is the shot's.
    scores = [(rank + 1.5 * (rank > 0 and place in varying), place) for place, rank in ranks.items()]
    rank, place = max(scores, default=(0, -1))
    if rank == 0:
        return [FrameName(file, file.stem, None) for file in files]
    parts = _subframes(files, runs, place) if place - 1 in varying else None
    names = []
    for index, (file, found) in enumerate(zip(files, runs, strict=True)):
        start = found[place].start() if parts is None else found[place - 1].start()
        shot = f"{file.stem[:start]}#{file.stem[found[place].end() :]}"
        names.append(FrameName(file, shot, Fraction(values[index][place]) if parts is None else parts[index]))
    return names


def _rank(runs: Sequence[re.Match[str]], place: int, stem: str) -> int:
    """How much like a frame number a number looks: 3 best, 0 not at all."""
    run = runs[place]
    before, after = stem[: run.start()][-1:], stem[run.end() :][:1]
    digits = len(run[0].lstrip("-"))
    if before in "._-" and after in "._-":  # "" is in every string: the beginning, and the end
        return 3
    if not after:
        return 3 if digits > 2 else 2
    return 1 if digits >= _INSIDE else 0


def _subframes(files: Sequence[Path], runs: Sequence[Sequence[re.Match[str]]], place: int) -> list[Fraction] | None:
    """Numbers with fractions, where the last two numbers are that: 1.0, 1.5, 2.0, or 1.00, 1.33, 1.67; None elsewhere.

    Fractions are those of equal steps from 0 on. Others are no fractions but frames of numbered shots.
    """
    first, second = runs[0][place - 1], runs[0][place]
    if files[0].stem[first.end() : second.start()] != "." or any(run[place][0].startswith("-") for run in runs):
        return None
    digits = {run[place][0] for run in runs}
    decimals = sorted({Fraction(int(text), 10 ** len(text)) for text in digits})
    steps = len(decimals)
    rough = Fraction(1, 10 ** min(len(text) for text in digits))
    if steps < 2 or any(abs(value - Fraction(i, steps)) >= rough for i, value in enumerate(decimals)):
        return None
    numbers = []
    for run in runs:
        whole, text = run[place - 1][0], run[place][0]
        part = Fraction(round(Fraction(int(text), 10 ** len(text)) * steps), steps)
        numbers.append(int(whole) - part if whole.startswith("-") else int(whole) + part)
    return numbers
