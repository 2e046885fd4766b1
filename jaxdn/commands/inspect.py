"""``jaxdn inspect``: which effects a scene has and why, what will be rendered for them, and what that saves."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from jaxdn import denoisers
from jaxdn.clips.frames import LAYOUT
from jaxdn.commands.compare import method_named
from jaxdn.denoiser import Denoiser
from jaxdn.effects import EFFECTS, Effects, Plan, chosen, inspect, plan
from jaxdn.frame import Frame

_BYTES = {"half": 2, "float": 4, "ids": 4, "bool": 2}


def denoiser_named(name: str) -> Denoiser | None:
    """A denoiser to plan for: a factory's name, shipped weights or a file; its weights do not matter here."""
    return getattr(denoisers, name)() if name in denoisers.NAMES else method_named(name).denoiser


def plan_clip(
    scene: Any,
    *,
    effects: str = "auto",
    denoiser: Denoiser | None = None,
    width: int,
    height: int,
    frames: int,
    max_depth: int | None = None,
) -> tuple[Effects, Plan] | None:
    """The effects to render an animated scene for, and the plan; None is to render everything (``"all"``).

    ``effects`` is ``"auto"``, ``"all"``, or names joined by commas. With ``"auto"`` the path length is measured unless
    ``max_depth`` is given. Raises ValueError for a name that is no effect.
    """
    if effects == "all":
        return None
    if effects != "auto":
        found = chosen([name.strip() for name in effects.split(",") if name.strip()], frames)
        return found, plan(found, denoiser, max_depth=max_depth)
    from jaxdn.render.depth import measure_depth

    found = inspect(scene, width=width, height=height, frames=frames)
    if max_depth is not None or "indirect" not in found or "media" in found:
        return found, plan(found, denoiser, max_depth=max_depth)
    depth = measure_depth(scene)
    return found, plan(found, denoiser, max_depth=depth.max_depth, bound=depth.bound, remaining=depth.remaining)


def inspect_to_terminal(
    source: str,
    *,
    animation: Path | None,
    denoiser: str | None,
    width: int,
    height: int,
    frames: int | None,
    as_json: bool,
) -> None:
    """Print the table, or with ``as_json`` nothing but one JSON object, for a scene, a family or a finished clip."""
    reader = None if denoiser is None else denoiser_named(denoiser)
    with _nothing_else_on_stdout():
        if Path(source).is_dir() or source.endswith(".exr"):
            found = inspect(source, animation, frames=frames)
            made = plan(found, reader)
        else:
            from jaxdn.render.scene_facts import open_scene

            scene = open_scene(source, animation)
            count = scene.frames if frames is None else frames
            planned = plan_clip(scene, denoiser=reader, width=width, height=height, frames=count)
            assert planned is not None  # only "all" has no plan
            found, made = planned
    if as_json:
        record = {"effects": list(found.names), "plan": told(made, reader), "uncertain": sorted(found.uncertain)}
        print(json.dumps(record, indent=1))
        return
    _show(source, found, made, reader, denoiser)


def told(made: Plan, reader: Denoiser | None) -> dict[str, Any]:
    """A plan as JSON, with what follows from it."""
    everything = len(Frame._fields) - 1
    return {
        **made.record(),
        "buffers": list(made.buffers),
        "channels": channels(made.buffers),
        "programs": made.programs(None if reader is None else reader.reads),
        "buffers_left_out": everything - len(made.buffers),
        "frames_with_noise_alone": sum(held != index for index, held in enumerate(made.held)),
        "bytes_a_pixel": bytes_a_pixel(made),
        "bytes_a_pixel_of_all": bytes_a_pixel(None),
    }


def channels(buffers: tuple[str, ...]) -> list[str]:
    """The EXR channels of some buffers."""
    return [f"{name}.{letter}" for name in buffers for letter in LAYOUT[name].channels]


def bytes_a_pixel(made: Plan | None) -> float:
    """Mean bytes a pixel and frame before compression, one noisy layer and a reference with its half included."""

    def size(names: tuple[str, ...]) -> int:
        return sum(_BYTES[LAYOUT[name].kind] * len(LAYOUT[name].channels) for name in names)

    light = 3 * _BYTES["half"]
    if made is None:
        return float(3 * light + size(tuple(LAYOUT)))
    whole = [light if held != index else 3 * light + size(made.frames[index]) for index, held in enumerate(made.held)]
    return round(sum(whole) / len(whole), 2)


@contextmanager
def _nothing_else_on_stdout() -> Iterator[None]:
    """Send what others print to standard error, the renderer's own threads and C++ included."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def _show(source: str, found: Effects, made: Plan, reader: Denoiser | None, name: str | None) -> None:
    console = Console()
    table = Table(title=f"{source}: {len(found)} of {len(EFFECTS)} effects, {len(found.frames)} frames")
    for column in ("effect", "there", "frames", "why"):
        table.add_column(column, overflow="fold")
    for effect in EFFECTS:
        there = "" if effect.name not in found else "uncertain" if effect.name in found.uncertain else "yes"
        why = found.uncertain.get(effect.name) or found.why.get(effect.name) or effect.sentence
        where = _ranges([index for index, present in enumerate(found.frames) if effect.name in present])
        table.add_row(effect.name, there, where, why, style=None if there else "dim")
    console.print(table)
    left = [each for each in Frame._fields if each not in ("radiance", *made.buffers)]
    noise_alone = sum(held != index for index, held in enumerate(made.held))
    measured = ""
    if made.bound is not None and made.remaining is not None:
        limit = "" if made.remaining <= made.bound else ", the scene's own limit"
        measured = f"{limit}: longer ones would add {made.remaining:.1%} of the light (bound {made.bound:.0%})"
    console.print(f"integrator    {made.integrator}, paths of depth {made.max_depth}{measured}")
    console.print(f"motion        {made.motion}")
    console.print(f"demodulation  {made.demodulation}")
    console.print(f"lobes apart   {'yes' if made.lobes_apart else 'no'}")
    console.print(f"gradients     {'yes' if made.gradient_samples else 'no'}")
    console.print(f"buffers       {', '.join(made.buffers)}")
    console.print(f"left out      {', '.join(left) or 'nothing'}")
    for_whom = "any denoiser" if name is None else name
    console.print(f"programs      {made.programs(None if reader is None else reader.reads)} compiled for {for_whom}")
    console.print(f"rendered once {noise_alone} of {len(made.held)} frames hold the noise alone")
    console.print(
        f"on disk       {bytes_a_pixel(made):g} of {bytes_a_pixel(None):g} bytes a pixel and frame, uncompressed"
    )


def _ranges(indices: list[int]) -> str:
    """``0-3, 7``."""
    parts: list[str] = []
    for index in indices:
        if parts and index == int(parts[-1].split("-")[-1]) + 1:
            parts[-1] = f"{parts[-1].split('-')[0]}-{index}"
        else:
            parts.append(str(index))
    return ", ".join(parts)
