"""Which EXR files are frames of one shot: by their names, ``shot_0001.exr`` ...; gaps, and files without a number."""

import glob
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxdn.data.errors import ClipError


class Shot(NamedTuple):
    """Files of one name and their frame numbers, ascending; an image without a number is a shot of its own."""

    files: tuple[Path, ...]
    numbers: tuple[int, ...]
    """Empty for an image without a number."""

    @property
    def label(self) -> str:
        """``folder/shot_#.exr 1-8, 11``; of one file, its path."""
        first = self.files[0]
        if len(self.files) == 1:
            return str(first)
        return f"{first.parent / _prefix(first)}#{first.suffix} {ranges(self.numbers)}"


def find_shots(path: str | Path) -> list[Shot]:
    """The shots of a folder or a glob pattern, or the one of a file. Raises ClipError if there are no EXR files."""
    path = Path(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".exr" and file.name[0] != ".")
    elif path.is_file():
        files = [path]
    else:
        files = sorted(Path(name) for name in glob.glob(str(path)))
    if not files:
        raise ClipError(f"{path}: expected a folder of EXR files, a pattern that fits some, or one; found none.")
    numbered: dict[tuple[Path, str], dict[int, Path]] = {}
    single = []
    for file in files:
        number = _number(file)
        if number is None:
            single.append(Shot((file,), ()))
            continue
        frames = numbered.setdefault((file.parent, _prefix(file)), {})
        if number in frames:
            raise ClipError(f"{file}: expected one file for each frame, but {frames[number]} has the same number.")
        frames[number] = file
    shots = [Shot(tuple(frames[n] for n in sorted(frames)), tuple(sorted(frames))) for frames in numbered.values()]
    return [*shots, *single]


def find_sequence(path: str | Path) -> list[Path]:
    """The EXR files of one sequence in the order of their frame numbers.

    ``path`` is a folder, a glob pattern or one file. Raises ClipError if there are none, if they belong to several
    sequences, or if frame numbers are missing.
    """
    shots = find_shots(path)
    if len(shots) == 1 and len(shots[0].files) == 1:
        return list(shots[0].files)
    for shot in shots:
        if not shot.numbers:
            raise ClipError(
                f"{shot.files[0]}: expected a file name that ends in a frame number, such as shot_0001.exr."
            )
    if len(shots) > 1:
        names = ", ".join(sorted(_prefix(shot.files[0]) for shot in shots))
        raise ClipError(f"{path}: expected one sequence, got several: {names}; use a pattern.")
    (shot,) = shots
    gaps = missing(shot.numbers)
    if gaps:
        shown = ", ".join(map(str, gaps[:8])) + (" ..." if len(gaps) > 8 else "")
        raise ClipError(f"{path}: frames are missing between {shot.numbers[0]} and {shot.numbers[-1]}: {shown}.")
    return list(shot.files)


def missing(numbers: Sequence[int]) -> list[int]:
    """The numbers that lie between others and are not there."""
    return sorted(set(range(min(numbers), max(numbers) + 1)) - set(numbers)) if numbers else []


def ranges(numbers: Iterable[int]) -> str:
    """``0-3, 7``."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    return ", ".join("-".join(map(str, part)) for part in parts)


def _number(file: Path) -> int | None:
    match = re.search(r"(\d+)$", file.stem)
    return None if match is None else int(match[1])


def _prefix(file: Path) -> str:
    return re.sub(r"\d+$", "", file.stem)
