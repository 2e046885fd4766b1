"""The files of a shot, opened: each frame is one file, or one for each pass."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxdn.data.errors import ClipError, DamagedFile
from jaxdn.data.exr.file import ExrFile, Window
from jaxdn.data.foreign.passes import join_passes
from jaxdn.data.foreign.shots import Shot, find_shots, refuse_gaps

_T = TypeVar("_T")


class PassesFile(ExrFile):
    """A frame whose passes lie in files of their own: the channels of all, and the picture's file to write."""

    def __init__(self, path: str | Path, passes: Mapping[str, Path]) -> None:
        """``passes``: layer -> file, whose channels are called after that layer."""
        super().__init__(path)
        self._passes = {layer: ExrFile(file) for layer, file in passes.items()}

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the frame, the picture's first."""
        return self.path, *(file.path for file in self._passes.values())

    @property
    def beside(self) -> frozenset[str]:
        """The channels of the passes."""
        return frozenset(self.windows) - super().windows.keys()

    @property
    def windows(self) -> dict[str, Window]:
        """Full name of each channel -> its data window."""
        found = dict(super().windows)
        for layer, file in self._passes.items():
            if self._look(file).display != self.display:
                (height, width), (rows, columns) = file.display.size, self.display.size
                raise DamagedFile(
                    self.path, f"expected {columns} x {rows} pixels in {file.path.name} too, got {width} x {height}"
                )
            found = {**_named(layer, file.windows), **found}
        return found

    @property
    def pixels(self) -> dict[str, np.ndarray]:
        """Full name of each channel -> its pixels. Raises ClipError if there are none."""
        found = super().pixels
        for layer, file in self._passes.items():
            try:
                found = {**_named(layer, file.pixels), **found}
            except DamagedFile as error:
                raise DamagedFile(self.path, f"{file.path.name}: {error.reason}") from error
        return found

    def drop(self) -> None:
        """Forget all that was read; it is read again if somebody asks for it."""
        super().drop()
        for file in self._passes.values():
            file.drop()

    def drop_windows(self) -> None:
        """Forget the windows alone."""
        super().drop_windows()
        for file in self._passes.values():
            file.drop_windows()

    def _look(self, file: ExrFile) -> ExrFile:
        """The file of a pass; an error in its headers is one of the frame."""
        try:
            file.windows  # noqa: B018
        except DamagedFile as error:
            raise DamagedFile(self.path, f"{file.path.name}: {error.reason}") from error
        return file


def _named(layer: str, channels: Mapping[str, _T]) -> dict[str, _T]:
    return {f"{layer}.{name.rpartition('.')[2]}": one for name, one in channels.items()}


def open_files(shot: Shot) -> tuple[ExrFile, ...]:
    """The files of a shot's frames, each to be opened once."""
    passes: Iterable[Mapping[str, Path]] = shot.passes or ({},) * len(shot.files)
    return tuple(
        PassesFile(file, more) if more else ExrFile(file) for file, more in zip(shot.files, passes, strict=True)
    )


def find_sequence(path: str | Path | Sequence[Path], stated: Mapping[str, str] | None = None) -> Shot:
    """The one sequence of a folder, a pattern, a file, or several files.

    ``stated``: buffer -> pattern for the files of that pass. Raises ClipError if there are no files, if they belong to
    several sequences, or if frame numbers are missing.
    """
    shots = join_passes(find_shots(path), stated or {})[0]
    if len(shots) == 1 and len(shots[0].files) == 1:
        return shots[0]
    for shot in shots:
        if not shot.numbers:
            raise ClipError(
                f"{shot.files[0]}: expected a file name that ends in a frame number, such as shot_0001.exr."
            )
    if len(shots) > 1:
        names = ", ".join(sorted(shot.name.removesuffix("#") for shot in shots))
        raise ClipError(f"{path}: expected one sequence, got several: {names}; use a pattern.")
    refuse_gaps(path, shots[0])
    return shots[0]
