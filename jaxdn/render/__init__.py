"""Rendering animated scenes with Mitsuba 3: noisy layers, references, G-buffers and motion vectors.

The only subpackage that imports Mitsuba, and only when something is rendered.
"""

import importlib
from typing import Any

_HOMES = {
    "AnimatedScene": "scenes.scene",
    "Camera": "scenes.scene",
    "scene_from_record": "opening",
    "choose_variant": "mitsuba.variant",
    "use_variant": "mitsuba.variant",
    "ClipJob": "farm",
    "render_clips": "farm",
    "render_clip": "clip",
    "render_frame": "frame",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"jaxdn.render.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'jaxdn.render' has no attribute {name!r}; it has {', '.join(sorted(__all__))}")
