"""A file for each pass (``beauty.0001.exr``, ``albedo.0001.exr`` ...): by their names, the passes of one shot.

V-Ray, Redshift, LuxCore and Blender's File Output write such files, beside each other or in a folder for each pass.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.data.errors import ClipError
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.layers import UNSURE_ALBEDO
from jaxdn.data.foreign.pass_names import (
    BEAUTY,
    PASSES,
    UNREAD,
    WEAK,
    find_word,
    join_words,
    pass_of_folder,
    split_words,
)
from jaxdn.data.foreign.shots import Shot, find_shots

_MOTION = {"motion", "vector", "velocity", "backward", "forward"}
_UNSURE = _MOTION | {UNSURE_ALBEDO, "id", "ids", "object id", "normal", "normals"}
"""Words that are names of shots, too: such files alone are pictures, unless one of a picture is beside them."""
_SHORT = 4
"""Letters; shorter words tell nothing of a file that stands alone."""
_SIGNS = 0.01
"""Share of values below 0 that no picture has; negative lobes of pixel filters and colours out of gamut are rarer."""


class PassName(NamedTuple):
    """What the name of a shot's files says about the pass in them."""

    rest: tuple[Path, str]
    """The folder and the name without the word, which the passes of one shot have in common."""
    word: str
    """Name of a layer; "" if the name has none."""
    buffer: str | None
    """Which buffer that is; None: there is no such word."""


def join_passes(shots: Sequence[Shot], stated: Mapping[str, str]) -> tuple[list[Shot], list[str]]:
    """The shots, those that are passes of another joined to it, and what to know, in sentences.

    A data pass (albedo, normals, depth ...) is never a picture: without one beside it, it is left out. Raises ClipError
    if nothing else is left, if a pattern that is stated fits no files, and for one of the radiance: a result is written
    into a copy of its own file.

    Args:
      shots: of one call.
      stated: buffer -> pattern for its files, which are joined to every shot.
    """
    if "radiance" in stated:
        raise ClipError(
            f"--channels radiance={stated['radiance']}: expected a layer of the files that are denoised, got other "
            "files; denoise those, and name the others by their buffers."
        )
    others = {buffer: _by_number(find_shots(pattern)) for buffer, pattern in stated.items()}
    taken = {file.resolve() for files in others.values() for file in files.values()}
    shots = [shot for shot in shots if not {file.resolve() for file in shot.files} <= taken]
    joined, notes = [], []
    for pictures, data in _group(shots):
        rest = [shot for shot, name in pictures]
        read = [(shot, name) for shot, name in data if name.buffer != UNREAD]
        if not pictures:
            notes += [f"{shot.label}: not a picture but a data pass ({name.buffer}), left out" for shot, name in data]
            continue
        notes += [
            f"{shot.label}: not a picture but a data pass ({name.word}), left out"
            for shot, name in data
            if name.buffer == UNREAD
        ]
        if read:
            best = min(pictures, key=lambda one: BEAUTY.index(one[1].word) if one[1].word in BEAUTY else len(BEAUTY))
            rest[rest.index(best[0])] = _with_passes(best[0], {name.word: _by_number([shot]) for shot, name in read})
            names = ", ".join(f"{name.buffer} from {shot.files[0].name}" for shot, name in read)
            notes.append(f"{best[0].label}: a file for each pass, {names} ...")
        joined += rest
    if shots and not joined:
        raise ClipError(f"{notes[0]}; name the files of the picture too, or --channels radiance=LAYER.")
    return [_with_passes(shot, {stated[buffer]: files for buffer, files in others.items()}) for shot in joined], notes


_Named = tuple[Shot, "PassName"]


