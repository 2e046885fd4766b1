"""Views of one picture in one file, as of a stereo camera: each is read as a file of its own, under its plain names.

A part of a file may have the attribute ``view`` (Blender, Nuke). A file of one part may have the attribute
``multiView``, a list of views (OpenEXR, "Storing Multi-View Images"): channels without a layer belong to the first,
the hero, and those of the others have the view's name before the last part of theirs, ``left.R``, ``forward.left.u``.
Without either attribute, ``left.R`` and ``right.R`` are two views where both have the same channels.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdn.core.frame import BUFFERS
from jaxdn.data.errors import ClipError, DamagedFile
from jaxdn.data.exr.file import ExrFile, Window, full_name
from jaxdn.data.foreign.layers import LAYERS, find_layer, group_layers
from jaxdn.data.foreign.shot_files import open_files
from jaxdn.data.foreign.shots import Shot

_SIDES = ({"l", "left"}, {"r", "right"})
"""Words in the names of files for the views of a stereo camera."""
_PAIR = ("left", "right")
"""Views that names of channels alone tell."""


class ViewFile(ExrFile):
    """One view of a file, its channels without the view in their names; what belongs to no view is in all of them."""

    def __init__(self, path: str | Path, view: str) -> None:
        super().__init__(path)
        self.view = view
        self._full: dict[str, str] | None = None

    @property
    def windows(self) -> dict[str, Window]:
        """Plain name of each channel of the view -> its data window."""
        windows = super().windows
        return {name: windows[full] for name, full in self._names(list(windows)).items()}

    @property
    def pixels(self) -> dict[str, np.ndarray]:
        """Plain name of each channel of the view -> its pixels. Raises ClipError if there are none."""
        pixels = super().pixels
        return {name: pixels[full] for name, full in self._names(list(pixels)).items()}

    def full_name(self, name: str) -> str:
        """The name that a channel has in the file."""
        return self._names(list(super().windows))[name]

    def _names(self, names: Sequence[str]) -> dict[str, str]:
        if self._full is None:
            if self.view not in _views_of(self.headers):
                raise DamagedFile(self.path, f"the file lacks the view {self.view!r}")
            self._full = _split(self.headers, names)[self.view]
        return self._full


def find_views(file: ExrFile) -> tuple[str, ...]:
    """The views in a file, the hero first; () if it says nothing of views. Raises as its headers do."""
    return tuple(_views_of(file.headers))


def explain_views(label: str, views: Mapping[str, Sequence[ExrFile]]) -> list[str]:
    """What to know about views that a shot's files tell by the names of their channels alone, in sentences."""
    for file in next(iter(views.values()), ()) if len(views) > 1 else ():
        try:
            stated = bool(_stated_views(file.headers))
        except ClipError:  # told when its turn comes
            continue
        if stated:
            return []
        break
    else:
        return []
    names = " and ".join(views)
    return [f"{label}: {names} are read as views, by their names; for one alone, --view {next(iter(views))}"]


def open_views(shot: Shot, wanted: str | None = None) -> dict[str, tuple[ExrFile, ...]]:
    """View -> the files of a shot, each to be opened once; a shot without views has the view "".

    The first file that can be read tells which there are. Raises ClipError where ``wanted``, the only one to open, is
    not among them.
    """
    opened = open_files(shot)
    views: tuple[str, ...] = ()
    for file in opened if not shot.passes else ():
        try:
            views = find_views(file)
        except ClipError:  # told when its turn comes
            continue
        break
    if not views:
        return {"": opened}
    if wanted is not None and wanted not in views:
        raise ClipError(f"--view: there is none called {wanted!r} in {shot.label}; there are {', '.join(views)}.")
    chosen = views if wanted is None else (wanted,)
    return {view: tuple(ViewFile(file, view) for file in shot.files) for view in chosen}


def select_view(shots: Sequence[Shot], view: str | None) -> list[Shot]:
    """The shots, without those whose files are, by their names, another view than the one asked for (None: any).

    Raises ClipError if nothing is left.
    """
    if view is None:
        return list(shots)
    kept = [shot for shot in shots if "" not in open_views(shot) or view.lower() in _words(shot)]
    if shots and not kept:
        raise ClipError(f"--view: expected files that have the view {view!r}, got {shots[0].label} without views.")
    return kept


