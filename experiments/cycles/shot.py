"""Render what is missing of one clip up to a level; a process of its own, because ``bpy`` never gives memory back.

python -m experiments.cycles.shot FOLDER SET KIND SEED LEVEL
"""

import contextlib
import importlib
import os
import runpy
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from experiments.cycles import reference as references
from experiments.cycles.fingerprint import check_scene
from experiments.cycles.levels import Level, levels
from experiments.cycles.record import RECORD, write_record
from experiments.cycles.sets import Clip, clip
from experiments.cycles.staging.stage import Stage

PASSES = Path(__file__).parents[2] / "docs" / "how-to" / "blender_passes.py"
PILOT = 16
"""Samples a pixel of the first two halves of a reference."""


def render_clip(folder: Path, of: Clip, level: int) -> None:
    """Bring a clip to a level: noisy frames first, then references, then the record."""
    wanted = levels(of)[level]
    folder.mkdir(parents=True, exist_ok=True)
    build(of)
    check_scene(folder, of.frames)
    spent: dict[str, list[float]] = {}
    for draw in wanted.draws:
        for image in range(draw.images):
            name = f"{draw.samples}spp-{image}"
            for frame in range(1, min(draw.frames, of.frames) + 1):
                path = folder / name / f"{frame:04d}.exr"
                if not path.exists():
                    used = render(path, frame, draw.samples, seed_of(of, name))
                    spent.setdefault(name, []).append(used)
    found = {}
    for frame in range(1, of.frames + 1):
        path = folder / "reference" / f"{frame:04d}.exr"
        if path.exists() or frame in (wanted.reference_frames or range(1, of.frames + 1)):
            start = time.process_time()
            found[frame] = make_reference(path, of, frame, wanted)
            spent.setdefault("reference", []).append(time.process_time() - start)
    write_record(folder / RECORD, of, level, found, spent, settings())


def build(of: Clip, frames: int | None = None) -> None:
    """The scene of a clip, with the passes of the tutorial's script and this clip's pixels; ``frames``: of so many."""
    frames = of.frames if frames is None else frames
    stage = Stage(of.kind, of.seed, frames)
    scene = stage.scene
    importlib.import_module(f"experiments.cycles.kinds.{of.kind}").build(stage)
    blurred = scene.render.use_motion_blur
    runpy.run_path(str(PASSES))
    scene.render.use_motion_blur = blurred and of.kind == "blur"
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = 0.0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = of.pixel_filter
    scene.cycles.device = "CPU"
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.use_persistent_data = True
    scene.render.use_file_extension = False
    scene.render.resolution_x, scene.render.resolution_y = of.size
    scene.render.resolution_percentage = 100
    show_window(of)
    scene.frame_start, scene.frame_end = 1, frames


def show_window(of: Clip) -> None:
    """Render the pixels of a clip's window alone; Blender counts rows from the bottom."""
    render, (width, height), window = bpy.context.scene.render, of.size, of.window
    render.use_border = render.use_crop_to_border = (window.width, window.height) != (width, height)
    # Half a pixel inside, so that rounding never takes a neighbour.
    inset = 0.25
    render.border_min_x = (window.left + inset) / width
    render.border_max_x = (window.left + window.width + inset) / width
    render.border_min_y = (height - window.top - window.height + inset) / height
    render.border_max_y = (height - window.top + inset) / height


def settings() -> dict[str, Any]:
    """What a clip's record says of the renderer."""
    scene = bpy.context.scene
    return {
        "blender": bpy.app.version_string,
        "caustics": scene.cycles.caustics_reflective,
        "max_bounces": scene.cycles.max_bounces,
        "volume_bounces": scene.cycles.volume_bounces,
        "motion_blur": scene.render.motion_blur_shutter if scene.render.use_motion_blur else None,
        "sampling_pattern": scene.cycles.sampling_pattern,
        "light_tree": scene.cycles.use_light_tree,
    }


def seed_of(of: Clip, what: str) -> int:
    """The noise seed of one of a clip's renders; Cycles mixes it with the frame's number."""
    return zlib.crc32(f"{of.kind} {of.seed} {what}".encode()) & 0x7FFFFFFF


def render(path: Path, frame: int, samples: int, seed: int) -> float:
    """Render a frame into a file that appears only when it is whole; returns the processor time in seconds."""
    scene = bpy.context.scene
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.frame_set(frame)
    scene.render.filepath = str(part.absolute())
    start = time.process_time()
    with _quiet():
        bpy.ops.render.render(write_still=True)
    used = time.process_time() - start
    part.replace(path)
    return used


def make_reference(path: Path, of: Clip, frame: int, wanted: Level) -> references.Reference:
    """A frame's reference, refined from what is there until it is good enough or its time is spent.

    The time that earlier steps spent counts by its samples, at this run's price.
    """
    held = references.read(path) if path.exists() else None
    started, rendered = time.process_time(), 0
    count = PILOT
    while count:
        drawn = _halves(path, of, frame, count, 0 if held is None else held.draws)
        held = drawn if held is None else held + drawn
        rendered += count
        part = path.with_name(f".{path.name}.part")
        references.write(part, held)
        part.replace(path)
        price = (time.process_time() - started) / rendered
        count = references.more_samples(held, wanted.decibels, wanted.seconds, price * held.samples)
    assert held is not None
    return held


def _halves(path: Path, of: Clip, frame: int, samples: int, draw: int) -> references.Reference:
    """Two renders with seeds of their own."""
    scratch = path.with_name(f".{path.stem}.half.exr")
    images, guides = [], []
    for half in "ab":
        render(scratch, frame, samples, seed_of(of, f"reference {half} {draw}"))
        channels, _ = references.read_channels(scratch)
        image = np.stack([channels[f"ViewLayer.Combined.{c}"] for c in "RGB"], axis=-1)
        images.append(image.astype(np.float64))
        guides.append(references.guides(channels))
    scratch.unlink()
    return references.Reference(images[0], images[1], (guides[0] + guides[1]) / 2, samples, 1)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Blender reports every saved file on standard output; leave that out."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


if __name__ == "__main__":
    folder, name, kind, seed, level = sys.argv[1:]
    render_clip(Path(folder), clip(name, kind, int(seed)), int(level))
    sys.stdout.flush()
    os._exit(0)  # bpy sometimes crashes while the interpreter ends, when all files are written
