"""``jaxdn inspect``: which effects a scene has and why, what will be rendered for them, and what that saves.

Of files of other renderers: what is read from them (:mod:`jaxdn.commands.inspect_files`).
"""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.table import Table

from jaxdn.commands.channel_table import show_channel_mapping
from jaxdn.commands.inspect_files import inspect_files
from jaxdn.core.frame import BUFFERS, OF_SAMPLES
from jaxdn.data.clip.folder import is_clip
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.shots import is_named, is_pattern, ranges
from jaxdn.denoiser import Denoiser
from jaxdn.effects import EFFECTS, Plan, choose_all_effects, inspect, plan
from jaxdn.render.open_scene import open_scene
from jaxdn.render.settings import RenderSettings
from jaxdn.runtime.terminal import plain_console
from jaxdn.sequence.render_jobs import PlannedClip, find_denoiser, plan_clip

EVERYTHING = plan(choose_all_effects(1))
"""The plan that corresponds to rendering everything."""
_SIDE = 128
"""Pixels of a side of a scene's frames, if nothing else is asked for."""


def inspect_to_terminal(
    sources: Sequence[str],
    *,
    animation: Path | None,
    denoiser: str | None,
    width: int | None,
    height: int | None,
    frames: int | None,
    as_json: bool,
    naming: ChannelNaming,
    overlay: Path | None = None,
) -> None:
    """Print the table of effects and the plan for a scene, a family or a finished clip.

    Of a finished clip, first what is read from which layer; of files of other renderers, only that and what is missing.

    Args:
      sources: a Mitsuba scene (.xml), a family, a finished clip, or a folder of or pattern for EXR files; or the names
        of several EXR files.
      animation: animation file for a scene file.
      denoiser: name of the denoiser to plan for; None: for every buffer that a denoiser may read.
      width: of a scene's frames in pixels; None: 128.
      height: likewise.
      frames: number of frames to inspect; None: all.
      as_json: print only one JSON object.
      naming: what is stated about the channels of other renderers' files.
      overlay: folder for the validation page of such files; None: there is none.
    """
    if not sources:
        raise ValueError("expected a scene, a family, a clip, or EXR files to inspect, got none; name one.")
    reader = None if denoiser is None else find_denoiser(denoiser)
    source = sources[0]
    if other := [name for name in sources if len(sources) > 1 and not is_named(Path(name))]:
        raise ValueError(f"{other[0]}: expected one scene, clip, folder or pattern, or several EXR files; name one.")
    clip = is_clip(source)
    sizes = [name for name, side in (("--width", width), ("--height", height)) if side is not None]
    if sizes and (clip or len(sources) > 1 or _are_frames(source)):
        raise ValueError(f"{source}: expected none of {', '.join(sizes)}, as its frames have a size; leave it out.")
    if not clip and (len(sources) > 1 or _are_frames(source)):
        if animation is not None or frames is not None:
            raise ValueError(f"{source}: expected none of --animation, --frames, which are for scenes and own clips.")
        reads = None if reader is None else reader.reads
        named = source if len(sources) == 1 else [Path(name) for name in sources]
        inspect_files(named, reads=reads, as_json=as_json, naming=naming, overlay=overlay)
        return
    if overlay is not None:
        raise ValueError(f"--overlay: expected EXR files of other renderers, got {source}; leave it out.")
    if not clip and naming.options:
        raise ValueError(
            f"scene {source!r}: expected none of --channels, --layer, --motion-convention, --view, which are for EXR "
            "files."
        )
    if clip and naming.options:
        raise ValueError(
            f"{source}: expected none of --channels, --layer, --motion-convention, --view, which are for files of "
            "other renderers; it is a clip of jaxdn's own."
        )
    if clip and not as_json:
        reads = None if reader is None else reader.reads
        show_channel_mapping(source, read_channel_mapping(source), reads=reads)
    with _nothing_else_on_stdout():
        height, width = (_SIDE if side is None else side for side in (height, width))
        planned = _planned(source, animation, reader, width=width, height=height, frames=frames)
    if as_json:
        found = planned.effects
        record: dict[str, Any] = {
            "effects": list(found),
            "plan": plan_record(planned, reader),
            "uncertain": sorted(found.uncertain),
        }
        if clip:
            record["sources"] = [mapped._asdict() for mapped in read_channel_mapping(source)]
        print(json.dumps(record, indent=1))
        return
    _show(source, planned, reader, denoiser)


def _are_frames(source: str) -> bool:
    """Whether a name is that of a folder or of a file, or a pattern, and not a scene."""
    path = Path(source)
    if path.suffix == ".xml" and not path.is_dir():
        return False
    return path.is_dir() or is_named(path) or source.lower().endswith(".exr") or is_pattern(source)


