"""Frames of a clip without its motion blur and depth of field, as ``jaxdn denoise --reblur`` wants them.

    .venv-cycles/bin/python -m experiments.cycles.sharp FOLDER/train/blur-0000 FOLDER/sharp/blur-0000 --spp 4 16

The scene is that of the clip, to its mark; each sample count gets a folder. What the camera did is in the files, by
OpenEXR's standard attributes: exposure and frames a second, f-number, focus, focal length, and the pitch of the pixels
on the sensor.
"""

import argparse
import os
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import bpy
import OpenEXR

from experiments.cycles.fingerprint import FILE, fingerprint
from experiments.cycles.record import RECORD, read_record
from experiments.cycles.sets import Clip, clip
from experiments.cycles.shot import build, render, seed_of


def render_sharp(folder: Path, out: Path, samples: int) -> None:
    """Render the frames of the clip in ``folder`` sharp. Raises ValueError where its scene is another one by now."""
    record = read_record(folder / RECORD)
    if record is None:
        raise ValueError(f"{folder}: expected a clip with a {RECORD}, found none; render one first")
    of, frames = clip(record["set"], record["kind"], record["seed"]), record["frames"]
    build(of, frames)
    if fingerprint(frames) != (folder / FILE).read_text().strip():
        raise ValueError(f"{folder}: expected the scene that its frames show, but this code makes another one")
    scene, lens = bpy.context.scene, bpy.context.scene.camera.data.dof.use_dof
    scene.render.use_motion_blur = scene.camera.data.dof.use_dof = False
    for frame in range(1, frames + 1):
        path = out / f"{samples}spp-0" / f"{frame:04d}.exr"
        if not path.exists():
            render(path, frame, samples, seed_of(of, f"sharp {samples}"))
            state_optics(path, describe_optics(of, record["motion_blur"], lens=lens))


def describe_optics(of: Clip, shutter: float | None, *, lens: bool) -> dict[str, Any]:
    """What the camera did at the scene's frame, by OpenEXR's standard names, in seconds, metres, mm and micrometres.

    Args:
      of: the clip.
      shutter: the part of a frame's time that the shutter was open; None: it was no matter.
      lens: whether there was depth of field.
    """
    scene, data = bpy.context.scene, bpy.context.scene.camera.data
    told: dict[str, Any] = {}
    if shutter is not None:
        told |= {"framesPerSecond": Fraction(scene.render.fps), "expTime": float(shutter / scene.render.fps)}
    if lens:
        told |= {
            "aperture": float(data.dof.aperture_fstop),
            "focus": float(data.dof.focus_distance),
            "nominalFocalLength": float(data.lens),
            "sensorPhotositePitch": float(1000 * data.sensor_width / of.size[0]),
        }
    return told


def state_optics(path: Path, attributes: dict[str, Any]) -> None:
    """Add attributes to the first part of a file."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        parts = [OpenEXR.Part(dict(part.header), dict(part.channels)) for part in file.parts]
        parts[0].header.update(attributes)
        part_file = path.with_name(f".{path.name}.part")
        OpenEXR.File(parts).write(str(part_file))
    part_file.replace(path)


def main(arguments: list[str] | None = None) -> int:
    """Render what is missing; returns the exit code, 2 for what the user can mend."""
    parser = argparse.ArgumentParser(prog="python -m experiments.cycles.sharp", description=__doc__)
    parser.add_argument("clip", type=Path, help="the clip's folder, with its cycles.json")
    parser.add_argument("out", type=Path, help="folder that gets a folder for each sample count")
    parser.add_argument("--spp", type=int, nargs="+", default=[4, 16], help="samples a pixel")
    given = parser.parse_args(arguments)
    try:
        for samples in given.spp:
            render_sharp(given.clip, given.out, samples)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # bpy sometimes crashes while the interpreter ends, when all files are written
