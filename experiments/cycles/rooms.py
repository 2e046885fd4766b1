"""The methods of the Cycles table on rooms of our own renderer, all light, as ``jaxdn denoise`` gives them.

    jaxdn render SCENES/kitchen/scene.xml --animation experiments/papers/rooms/kitchen.json --seeds 0-3 --frames 4 \\
        --width 320 --height 180 --light reflected --pixel-filter box --layers 1 4 16 --reference-spp 64 -o data/rooms
    python -m experiments.cycles.rooms data/rooms -o runs/rooms-all-light

Clips of one scene differ by their noise alone: that of seed 0 is denoised, and the references of all are averaged, so
that another seed makes them better. One JSON file for each room, sample count and method, so that a run goes on where
it was; the denoised frames stay, to be looked at. The table is written as ``quality-rooms-all-light.json``, in the
format of docs/results.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from experiments.cycles.compare import (
    PLAIN,
    figure_columns,
    find_method,
    mean_figures,
    print_table,
    read_beauty,
    read_rows,
)
from experiments.cycles.reference import Reference, decibels, noise
from experiments.cycles.score import score
from experiments.measurement import describe_measurement
from jaxdn.clips import frame_path, read_frames, read_record
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.runtime.atomic_files import write_json
from jaxdn.runtime.program_cache import keep_programs
from jaxdn.sequence.all_light import gather_light
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import NOISY

TRAINED_ON = ("bathroom", "kitchen", "living-room-2", "spaceship", "veach-ajar", "veach-lamp")
"""Rooms that ``steady`` and ``ntd`` were trained on."""
FIRST = "-0"
"""How the name of a clip ends whose noise is denoised."""


@dataclass
class Options:
    """Compare methods on rooms of our own renderer."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Clips: ROOM-0, which is denoised, and for its reference ROOM-1, ROOM-2 ..."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("runs/rooms-all-light")
    """Denoised frames and scores."""
    methods: list[str] = field(default_factory=lambda: [NOISY, "svgf" + PLAIN, "combiner-high" + PLAIN])
    """Names as of :mod:`experiments.cycles.compare`."""
    spp: list[int] = field(default_factory=lambda: [1, 4, 16])
    """Sample counts: layers of the clips, or sums of them."""
    rooms: list[str] = field(default_factory=list)
    """Names of rooms; default: all that are there."""


def main(options: Options) -> int:
    """Measure what is missing, and print the table."""
    keep_programs()
    rooms = find_rooms(options.folder, options.rooms)
    for room, clips in rooms.items():
        held = read_references(clips)
        samples = held[0].samples * 2
        own = decibels(float(np.mean([noise(one) for one in held])))
        print(f"{room}: references of {samples} samples a pixel, their own noise {own:.1f} dB", flush=True)
        for spp in options.spp:
            for method in options.methods:
                measure(room, clips[0], held, spp, method, options.out)
    rows = read_rows(options.out, rooms)
    for spp in options.spp:
        print_table([row for row in rows if row["spp"] == spp and row["method"] in options.methods], spp)
    write_json(options.out / "quality-rooms-all-light.json", table(rows, options))
    return 0


def find_rooms(folder: Path, wanted: Sequence[str]) -> dict[str, list[Path]]:
    """Name of a room -> its clips, that of seed 0 first. Raises ValueError where there is none."""
    names = [clip.parent.name.removesuffix(FIRST) for clip in sorted(folder.glob(f"*{FIRST}/clip.json"))]
    found = {
        name: sorted(clip.parent for clip in folder.glob(f"{name}-*/clip.json") if _room_of(clip.parent) == name)
        for name in names
        if not wanted or name in wanted
    }
    if not found:
        rooms = ", ".join(wanted) or "any room"
        raise ValueError(f"{folder}: expected clips ROOM{FIRST} of {rooms}, found none; render some with --seeds 0.")
    return found


def _room_of(clip: Path) -> str:
    """The name without the seed: ``living-room-2-0`` is of the room living-room-2."""
    return clip.name.rpartition("-")[0]


def read_references(clips: Sequence[Path]) -> list[Reference]:
    """The reference of each frame: the mean of those of all clips, weighted by their samples, emitted light included.

    The halves have the same emitted light, whose noise, at the edges of lamps alone, is not known.
    """
    return [reduce(Reference.__add__, frames) for frames in zip(*map(_read_clip, clips), strict=True)]


