"""Clips of Cycles as jaxdn's own, to train on:

    python -m experiments.cycles.training FOLDER/train -o data/cycles        # then: jaxdn train data/cycles ...

A frame is read as ``jaxdn denoise`` reads it. The images of 1, 4 and 16 samples become the layers of a clip with
filtered pixels: each with its own albedo and normals. Radiance is all light. Of the reference the first half is kept,
too, so that its noise is known. A clip that is there is left as it is; one that Cycles is still rendering is left out.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from experiments.cycles import reference as references
from experiments.cycles.compare import find_done
from experiments.cycles.record import RECORD, read_record
from jaxdn.clips import finish_record, frame_path, is_clip, open_frames, write_frame
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import AVERAGED, Frame, present

LAYERS = (1, 4, 16)
"""Samples a pixel of the images that become layers."""


@dataclass
class Options:
    """Convert clips of Cycles to clips to train on."""

    folder: Annotated[Path, tyro.conf.Positional]
    """A set: the folder of clips, such as FOLDER/train. The test set is refused."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder that gets a folder for each clip."""


def main(options: Options) -> int:
    """Convert what is not there yet. Raises ValueError for clips that are for tests alone."""
    clips = find_done(options.folder, [])
    for clip in clips:
        record = read_record(clip / RECORD) or {}
        if record["set"] == "test":
            raise ValueError(
                f"{clip}: expected clips to train on, got one of the test set: nothing is trained on those."
            )
        if not is_clip(options.out / clip.name):
            convert(clip, options.out / clip.name, record)
            print(options.out / clip.name, flush=True)
    return 0


def convert(clip: Path, out: Path, record: dict[str, Any]) -> None:
    """Write a clip; its record is written last."""
    halves = [references.read(clip / "reference" / f"{number:04d}.exr") for number in range(1, record["frames"] + 1)]
    layers = {samples: open_frames(clip / f"{samples}spp-0")[1] for samples in LAYERS}
    names: list[list[str]] = []
    out.mkdir(parents=True, exist_ok=True)
    for index, images in enumerate(zip(*layers.values(), strict=True)):
        frames = dict(zip(LAYERS, (stored.frame for stored in images), strict=True))
        write_frame(frame_path(out, index), frames[1], **_images(frames, halves[index]))
        names.append(list(present(frames[1])))
    height, width = halves[0].first.shape[:2]
    finish_record(
        {
            "name": clip.name,
            "frames": len(names),
            "width": width,
            "height": height,
            "layers": list(LAYERS),
            "reference_spp": 2 * min(held.samples for held in halves),
            "light": "reflected",
            "pixel_filter": record["pixel_filter"][0].lower().replace("_", "-"),
            # What Cycles does not write is an absent effect: the clip may be trained on beside those that have it.
            "plan": {"frames": names, "held": list(range(len(names))), "effects": []},
            "cycles": record,
        },
        out,
    )


def _images(frames: dict[int, Frame], held: references.Reference) -> dict[str, Any]:
    """The images of a frame, and the guides that belong to each, as :func:`jaxdn.clips.write_frame` takes them."""
    guides = {
        samples: {name: getattr(frame, name) for name in AVERAGED if name in present(frame)}
        for samples, frame in frames.items()
    }
    normal = held.guides[..., 3:6]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    clean = {"albedo": np.clip(held.guides[..., :3], 0, 1), "normal": normal / np.maximum(length, 1e-6)}
    return {
        "layers": {samples: frame.radiance for samples, frame in frames.items()},
        "layer_guides": guides,
        "reference": held.image.astype(np.float32),
        "reference_half": held.first.astype(np.float32),
        "reference_guides": {name: clean[name] for name in guides[1]},
    }


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
