"""The contents of a clip's record (``clip.json``), and what follows from them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdn.core.frame import GUIDES
from jaxdn.data.errors import ClipError

FORMAT = 1
"""The version of the layout that this code writes and reads."""


def check_record(record: Any, file: Path) -> dict[str, Any]:
    """The record itself, if it is valid; raises ClipError, naming ``file`` and the entry, if it is not."""
    if not isinstance(record, dict):
        raise ClipError(f"{file}: expected a JSON object, got {type(record).__name__}.")
    if record.get("format") != FORMAT:
        raise ClipError(
            f"{file}: expected format {FORMAT}, got {record.get('format')!r}; this clip was written by another version."
        )
    for name in ("frames", "width", "height"):
        value = record.get(name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ClipError(f"{file}: {name}: expected a whole number of at least 1, got {value!r}.")
    layers = record.get("layers")
    if not isinstance(layers, list) or not layers or not all(type(n) is int and n > 0 for n in layers):
        raise ClipError(f"{file}: layers: expected a list of sample counts such as [1, 2, 4], got {layers!r}.")
    _check_plan(record.get("plan"), record["frames"], file)
    cameras = record.get("cameras")
    if cameras is not None and (not isinstance(cameras, list) or len(cameras) < record["frames"]):
        raise ClipError(f"{file}: cameras: expected a list with one for each frame; render the clip again.")
    return record


def is_planned(record: Mapping[str, Any]) -> bool:
    """Whether a clip was rendered by a plan: a missing buffer is an absent effect, not an omission."""
    return record.get("plan") is not None


def is_filtered(record: Mapping[str, Any]) -> bool:
    """Whether a clip's pixels are means over an area, with guides as noisy as the light, as other renderers' are.

    Records of earlier versions do not say it: all rays went through the centres of the pixels.
    """
    return bool(record.get("pixel_filter", "centre") != "centre")


def shared_with(record: Mapping[str, Any]) -> list[int]:
    """For each frame of a clip the one whose buffers it shares."""
    return list(record["plan"]["held"]) if is_planned(record) else list(range(record["frames"]))


def _check_plan(plan: Any, count: int, file: Path) -> None:
    """Raise ClipError unless a plan is None or lists each frame's buffers, whose they are, and the effects."""
    if plan is None:
        return
    held = plan.get("held") if isinstance(plan, Mapping) else None
    frames = plan.get("frames") if isinstance(plan, Mapping) else None
    valid = isinstance(held, list) and isinstance(frames, list) and len(held) == len(frames) == count
    if not valid or not all(type(at) is int and 0 <= at <= index for index, at in enumerate(held or [])):
        raise ClipError(f"{file}: plan: expected what each of {count} frames holds; render it again.")
    effects = plan.get("effects")
    if not isinstance(effects, list) or not all(isinstance(name, str) for name in effects):
        raise ClipError(f"{file}: plan: expected a list of effects, got {effects!r}; render the clip again.")
    for names in frames or []:
        if not isinstance(names, list) or not all(isinstance(name, str) and name in GUIDES for name in names):
            raise ClipError(f"{file}: plan: expected names of buffers, got {names!r}; render it again.")