def _words(shot: Shot) -> set[str]:
    """The words in the name of a shot's files and of their folder, with other words for the same side."""
    words = set(re.split(r"[^a-z0-9]+", f"{shot.files[0].parent.name} {shot.name or shot.files[0].stem}".lower()))
    return words.union(*(side for side in _SIDES if side & words))


def _views_of(headers: Sequence[Mapping[str, Any]]) -> list[str]:
    return _stated_views(headers) or _paired_views(headers)


def _paired_views(headers: Sequence[Mapping[str, Any]]) -> list[str]:
    """The sides of a stereo camera, as the channels call them, in their order.

    Both have the same channels, with a picture, and no picture is beside them: lights may be called so, too.
    """
    sides: dict[str, list[str]] = {side: [] for side in _PAIR}
    words: dict[str, str] = {}
    others = []
    names = [full_name(each, channel.name, len(headers)) for each in headers for channel in each["channels"]]
    for name in names:
        word = next((layer for layer in name.split(".")[:-1] if layer.lower() in sides), None)
        if word is None:
            others.append(name)
        else:
            words.setdefault(word.lower(), word)
            sides[word.lower()].append(_strip(name, word))
    whole = sorted(sides["left"]) == sorted(sides["right"]) and _has_picture(sides["left"])
    return list(words.values()) if whole and not _has_picture(others) else []


def _has_picture(names: Sequence[str]) -> bool:
    return find_layer(group_layers(names), LAYERS["radiance"], BUFFERS["radiance"]) is not None


def _stated_views(headers: Sequence[Mapping[str, Any]]) -> list[str]:
    stated = headers[0].get("multiView") if len(headers) == 1 else None
    if stated:
        return [str(view) for view in stated]
    return list(dict.fromkeys(str(header["view"]) for header in headers if header.get("view")))


def _split(headers: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, dict[str, str]]:
    """View -> plain name of each channel -> full name."""
    views = _views_of(headers)
    parts = {str(header.get("name", "")): str(header["view"]) for header in headers if header.get("view")}
    hero = views[0] if headers[0].get("multiView") and len(headers) == 1 else ""
    owners = {name: _owner(name, views, parts, hero) for name in names}
    plain = {name: _strip(name, owner) if owner else name for name, owner in owners.items()}
    # A layer without a view that another view has too is the hero's.
    others = {plain[name] for name, owner in owners.items() if owner not in ("", views[0])}
    owners = {name: owner or (views[0] if plain[name] in others else "") for name, owner in owners.items()}
    found: dict[str, dict[str, str]] = {view: {} for view in views}
    for name, owner in sorted(owners.items(), key=lambda item: item[1] == ""):  # its own before everybody's
        for view in views if owner == "" else [owner]:
            found[view].setdefault(plain[name], name)
    return found


def _owner(name: str, views: Sequence[str], parts: Mapping[str, str], hero: str) -> str:
    """The view that a channel belongs to; "": to none. ``hero``: the view of what has no layer."""
    inside = [part for part in parts if part and (name == part or name.startswith(f"{part}."))]
    if inside and not hero:
        return parts[max(inside, key=len)]
    layers = name.split(".")[:-1]
    if named := [view for view in views if view.lower() in (layer.lower() for layer in layers)]:
        return named[0]
    return hero if not layers else ""


def _strip(name: str, view: str) -> str:
    """A name without the view: ``left.R``, ``forward.left.u``, ``rgba_left.R``; of what is twice in it, one.

    Blender 5 calls a part ``ViewLayer.Depth-left`` and its channel ``ViewLayer.Depth.Z``.
    """
    word = re.escape(view)
    layers, _, last = name.rpartition(".")
    kept = (re.sub(rf"^{word}$|^{word}[_\s-]|[_\s-]{word}$", "", one, flags=re.IGNORECASE) for one in layers.split("."))
    found = [one for one in kept if one]
    half = len(found) // 2
    return ".".join([*(found[:half] if found[:half] == found[half:] else found), last])
