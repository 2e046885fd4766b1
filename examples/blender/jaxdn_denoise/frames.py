"""The rendered files of a scene: the pattern that ``jaxdn denoise`` takes, and where the results are."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

_ONE, _TWO = 11111, 22222
"""Frames whose names differ in the number and nowhere else, however wide it is."""


class Rendered(NamedTuple):
    """Files that Blender has written for the frames of a scene."""

    pattern: Path
    """With ``####`` in the place of the number."""
    files: dict[int, Path]
    """Frame -> file, of those that are there, ascending."""


def find_rendered(path_of: Callable[[int], str], wanted: range) -> Rendered:
    """The files of the wanted frames.

    Raises ValueError, with what to do, where there are none, where they are no EXR files, and where a digit before the
    number makes it another number.

    Args:
      path_of: frame -> absolute path, as ``scene.render.frame_path(frame=...)``.
      wanted: the frames of the scene.
    """
    one, two = Path(path_of(_ONE)), Path(path_of(_TWO))
    before, number, after = one.name.rpartition(str(_ONE))
    if not number or one.parent != two.parent or f"{before}{_TWO}{after}" != two.name:
        raise ValueError(f"{one}: expected the number of the frame in the file's name alone; put #### at its end.")
    if one.suffix.lower() != ".exr":
        raise ValueError(f"{one.name}: expected OpenEXR MultiLayer files; press Set Passes, and render again.")
    if before[-1:].isdigit():
        raise ValueError(f"{before}####: the digit before the number would be read as part of it; put _ between them.")
    files = {frame: path for frame in wanted if (path := Path(path_of(frame))).is_file()}
    if not files:
        first = Path(path_of(wanted[0]))
        raise ValueError(f"{first}: expected rendered frames, found none; render the animation first.")
    return Rendered(one.with_name(f"{before}####{after}"), files)


def find_results(rendered: Rendered, out: Path) -> dict[int, Path]:
    """Frame -> denoised file, of those that are there."""
    named = {frame: out / path.name for frame, path in rendered.files.items()}
    return {frame: path for frame, path in named.items() if path.is_file()}


def without_gaps(files: dict[int, Path]) -> list[Path]:
    """A file for every frame from the first to the last; a missing frame shows the one before it."""
    shown: list[Path] = []
    for frame in range(min(files), max(files) + 1):
        shown.append(files.get(frame) or shown[-1])
    return shown
