"""Which EXR files are frames of one shot: by their names, ``shot_0001.exr`` ..., or their folders; gaps, and others."""

import glob
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.frame_names import is_frame_folder, read_frame_names
from jaxdn.data.foreign.pass_names import are_pass_folders, pass_of_folder

Number = int | Fraction
"""Of a frame; a fraction between two frames that are counted."""

_PLACEHOLDER = re.compile(r"#+|@+|%0?\d*d|\$F\d*|<frame>|<f\d*>", re.IGNORECASE)
"""How programs write the place of a frame's number."""
_SUFFIX = re.compile(r"\.exr$", re.IGNORECASE)


class Shot(NamedTuple):
    """Files of one name and their frame numbers, ascending; an image without a number is a shot of its own."""

    files: tuple[Path, ...]
    numbers: tuple[Number, ...]
    """Empty for an image without a number."""
    name: str = ""
    """Of its files, with ``#`` for the number, without the suffix; "" for clips of ours. With a folder for each frame
    it is that of both, ``#/beauty``."""
    passes: tuple[Mapping[str, Path], ...] = ()
    """Of each frame, layer -> a further file that has it (:mod:`jaxdn.data.foreign.passes`); empty: there are none."""

    @property
    def label(self) -> str:
        """``folder/shot_#.exr 1-8, 11``; of one file, its path."""
        first = self.files[0]
        if len(self.files) == 1:
            return str(first)
        name = self.name or re.sub(r"\d+$", "#", first.stem)
        return f"{self.folder / name}{first.suffix} {ranges(self.numbers)}"

    @property
    def folder(self) -> Path:
        """Where the files lie, or the folders of the frames."""
        return self.files[0].parents[self.name.count("/")]

    @property
    def step(self) -> Fraction:
        """Between consecutive frames: 1, or less where there are subframes."""
        return frame_step(self.numbers)


def find_shots(path: str | Path | Sequence[Path]) -> list[Shot]:
    """The shots of a folder or a pattern, or those of files. Raises ClipError if there are no EXR files.

    In a pattern, ``*``, ``?`` and ``[...]`` are those of a shell, and ``####``, ``%04d``, ``$F4`` and ``<frame>`` stand
    for a number; ``.exr`` fits ``.EXR`` too. Of a folder without EXR files, those of its folders for frames are found
    (``0001/beauty.exr``), or of those for passes (``beauty/0001.exr``, ``albedo/0001.exr``). Folders whose names have
    brackets in them are taken as they are called.
    """
    if not isinstance(path, str | Path):
        files = list(path)
    elif Path(path).is_dir():
        files = _list_folder(Path(path))
    elif is_named(Path(path)):
        files = [Path(path)]
    else:
        files = _expand(Path(path))
    if not files:
        deeper = sorted(Path(path).glob("*/*.exr")) if isinstance(path, str | Path) else []
        below = f", but some in {deeper[0].parent}: name such folders" if deeper else ""
        raise ClipError(f"{path}: expected a folder of EXR files, a pattern that fits some, or one; found none{below}.")
    numbered: dict[tuple[Path, str, str], dict[Number, Path]] = {}
    single = []
    for file, name, number in read_frame_names(_once(files)):
        if number is None:
            single.append(Shot((file,), ()))
            continue
        frames = numbered.setdefault((file.parents[name.count("/")], name, file.suffix.lower()), {})
        if number in frames:
            raise ClipError(f"{file}: expected one file for each frame, but {frames[number]} has the same number.")
        frames[int(number) if number.denominator == 1 else number] = file
    shots = [
        Shot(tuple(frames[n] for n in sorted(frames)), tuple(sorted(frames)), name)
        for (_, name, _), frames in numbered.items()
    ]
    return [*shots, *single]


