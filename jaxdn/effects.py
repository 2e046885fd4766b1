"""Simulate only the effects that a scene has: find them, and plan what they need and what may be left out.

``inspect`` finds the effects of a scene or a finished clip, ``plan`` intersects them with what a denoiser reads, and
the renderer follows the plan. What is left out is ``None`` in a :class:`jaxdn.Frame` and not in the compiled step: the
result is that of the neutral value, at a lower cost.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdn.planning.catalogue import EFFECTS as EFFECTS
from jaxdn.planning.catalogue import Effect as Effect
from jaxdn.planning.facts import Facts as Facts
from jaxdn.planning.facts import Light as Light
from jaxdn.planning.facts import Moment as Moment
from jaxdn.planning.facts import Surface as Surface
from jaxdn.planning.found import Effects as Effects
from jaxdn.planning.found import chosen as chosen
from jaxdn.planning.found import everything as everything
from jaxdn.planning.found import find as find
from jaxdn.planning.plan import BOUND as BOUND
from jaxdn.planning.plan import Plan as Plan
from jaxdn.planning.plan import plan as plan
from jaxdn.planning.plan import plan_from_record as plan_from_record


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
        :class:`Facts`.
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
    if isinstance(scene, Facts):
        return find(scene._replace(moments=scene.moments[:frames]))
    if _is_footage(scene):
        from jaxdn.data.evidence import read_facts
        from jaxdn.data.foreign.naming import ChannelNaming

        facts = read_facts(scene, animation, ChannelNaming(channels=channels, layer=layer))
        return find(facts._replace(moments=facts.moments[:frames]))
    from jaxdn.render.opening import open_scene
    from jaxdn.render.scene_facts import facts_of

    return find(facts_of(open_scene(scene, animation), width=width, height=height, frames=frames))


def _is_footage(scene: Any) -> bool:
    """A folder of frames, or a pattern for EXR files."""
    return isinstance(scene, str | Path) and (Path(scene).is_dir() or str(scene).endswith(".exr"))
