"""Opening animated scenes: from a clip's record, a scene file, a family's name, or a scene loaded by Mitsuba."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdn.render.families import FAMILIES
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.later import Later
from jaxdn.render.scenes.loaded import LoadedScene
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.scenes.scene_file import SceneFile


def scene_from_record(record: Mapping[str, Any]) -> AnimatedScene:
    """Build the scene that a clip's record describes: ``{"family": name, "seed": int, ...}``, or a scene file's.

    Keys other than ``family`` become the keyword arguments of the family's function; ``{"file": ..., "animation":
    ...}`` is an animated scene file. With ``"start": frame`` it is the later part of either that begins there. Raises
    ValueError for a record that names neither, and for an unknown family.
    """
    if "start" in record:
        return Later(
            scene_from_record({key: value for key, value in record.items() if key != "start"}), record["start"]
        )
    if "file" in record:
        return SceneFile.from_record(record)
    if "family" not in record:
        raise ValueError(
            f"scene record: expected a 'family' or a 'file', got {sorted(record)}; see jaxdn.render.families."
        )
    name = record["family"]
    if name not in FAMILIES:
        raise ValueError(f"scene record: unknown family {name!r}; expected one of {', '.join(sorted(FAMILIES))}.")
    options = {key: value for key, value in record.items() if key != "family"}
    return FAMILIES[name](**options)


def family_scene(name: str, seed: int, animation: Any = None) -> AnimatedScene:
    """A scene of a family. Raises ValueError for an animation, which belongs to scene files: families move already."""
    if animation is not None:
        raise ValueError(
            f"animation {animation}: expected none for the family {name!r}, which moves already; leave it out."
        )
    return scene_from_record({"family": name, "seed": seed})


def open_scene(scene: Any, animation: Any = None) -> AnimatedScene:
    """A scene file, a family's name (its seed 0), a loaded ``mi.Scene``, or a scene as Mitsuba's dict, as a scene.

    ``animation`` is an animation file, or its contents, for a scene file or a loaded scene; an animated scene is
    returned unchanged. Raises ValueError for anything else, and for files that cannot be read.
    """
    if isinstance(scene, str | Path):
        return _named(scene, animation)
    if isinstance(scene, Mapping):
        use_variant()
        import mitsuba as mi

        return LoadedScene(mi.load_dict(dict(scene), optimize=False), animation)
    if hasattr(scene, "shapes") and hasattr(scene, "sensors"):
        return LoadedScene(scene, animation)
    if not isinstance(scene, AnimatedScene):
        raise ValueError(f"scene: expected a scene file, a family, an mi.Scene or an AnimatedScene, got {type(scene)}.")
    return scene


def _named(scene: str | Path, animation: Any) -> AnimatedScene:
    """The scene of a family's name or a file's path."""
    if str(scene) in FAMILIES:
        return family_scene(str(scene), 0, animation)
    if Path(scene).suffix != ".xml":
        raise ValueError(
            f"scene {str(scene)!r}: expected a Mitsuba scene (.xml), a folder of frames, or a family "
            f"({', '.join(sorted(FAMILIES))})."
        )
    if isinstance(animation, Mapping):
        return SceneFile.from_record({"file": str(scene), "animation": dict(animation)})
    return SceneFile(scene, animation)