def _group(shots: Sequence[Shot]) -> list[tuple[list[_Named], list[_Named]]]:
    """The pictures and the data passes of each group of shots that belong together; either may be empty.

    Data passes whose names are nothing but the word belong to the one picture of their folder, whatever it is called:
    ``render.0001.exr`` beside ``albedo.0001.exr``.
    """
    groups: dict[tuple[Path, str], list[_Named]] = {}
    for shot in shots:
        name = read_pass_name(shot)
        groups.setdefault(name.rest, []).append((shot, name))
    for group in list(groups.values()):
        if all(name.buffer in (None, "radiance") for _, name in group):  # a shot called "main"
            for one in [(shot, name) for shot, name in group if name.word in WEAK]:
                group.remove(one)
                groups.setdefault((one[0].folder, join_words(split_words(_name_of(one[0])))), []).append(one)
    groups = {rest: group for rest, group in groups.items() if group}
    found: dict[tuple[Path, str], tuple[list[_Named], list[_Named]]] = {}
    for rest, group in groups.items():
        alone = all(name.buffer not in (None, "radiance") for _, name in group)
        sure = any(_is_sure(name) for _, name in group if name.buffer not in (None, "radiance"))
        albedos = [name for _, name in group if name.buffer == "albedo"]
        data = []
        for shot, name in group:
            second = name.word == UNSURE_ALBEDO and len(albedos) > 1  # light, as another is the albedo
            if name.buffer in (None, "radiance") or second or not _is_plain(shot):
                continue
            if not alone or _is_sure(name) or (sure and name.buffer in _CERTAIN) or _has_signs(shot):
                data.append((shot, name))
        found[rest] = [one for one in group if one not in data], data
    for bare, (pictures, data) in list(found.items()):
        beside = [key for key, (others, _) in found.items() if key[0] == bare[0] and others]
        if data and not pictures and bare[1] in ("", "#") and len(beside) == 1 and len(found[beside[0]][0]) == 1:
            found[beside[0]][1].extend(data)
            del found[bare]
    return list(found.values())


def read_pass_name(shot: Shot) -> PassName:
    """The pass that the name of a shot's files, or of their folder, has a word for."""
    tokens, of_folder = split_words(_name_of(shot)), pass_of_folder(shot.folder.name)
    found = find_word(tokens)
    if found is not None:
        word, rest = found
        twice = of_folder is not None and PASSES[of_folder] == PASSES[word]
        return PassName((shot.folder.parent if twice else shot.folder, rest), word, PASSES[word])
    if of_folder is not None:
        return PassName((shot.folder.parent, join_words(tokens)), of_folder, PASSES[of_folder])
    return PassName((shot.folder, join_words(tokens)), "", None)


def _name_of(shot: Shot) -> str:
    return shot.name or shot.files[0].stem


_CERTAIN = {"normal", "motion", "ids"}
"""Buffers whose words names of shots have, too; beside a pass that is one for sure they are passes."""


def _is_sure(name: PassName) -> bool:
    """Whether a file with such a word is a data pass though no picture is beside it."""
    return len(name.word) >= _SHORT and name.word not in _UNSURE and name.buffer != UNREAD


def _has_signs(shot: Shot) -> bool:
    """Whether the first file that can be read has what no picture has: values below 0, or unit vectors everywhere."""
    for file in shot.files:
        try:
            pixels = ExrFile(file).pixels
        except ClipError:
            continue
        values = np.stack([np.asarray(each, np.float64) for each in pixels.values()], axis=-1)
        as_colours = 2 * values - 1
        return bool(np.mean(values < 0) > _SIGNS) or _are_unit(values) or _are_unit(as_colours)
    return False


def _are_unit(vectors: np.ndarray) -> bool:
    """Whether vectors [H, W, 3] have the length 1, but for a few at edges; with another number of components, no."""
    lengths = np.linalg.norm(vectors, axis=-1)
    return vectors.shape[-1] == 3 and bool(np.mean(np.abs(lengths - 1) < 0.02) > 0.9)


def _is_plain(shot: Shot) -> bool:
    """Whether the files have one layer: else they are whole frames, whatever they are called."""
    for file in shot.files:
        try:
            names = list(ExrFile(file).windows)
        except ClipError:
            continue
        return len(names) <= 4 and len({name.rpartition(".")[0] for name in names}) == 1
    return False


def _by_number(shots: Sequence[Shot]) -> dict[object, Path]:
    """The files by their frame numbers; None for an image without one."""
    return {number: file for shot in shots for number, file in zip(shot.numbers or (None,), shot.files, strict=True)}


def _with_passes(shot: Shot, passes: Mapping[str, Mapping[object, Path]]) -> Shot:
    """The shot with further files for its frames: layer -> number -> file."""
    if not passes:
        return shot
    before = shot.passes or ({},) * len(shot.files)
    return shot._replace(
        passes=tuple(
            {**there, **{layer: files[number] for layer, files in passes.items() if number in files}}
            for there, number in zip(before, shot.numbers or (None,), strict=True)
        )
    )
