"""A file for each pass (``beauty.0001.exr``, ``albedo.0001.exr`` ...): by their names, the passes of one shot.

V-Ray, Redshift, LuxCore and Blender's File Output write such files, beside each other or in a folder for each pass.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxdn.data.errors import ClipError
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.layers import LAYERS, UNSURE_ALBEDO
from jaxdn.data.foreign.shots import Shot, find_shots

_BEAUTY = [name for name in LAYERS["radiance"] if name]
"""Words in the names of files that hold the picture, the best first."""
_MOTION = {"motion", "vector", "velocity", "backward", "forward"}
_UNSURE = _MOTION | {UNSURE_ALBEDO, "id", "ids", "object id", "normal", "normals"}
"""Words that are names of shots, too: such files alone are pictures, unless one of a picture is beside them."""
_SHORT = 4
"""Letters; shorter words tell nothing of a file that stands alone."""


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
    if nothing else is left, or if a pattern that is stated fits no files.

    Args:
      shots: of one call.
      stated: buffer -> pattern for its files, which are joined to every shot.
    """
    others = {buffer: _by_number(find_shots(pattern)) for buffer, pattern in stated.items()}
    taken = {file.resolve() for files in others.values() for file in files.values()}
    shots = [shot for shot in shots if not {file.resolve() for file in shot.files} <= taken]
    groups: dict[tuple[Path, str], list[tuple[Shot, PassName]]] = {}
    for shot in shots:
        name = read_pass_name(shot)
        groups.setdefault(name.rest, []).append((shot, name))
    joined, notes = [], []
    for group in groups.values():
        pictures = [(shot, name) for shot, name in group if name.buffer in (None, "radiance")]
        data = [(shot, name) for shot, name in group if name.buffer not in (None, "radiance")]
        alone = not pictures
        data = [(shot, name) for shot, name in data if _is_plain(shot) and (not alone or _is_sure(name))]
        rest = [shot for shot, name in group if (shot, name) not in data]
        if data and alone:
            notes += [f"{shot.label}: not a picture but a data pass ({name.buffer}), left out" for shot, name in data]
        elif data:
            best = min(pictures, key=lambda one: _BEAUTY.index(one[1].word) if one[1].word in _BEAUTY else len(_BEAUTY))
            rest[rest.index(best[0])] = _with_passes(best[0], {name.word: _by_number([shot]) for shot, name in data})
            names = ", ".join(f"{name.buffer} from {shot.files[0].name}" for shot, name in data)
            notes.append(f"{best[0].label}: a file for each pass, {names} ...")
        joined += rest
    if shots and not joined:
        raise ClipError(f"{notes[0]}; name the files of the picture too, or --channels radiance=LAYER.")
    return [_with_passes(shot, {stated[buffer]: files for buffer, files in others.items()}) for shot in joined], notes


def read_pass_name(shot: Shot) -> PassName:
    """The pass that the name of a shot's files, or of their folder, has a word for."""
    folder, name = shot.folder, (shot.name or shot.files[0].stem)
    found = _find_word(name)
    if found is not None:
        word, rest = found
        return PassName((folder, rest), word, _WORDS[word])
    word = _plain(folder.name)
    if word in _WORDS:
        return PassName((folder.parent, _plain(name)), word, _WORDS[word])
    return PassName((folder, _plain(name)), "", None)


_WORDS: dict[str, str] = {
    # "sh_normal" is Mitsuba's name for a layer, and in names of files the normal of the shot "sh".
    **{name: buffer for buffer, names in LAYERS.items() for name in names if name not in ("", "sh_normal")},
    **dict.fromkeys(_BEAUTY, "radiance"),
}


def _plain(text: str) -> str:
    """Lower case, with one kind of separator and none at the ends."""
    return re.sub(r"[\s._-]+", " ", text.lower()).strip()


def _find_word(name: str) -> tuple[str, str] | None:
    """The longest word for a pass in a name, and the rest."""
    text = _plain(name)
    best: tuple[str, str] | None = None
    for word in _WORDS:
        match = re.search(rf"(?<![a-z0-9]){re.escape(_plain(word))}(?![a-z0-9])", text)
        if match is not None and (best is None or len(word) > len(best[0])):
            best = word, _plain(text[: match.start()] + " " + text[match.end() :])
    return best


def _is_sure(name: PassName) -> bool:
    """Whether a file with such a word is a data pass though no picture is beside it."""
    return len(name.word) >= _SHORT and name.word not in _UNSURE


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
