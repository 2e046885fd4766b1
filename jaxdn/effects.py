"""Simulate only the effects that a scene has: detect them, and plan what they need and what may be left out.

``inspect`` detects the effects of a scene or a finished clip, ``plan`` intersects them with what a denoiser reads, and
the renderer follows the plan. What is left out is ``None`` in a :class:`jaxdn.Frame` and not in the compiled step: the
result is that of the neutral value, at a lower cost.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdn.planning.catalogue import EFFECTS as EFFECTS
from jaxdn.planning.catalogue import Effect as Effect
from jaxdn.planning.detected_effects import Effects as Effects
from jaxdn.planning.detected_effects import choose_all_effects as choose_all_effects
from jaxdn.planning.detected_effects import choose_effects as choose_effects
from jaxdn.planning.detected_effects import detect_effects as detect_effects
from jaxdn.planning.plan import BOUND as BOUND
from jaxdn.planning.plan import Plan as Plan
from jaxdn.planning.plan import plan as plan
from jaxdn.planning.plan import plan_from_record as plan_from_record
from jaxdn.planning.scene_properties import Light as Light
from jaxdn.planning.scene_properties import Moment as Moment
from jaxdn.planning.scene_properties import SceneProperties as SceneProperties
from jaxdn.planning.scene_properties import Surface as Surface


def inspect(
    scene: Any,
    animation: Any = None,
    *,
    width: int = 128,
    height: int = 128,
    frames: int | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
) -> Effects:
    """The effects that a scene, or a finished clip, has.

    Args:
      scene: a Mitsuba scene file, the name of a family, a folder of a clip or of EXR files of any renderer, an
        :class:`jaxdn.render.AnimatedScene`, a loaded ``mi.Scene`` (``optimize=False``), a scene as Mitsuba's dict, or
        :class:`SceneProperties`.
      animation: animation file (or its contents, as a dict) for a scene file or a loaded scene.
      width: of the image in pixels; with ``height`` it decides what is on screen.
      height: of the image in pixels.
      frames: number of frames to inspect; default: all of the scene's animation, or of the clip.
      channels: of EXR files of other renderers, as in :func:`jaxdn.clips.open_frames`.
      layer: the same.

    An undecidable effect counts as present and is listed in ``uncertain``. A scene takes milliseconds besides loading;
    a clip has to be read. Raises ValueError for any other ``scene``, and for files that cannot be read.
    """
    if frames is not None and frames < 1:
        raise ValueError(f"frames: expected at least 1, got {frames}.")
    if isinstance(scene, SceneProperties):
        return detect_effects(scene._replace(moments=scene.moments[:frames]))
    if _is_footage(scene):
        from jaxdn.data.evidence import read_clip_properties
        from jaxdn.data.foreign.classify import ChannelNaming

        properties = read_clip_properties(scene, animation, ChannelNaming(channels=channels, layer=layer))
        return detect_effects(properties._replace(moments=properties.moments[:frames]))
    from jaxdn.render.open_scene import open_scene
    from jaxdn.render.scene_properties import read_scene_properties

    return detect_effects(
        read_scene_properties(open_scene(scene, animation), width=width, height=height, frames=frames)
    )


def _is_footage(scene: Any) -> bool:
    """A folder of frames, or a pattern for EXR files."""
    return isinstance(scene, str | Path) and (Path(scene).is_dir() or str(scene).endswith(".exr"))
