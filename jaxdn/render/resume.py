"""Check that the frames that a folder already has were rendered with the settings that are wanted now."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdn.data.errors import ClipError
from jaxdn.render.scene_digest import SCENE_FILE, SCENE_PARTS, find_edited
from jaxdn.render.settings import LATER_SETTINGS

_FREE = ("frames", "cameras", "versions", "bad_samples", SCENE_FILE, SCENE_PARTS)
"""Entries of a record that may change when rendering is resumed, or that are compared in a way of their own."""


def check_resumable(folder: Path, wanted: Mapping[str, Any], begun: Mapping[str, Any]) -> None:
    """Raise ClipError if the frames in a folder were rendered with other settings, naming those; both are records.

    A clip may get more frames, but not fewer than it was begun with.
    """
    # What both records say about the same frames is compared.
    common = min(int(begun["frames"]), int(wanted["frames"]))
    both = [{**LATER_SETTINGS, **record, "plan": _cut_plan(record.get("plan"), common)} for record in (begun, wanted)]
    names = [name for name in wanted if name not in _FREE]
    differing = [line for name in names for line in _describe_differences(name, both[0].get(name), both[1][name])]
    cameras = zip(begun.get("cameras", []), wanted["cameras"], strict=False)
    if any(_make_plain(first) != _make_plain(second) for first, second in cameras):
        differing.append("another camera path")
    for name in find_edited(begun, wanted):
        whole = f"the scene file {wanted['scene']['file']}"
        differing.append(f"{name}, which {whole} reads, has been edited" if name else f"{whole} has been edited")
    if differing or wanted["frames"] < begun["frames"]:
        if begun["frames"] != wanted["frames"]:
            differing.insert(0, f"{begun['frames']} frames there, {wanted['frames']} wanted")
        what = "; ".join(dict.fromkeys(differing))
        raise ClipError(f"{folder}: was rendered with other settings ({what}); choose another folder or remove it.")


def _cut_plan(plan: Mapping[str, Any] | None, frames: int) -> dict[str, Any] | None:
    """What a plan's record says about the first frames; the names of its effects follow from that."""
    if plan is None:
        return None
    cut = {name: plan[name][:frames] for name in ("frames", "held")}
    return {name: value for name, value in plan.items() if name != "effects"} | cut


def _describe_differences(name: str, there: Any, wanted: Any) -> list[str]:
    """In words, one for each entry, where two values of a record differ; long ones are not written out."""
    # Compared in the form read from JSON, where tuples have become lists.
    there, wanted = _make_plain(there), _make_plain(wanted)
    if there == wanted:
        return []
    if isinstance(there, dict) and isinstance(wanted, dict):
        keys = dict.fromkeys((*wanted, *there))
        return [
            line for key in keys for line in _describe_differences(f"{name} {key}", there.get(key), wanted.get(key))
        ]
    if name == "plan frames":
        pairs = ((index, set(old), set(new)) for index, (old, new) in enumerate(zip(there, wanted, strict=True)))
        index, old, new = next((index, old, new) for index, old, new in pairs if old != new)
        lists = (", ".join(sorted(buffers)) or "no more" for buffers in (old - new, new - old))
        return ["buffers of frame {}: {} there, {} wanted".format(index, *lists)]
    name = name.removeprefix("plan ")
    if len(f"{there}{wanted}") > 120:
        return [f"{name} differs"]
    return [f"{name}: {there} there, {wanted} wanted"]


def _make_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _make_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_make_plain(item) for item in value]
    return value
