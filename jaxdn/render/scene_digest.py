"""What the files of a scene held when a clip was begun, so that no frames of an edited scene are added to it."""

import functools
import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

SCENE_FILE, SCENE_PARTS = "scene_file_sha256", "scene_parts_sha256"


def digest_scene_file(scene: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a clip's record that tell the bytes of its scene file; none for a scene that has no file.

    ``scene_file_sha256`` is that of the file, ``scene_parts_sha256`` has one for each file that it reads: what it
    includes, meshes, textures, and what these includes read, by the names they are written with. A name that stands for
    no file beside the scene or beside an include, as a parameter ``$texture``, is left out. ``scene`` is the record of
    the scene.
    """
    file = scene.get("file")
    if file is None or not Path(file).is_file():
        return {}
    parts = _find_parts(Path(file), Path(file).parent)
    digests = {SCENE_FILE: _digest(Path(file)), SCENE_PARTS: {name: _digest(path) for name, path in parts.items()}}
    return {name: each for name, each in digests.items() if each}


def find_edited(begun: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """The files, "" for the scene file itself, of which two records tell other bytes, or only one that it is read.

    Clips of earlier versions do not tell all.
    """
    edited = []
    if len({record[SCENE_FILE] for record in (begun, wanted) if SCENE_FILE in record}) > 1:
        edited.append("")
    if SCENE_PARTS in begun and SCENE_FILE in wanted:
        there, here = begun[SCENE_PARTS], wanted.get(SCENE_PARTS, {})
        edited += [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]
    return edited


def _find_parts(file: Path, folder: Path) -> dict[str, Path]:
    """Name -> file, of all that a scene file of ``folder`` reads."""
    found: dict[str, Path] = {}
    waiting = [file]
    while waiting:
        here = waiting.pop()
        for name, included in _names_in(here):
            path = next((path for path in (folder / name, here.parent / name) if path.is_file()), None)
            if path is not None and name not in found:
                found[name] = path
                waiting += [path] * included
    return found


def _names_in(file: Path) -> Iterator[tuple[str, bool]]:
    """The names of files in one of XML, and whether it includes them; none in what is no XML, as Mitsuba says later."""
    try:
        elements = list(ET.parse(file).iter())
    except ET.ParseError:
        return
    for element in elements:
        if element.tag == "include" and "filename" in element.attrib:
            yield element.attrib["filename"], True
        elif element.tag == "string" and element.attrib.get("name") == "filename" and "value" in element.attrib:
            yield element.attrib["value"], False


def _digest(path: Path) -> str:
    status = path.stat()
    return _digest_once(path, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=4096)
def _digest_once(path: Path, changed: int, size: int) -> str:
    """Hundreds of clips of one scene read its textures once."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
