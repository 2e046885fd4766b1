"""Rendering animated scenes with Mitsuba 3: noisy layers, references, G-buffers and motion vectors.

The only subpackage that imports Mitsuba, and only when something is rendered.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxdn.render.clip import render_clip as render_clip
    from jaxdn.render.clip_job import ClipJob as ClipJob
    from jaxdn.render.clip_job import UnplannedClip as UnplannedClip
    from jaxdn.render.frame import render_frame as render_frame
    from jaxdn.render.mitsuba.variant import choose_variant as choose_variant
    from jaxdn.render.mitsuba.variant import use_variant as use_variant
    from jaxdn.render.open_scene import scene_from_record as scene_from_record
    from jaxdn.render.scenes.scene import AnimatedScene as AnimatedScene
    from jaxdn.render.scenes.scene import Camera as Camera
    from jaxdn.render.settings import RenderSettings as RenderSettings
    from jaxdn.render.worker_pool import render_clips as render_clips

_HOMES = {
    "AnimatedScene": "scenes.scene",
    "Camera": "scenes.scene",
    "scene_from_record": "open_scene",
    "choose_variant": "mitsuba.variant",
    "use_variant": "mitsuba.variant",
    "ClipJob": "clip_job",
    "UnplannedClip": "clip_job",
    "render_clips": "worker_pool",
    "render_clip": "clip",
    "render_frame": "frame",
    "RenderSettings": "settings",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"jaxdn.render.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'jaxdn.render' has no attribute {name!r}; it has {', '.join(sorted(__all__))}")