def _list_folder(folder: Path) -> list[Path]:
    """The EXR files of a folder; if there are none, those in its folders for a frame each, or for a pass each."""
    below = sorted(each for each in folder.iterdir() if each.is_dir())
    frames = [each for each in below if is_frame_folder(each)]
    passes = [each for each in below if pass_of_folder(each.name) is not None]
    for folders in ([folder], frames, passes if are_pass_folders([each.name for each in passes]) else []):
        inside = sorted(file for each in folders for file in each.iterdir())
        if files := [file for file in inside if file.suffix.lower() == ".exr" and file.name[0] != "."]:
            return files
    return []


def is_named(path: Path) -> bool:
    """Whether a path is the name of a file, and no pattern: also a link to a file that is missing."""
    return path.is_file() or (path.is_symlink() and not path.exists())


def is_pattern(path: str | Path) -> bool:
    """Whether a name has what stands for more than itself in a pattern (:func:`find_shots`)."""
    return re.search(r"[*?[]", str(path)) is not None or _PLACEHOLDER.search(str(path)) is not None


def refuse_gaps(path: str | Path | Sequence[Path], shot: Shot) -> None:
    """Raise ClipError for a shot, found at a path, in which frame numbers are missing."""
    gaps = find_missing(shot.numbers)
    if gaps:
        shown = ", ".join(map(_text, gaps[:8])) + (" ..." if len(gaps) > 8 else "")
        raise ClipError(f"{path}: frames are missing between {shot.numbers[0]} and {shot.numbers[-1]}: {shown}.")


def frame_step(numbers: Sequence[Number]) -> Fraction:
    """Between consecutive frames: 1, or less where some numbers are fractions."""
    return Fraction(1, math.lcm(*(number.denominator for number in numbers)))


def find_missing(numbers: Sequence[Number]) -> list[Number]:
    """The numbers that lie between others and are not there."""
    if not numbers:
        return []
    first, step, there = min(numbers), frame_step(numbers), set(numbers)
    if step == 1:
        return sorted(set(range(int(first), int(max(numbers)) + 1)) - there)
    expected = (first + i * step for i in range(int((max(numbers) - first) / step) + 1))
    return [number for number in expected if number not in there]


def ranges(numbers: Iterable[Number]) -> str:
    """``0-3, 7``; with numbers below 0, ``-3 to 2, 7``."""
    numbers = list(numbers)
    step = frame_step(numbers)
    parts: list[list[Number]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + step:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    dash = " to " if any(number < 0 for number in numbers) else "-"
    return ", ".join(dash.join(map(_text, part)) for part in parts)


def _text(number: Number) -> str:
    return str(number) if number.denominator == 1 else f"{float(number):.4g}"


def _once(files: Iterable[Path]) -> list[Path]:
    """The files. Raises ClipError for one that is there twice."""
    seen: set[str] = set()
    kept = []
    for file in files:
        place = os.path.abspath(file)
        if place in seen:
            raise ClipError(f"{file}: expected every frame once, got it twice; name it once.")
        seen.add(place)
        kept.append(file)
    return kept


def _expand(pattern: Path) -> list[Path]:
    """The files that fit a pattern; parts of it that are there are no patterns, whatever is in their names."""
    literal, rest = Path(), list(pattern.parts)
    while rest and (literal / rest[0]).exists():
        literal /= rest.pop(0)
    shells = [_SUFFIX.sub("[.][eE][xX][rR]", _PLACEHOLDER.sub("*", part)) for part in rest]
    found = [Path(name) for name in glob.glob(os.path.join(glob.escape(str(literal)), *shells))]
    for depth, part in enumerate(rest, start=-len(rest)):
        if place := _PLACEHOLDER.search(part):
            tail = part[place.end() :].rpartition("*")[2]
            found = [file for file in found if _counts(file.parts[depth], part[: place.start()], tail)]
    files = [file for file in sorted(found) if is_named(file)]
    return [file for file in files if file.suffix.lower() == ".exr"] or files


def _counts(name: str, before: str, tail: str) -> bool:
    """Whether a name has a number where a pattern asks for one: between what is before it and its end."""
    middle = (name[len(before) :] if "*" not in before else name).lower().removesuffix(tail.lower())
    return re.fullmatch(r"-?\d+(\.\d+)?" if "*" not in before else r".*\d", middle) is not None
