"""Frame numbers in the names of files: ``shot_0001.exr``, ``shot.-003.exr``, ``0001_L.exr``, ``shot.0001.beauty.exr``.

Which of several numbers counts the frames is told by the files together: it is the last one that differs among names
that are otherwise alike. Numbers between dots may be subframes, ``shot.12.50.exr``; whole frames between them may lack
the zero, ``shot.12.exr``, as Houdini's ``$FF`` writes them. Files without a number may lie in a folder for each frame,
``0001/beauty.exr`` or ``frame_0001/beauty.exr``.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

_MINUS = "\N{MINUS SIGN}"
"""In place of a dash that is a minus for sure."""
_RUN = re.compile(rf"(?:(?:^|(?<=[._-]))-|{_MINUS})?\d+")
"""A number; a dash is its minus after a separator or at the beginning."""
_ENDS = "._- ()[]{}#,+=@"
"""What a name is parted by."""
_FOLDER = re.compile(r"(?:(?:frame|fr|f)[._ -]?)?(-?\d+)", re.IGNORECASE)
"""The name of a folder that holds one frame. ``sh010`` and ``v02`` are shots and versions."""
_PARTS = 2
"""Digits that the parts of a single frame have; ``s.1.0``, ``s.1.5`` may be versions."""
_FARTHEST = 10**7
"""Numbers that lie farther apart are times, and no frames are missing between them."""
_INSIDE = 4
"""Digits of a number that counts frames though letters touch it and more follows, as in ``frame0001_left``."""


class FrameName(NamedTuple):
    """What a name says about a file."""

    file: Path
    shot: str
    """The name with ``#`` in place of the frame's number, without the suffix; ``#/beauty`` where a folder has it."""
    number: Fraction | None
    """None: there is no frame number in the name."""


def read_frame_names(files: Iterable[Path]) -> list[FrameName]:
    """The shot and the frame number of each file, in the order of the files."""
    files = list(files)
    groups: dict[_Alike, dict[Path, str]] = {}
    for file in files:
        alike = _Alike(file.parent, _RUN.sub("#", file.stem), file.suffix.lower())
        groups.setdefault(alike, {})[file] = file.stem
    for alike in [alike for alike in groups if "-#" in alike.name]:
        _add_negative_frames(groups, alike)
    for alike in [alike for alike in groups if alike.name.count("#.#") == 1]:
        _add_whole_frames(groups, alike)
    named = {name.file: name for group in groups.values() for name in _read_group(group)}
    named |= _read_folders(name.file for name in named.values() if name.number is None)
    return [named[file] for file in files]


def is_frame_folder(folder: Path) -> bool:
    """Whether the name of a folder is the number of a frame."""
    return _FOLDER.fullmatch(folder.name) is not None


def label_file(file: Path) -> str:
    """What a file is called in messages: its name, with its folder where that alone has the frame's number."""
    bare = is_frame_folder(file.parent) and not any(char.isdigit() for char in file.stem)
    return f"{file.parent.name}/{file.name}" if bare else file.name


class _Alike(NamedTuple):
    """What names have in common that are alike but for their numbers."""

    folder: Path
    name: str
    """With ``#`` for each number."""
    suffix: str


def _add_negative_frames(groups: dict[_Alike, dict[Path, str]], alike: _Alike) -> None:
    """Give ``s0000.exr``, ``s0001.exr`` ... the ``s-0001.exr`` beside them, as Blender calls the frame before 0.

    A dash that parts a name from its number is none of them: where a number is there with it and without, or where no
    frame 0 joins the two.
    """
    start = alike.name.rindex("-#")
    plain = alike._replace(name=f"{alike.name[:start]}{alike.name[start + 1 :]}")
    place = alike.name[:start].count("#")
    below, above = groups[alike], groups.get(plain, {})
    numbers = [[list(_RUN.finditer(stem))[place][0] for stem in stems.values()] for stems in (below, above)]
    if "0" not in {number.lstrip("0") or "0" for number in numbers[1]} or "1" not in {
        n.lstrip("0") for n in numbers[0]
    }:
        return
    starts = {file: list(_RUN.finditer(stem))[place].start() for file, stem in below.items()}
    minus = {file: f"{stem[: starts[file] - 1]}{_MINUS}{stem[starts[file] :]}" for file, stem in below.items()}
    groups[plain] = above | minus
    del groups[alike]


def _add_whole_frames(groups: dict[_Alike, dict[Path, str]], alike: _Alike) -> None:
    """Give subframes the whole frames between them that lack the zero, as files of their group."""
    whole = alike._replace(name=alike.name.replace("#.#", "#"))
    place = alike.name[: alike.name.index("#.#")].count("#")
    both = dict(groups[alike])
    for file, stem in groups.get(whole, {}).items():
        end = list(_RUN.finditer(stem))[place].end()
        both[file] = f"{stem[:end]}.0{stem[end:]}"
    if len(both) == len(groups[alike]):
        return
    runs = [list(_RUN.finditer(stem)) for stem in both.values()]
    if _subframes(list(both.values()), runs, place + 1) is not None:
        groups[alike] = both
        del groups[whole]