def _read_clip(clip: Path) -> list[Reference]:
    record, found = read_record(clip), []
    for stored in read_frames(clip, spp=record["layers"][0]):
        if stored.reference is None or stored.reference_half is None or not stored.reference_guides:
            raise ValueError(f"{clip}: expected filtered pixels and a reference; render it with --reference-spp 64.")
        emitted = stored.reference_guides.get("emission", 0.0)
        both, first = (np.asarray(half, np.float64) for half in (stored.reference, stored.reference_half))
        names = ("albedo", "normal")
        guides = [*(stored.reference_guides[name] for name in names), stored.frame.depth]
        seen = np.concatenate([np.asarray(guide, np.float64) for guide in guides], axis=-1)
        halves = first + emitted, 2 * both - first + emitted
        found.append(Reference(*halves, seen, record["reference_spp"] // 2, 1))
    return found


def measure(room: str, clip: Path, held: Sequence[Reference], spp: int, method: str, out: Path) -> None:
    """Denoise a clip's frames of one sample count and write their scores, unless that is done."""
    target = out / room / f"{spp}spp" / method.replace("/", "_")
    if target.with_suffix(".json").is_file():
        return
    frames = [gather_light(stored).frame for stored in read_frames(clip, spp=spp)]
    images = denoise_clip(clip, frames, spp, method, target)
    paired = range(len(frames) // 2 * 2)
    found = score(
        [images[index] for index in paired],
        [held[index] for index in paired],
        [None if (motion := frames[index].motion) is None else np.asarray(motion) for index in paired],
    ).figures()
    target.parent.mkdir(parents=True, exist_ok=True)
    write_json(target.with_suffix(".json"), {"clip": room, "kind": room, "spp": spp, "method": method, **found})
    print(f"{room} {spp} spp {method}: {found}", flush=True)
    jax.clear_caches()  # as in experiments.cycles.compare


def denoise_clip(clip: Path, frames: Sequence[Frame], spp: int, method: str, target: Path) -> list[np.ndarray]:
    """The images of a clip's frames, from the files that were written: all light."""
    if method == NOISY:
        return [np.asarray(frame.radiance) for frame in frames]
    model, safe = find_method(method)
    denoise_files([clip], target, model, Settings(spp=spp, safe=safe))
    return [read_beauty(frame_path(target, index)) for index in range(len(frames))]


def table(rows: Sequence[Mapping[str, Any]], options: Options) -> dict[str, Any]:
    """The means over the rooms: a row for each sample count and method; the PSNR of each room beside."""
    rooms = sorted({row["clip"] for row in rows})
    columns: list[dict[str, Any]] = [{"name": "samples"}, {"name": "method"}, *figure_columns()]
    columns += [{"name": f"PSNR, {room}", "decimals": 2, "best": "higher"} for room in rooms]
    lines = []
    for spp in options.spp:
        for method in options.methods:
            of = [row for row in rows if row["spp"] == spp and row["method"] == method]
            each = {row["clip"]: row["psnr"] for row in of}
            lines.append([spp, f"`{method}`", *mean_figures(of), *(each.get(room) for room in rooms)])
    what = (
        f"Means over {len(rooms)} rooms of our own renderer (Mitsuba), all light, filtered pixels (box), 320 x 180, "
        "four frames with a moving camera and a moving ball; files as `jaxdn denoise` writes them, `+no-safe` with "
        "`--no-safe`. PSNR of x / (1 + x) in dB, without the references' noise; *edges* are the tenth of the pixels "
        "whose guides differ most from their neighbours'; *temporal* is the PSNR of the change between two frames."
    )
    if known := [room for room in rooms if room in TRAINED_ON]:
        what += (
            f" `steady` and `ntd` were trained on {' and '.join(known)}; the training of `combiner`, on clips of "
            "Cycles alone, began with weights of `steady`."
        )
    command = f"python -m experiments.cycles.rooms {options.folder.name} --methods {' '.join(options.methods)}"
    described = describe_measurement(
        "table", "Rooms of our own renderer, all light", "Quality", 20, command=command, what=what, rows=lines
    )
    return {**described, "columns": columns, "group": "samples"}


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