def _planned(
    source: str,
    animation: Path | None,
    reader: Denoiser | None,
    *,
    width: int,
    height: int,
    frames: int | None,
) -> PlannedClip:
    """The effects of a scene or a finished clip, and what would be rendered for them."""
    if is_clip(source):
        found = inspect(source, animation, frames=frames)
        return PlannedClip(found, plan(found, reader))
    scene = open_scene(source, animation)
    count = scene.frames if frames is None else frames
    planned = plan_clip(scene, RenderSettings(width=width, height=height), frames=count, denoiser=reader)
    assert planned is not None  # only "all" has no plan
    return planned


def plan_record(planned: PlannedClip, reader: Denoiser | None) -> dict[str, Any]:
    """A plan as JSON, with how its path length was measured, and with derived figures."""
    made, depth = planned.plan, planned.depth
    return {
        **made.record(),
        "bound": None if depth is None else depth.bound,
        "remaining": None if depth is None else round(depth.remaining, 4),
        "motion": motion(made),
        "buffers": list(made.buffers),
        "channels": list_channels(made.buffers),
        "programs": made.programs(None if reader is None else reader.reads),
        "buffers_left_out": len(left_out(made)),
        "frames_with_noise_alone": noise_alone(made),
        "bytes_a_pixel": bytes_a_pixel(made),
        "bytes_a_pixel_of_all": bytes_a_pixel(EVERYTHING),
    }


def motion(made: Plan) -> str:
    """Which motion vectors are rendered: ``none``, ``traditional`` or ``dual``."""
    return "dual" if "dual_motion" in made.buffers else "traditional" if "motion" in made.buffers else "none"


def left_out(made: Plan) -> list[str]:
    """The buffers that this plan leaves out."""
    return [name for name in EVERYTHING.buffers if name not in made.buffers]


def noise_alone(made: Plan) -> int:
    """How many frames share everything except the noise with an earlier one."""
    return sum(source != index for index, source in enumerate(made.shared_with))


def list_channels(buffers: tuple[str, ...]) -> list[str]:
    """The EXR channels of some buffers."""
    return [f"{name}.{letter}" for name in buffers for letter in BUFFERS[name].letters]


def bytes_a_pixel(made: Plan) -> float:
    """Mean bytes per pixel and frame before compression, including one noisy layer, the reference and its half."""
    light = BUFFERS["radiance"].bytes
    whole = [3 * light + sum(BUFFERS[name].bytes for name in names) for names in made.frames]
    noise = [light + sum(BUFFERS[name].bytes for name in OF_SAMPLES & set(names)) for names in made.frames]
    stored = [noise[index] if source != index else whole[index] for index, source in enumerate(made.shared_with)]
    return round(sum(stored) / len(stored), 2)


@contextmanager
def _nothing_else_on_stdout() -> Iterator[None]:
    """Redirect everything printed, also by the renderer's threads and C++ code, to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def _show(source: str, planned: PlannedClip, reader: Denoiser | None, name: str | None) -> None:
    found, made, depth = planned.effects, planned.plan, planned.depth
    console = plain_console()
    table = Table(title=f"{source}: {len(found)} of {len(EFFECTS)} effects, {len(found.frames)} frames")
    for column in ("effect", "there", "frames", "why"):
        table.add_column(column, overflow="fold")
    for effect in EFFECTS:
        there = "" if effect.name not in found else "uncertain" if effect.name in found.uncertain else "yes"
        why = found.uncertain.get(effect.name) or found.why.get(effect.name) or effect.sentence
        where = ranges([index for index, present in enumerate(found.frames) if effect.name in present])
        table.add_row(effect.name, there, where, why, style=None if there else "dim")
    console.print(table)
    measured = ""
    if depth is not None:
        limit = "" if depth.remaining <= depth.bound else ", the scene's own limit"
        measured = f"{limit}: longer ones would add {depth.remaining:.1%} of the light (bound {depth.bound:.0%})"
    console.print(f"integrator    {made.integrator}, paths of depth {made.max_depth}{measured}")
    console.print(f"motion        {motion(made)}")
    console.print(f"buffers       {', '.join(made.buffers)}")
    console.print(f"left out      {', '.join(left_out(made)) or 'nothing'}")
    reader_name = "any denoiser" if name is None else name
    console.print(f"programs      {made.programs(None if reader is None else reader.reads)} compiled for {reader_name}")
    console.print(f"rendered once {noise_alone(made)} of {len(made.shared_with)} frames store only their noise")
    sizes = f"{bytes_a_pixel(made):g} of {bytes_a_pixel(EVERYTHING):g} bytes per pixel and frame"
    console.print(f"on disk       {sizes}, uncompressed")