def _read_group(files: Mapping[Path, str]) -> list[FrameName]:
    """Names that are alike but for their numbers: file -> its stem."""
    stems = list(files.values())
    runs = [list(_RUN.finditer(stem)) for stem in stems]
    values = [[_value(run) for run in each] for each in runs]
    places = range(len(runs[0]))
    varying = [place for place in places if len({each[place] for each in values}) > 1]
    ranks = {place: _rank(runs[0], place, stems[0]) for place in places}
    # A number that differs comes first, but for one that letters touch: of sh0010_0001, sh0020_0001 it is the shot's.
    scores = [(rank + 1.5 * (rank > 0 and place in varying), place) for place, rank in ranks.items()]
    rank, place = max(scores, default=(0, -1))
    parts = _subframes(stems, runs, place) if rank > 0 and place > 0 else None
    numbers = [Fraction(each[place] if rank > 0 else 0) for each in values] if parts is None else parts
    if rank == 0 or max(numbers) - min(numbers) > _FARTHEST:
        return [FrameName(file, stem, None) for file, stem in files.items()]
    names = []
    for index, (file, found) in enumerate(zip(files, runs, strict=True)):
        start = found[place].start() if parts is None else found[place - 1].start()
        shot = f"{stems[index][:start]}#{stems[index][found[place].end() :]}"
        names.append(FrameName(file, shot, numbers[index]))
    return names


def _read_folders(files: Iterable[Path]) -> dict[Path, FrameName]:
    """Those of the files, which have no number of their own, that lie in several folders with a number each."""
    groups: dict[_Alike, dict[Path, int]] = {}
    for file in files:
        if found := _FOLDER.fullmatch(file.parent.name):
            alike = _Alike(file.parent.parent, f"{_FOLDER.sub('#', file.parent.name)}/{file.stem}", file.suffix.lower())
            groups.setdefault(alike, {})[file] = int(found[1])
    return {
        file: FrameName(file, alike.name, Fraction(number))
        for alike, numbers in groups.items()
        if len(numbers) > 1 and max(numbers.values()) - min(numbers.values()) <= _FARTHEST
        for file, number in numbers.items()
    }


def _value(run: re.Match[str]) -> int:
    return int(run[0].replace(_MINUS, "-"))


def _rank(runs: Sequence[re.Match[str]], place: int, stem: str) -> int:
    """How much like a frame number a number looks: 3 best, 0 not at all."""
    run = runs[place]
    before, after = stem[: run.start()][-1:], stem[run.end() :][:1]
    digits = len(run[0].lstrip("-" + _MINUS))
    if before in _ENDS and after in _ENDS:  # "" is in every string: the beginning, and the end
        return 3
    if re.search(r"\dx$", stem[: run.start()]) or re.match(r"x\d", stem[run.end() :]):  # a size, 2048x1024
        return 0
    if not after:
        return 3 if digits > 2 else 2
    return 1 if digits >= _INSIDE else 0


def _subframes(stems: Sequence[str], runs: Sequence[Sequence[re.Match[str]]], place: int) -> list[Fraction] | None:
    """Numbers with fractions, where the last two numbers are that: 1.0, 1.5, 2.0, or 1.00, 1.33, 1.67; None elsewhere.

    Fractions are those of equal steps, from 0 or from half a step on. Others are no fractions but frames of numbered
    shots.
    """
    first, second = runs[0][place - 1], runs[0][place]
    if stems[0][first.end() : second.start()] != "." or any(run[place][0].startswith("-") for run in runs):
        return None
    digits = {run[place][0] for run in runs}
    if len({run[place - 1][0] for run in runs}) == 1 and min(map(len, digits)) < _PARTS:  # versions, not parts
        return None
    decimals = sorted({Fraction(int(text), 10 ** len(text)) for text in digits})
    steps = len(decimals)
    if steps < 2:
        return None
    rough = Fraction(1, 10 ** min(len(text) for text in digits))
    first_part = Fraction(round(2 * steps * decimals[0]), 2 * steps)
    if any(abs(value - first_part - Fraction(i, steps)) >= rough for i, value in enumerate(decimals)):
        return None
    numbers = []
    for run in runs:
        whole, text = run[place - 1][0], run[place][0]
        part = first_part + Fraction(round((Fraction(int(text), 10 ** len(text)) - first_part) * steps), steps)
        numbers.append(int(whole) - part if whole.startswith("-") else int(whole) + part)
    return numbers
