"""The map of the package: each folder or public module of ``jaxdn`` with its floor and what belongs in it.

Imports point to lower floors only (``tests/test_house.py``). ``python -m tests.house`` writes the table of
CONTRIBUTING.md from this map.
"""

import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


class Room(NamedTuple):
    """A folder, or a module that stands for itself."""

    floor: int
    holds: str
    """What belongs there, for the table."""


ROOMS: dict[str, Room] = {
    "core": Room(0, "frames, options, checks, numerics, separable filters"),
    "runtime": Room(0, "atomic files, locks, scratch folders, kept programs, allocator, optional packages, Ctrl-C"),
    "data": Room(0, "nothing of its own: the rooms below"),
    "data.errors": Room(0, "the error of all files"),
    "color": Room(1, "tone curves, luminance"),
    "ops.dispatch": Room(1, "implementations of an operation, and the choice among them"),
    "ops.onednn": Room(1, "bindings to oneDNN"),
    "data.exr": Room(1, "OpenEXR files"),
    "evaluation.report": Room(1, "the report's page"),
    "render.mitsuba": Room(1, "Mitsuba's variants and errors"),
    "losses": Room(2, "losses over clips"),
    "metrics": Room(2, "PSNR, SSIM, FLIP ..."),
    "materials": Room(2, "microfacets, glints, kernels of reflectance"),
    "ops": Room(2, "warp, motion, scales, planes, windows, medians, sampling"),
    "ops.affinity": Room(2, "affinity filters"),
    "ops.convolution": Room(2, "convolutions for training"),
    "ops.kernel_prediction": Room(2, "predicted kernels"),
    "brdf": Room(3, "reflectance, demodulation"),
    "denoiser": Room(3, "the interface, sanitising, frame statistics, rollout, tiles"),
    "recipes": Room(3, "recipes, objectives, augmentation"),
    "filters": Room(4, "shared parts of filters: reprojection, variance, A-trous ..."),
    "networks": Room(4, "U-Nets and their backends; the only place that imports Flax"),
    "planning": Room(4, "effects of a scene, and the rendering plan"),
    "data.clip": Room(4, "clips: folders of EXR frames and clip.json"),
    "methods": Room(5, "one file a method; the registry"),
    "export": Room(5, "StableHLO and ONNX"),
    "data.foreign": Room(5, "EXR sequences of other renderers"),
    "data.read": Room(6, "frames and clips from anywhere"),
    "data.training": Room(6, "caches, packs, batches"),
    "methods.combiner": Room(6, "combiner, with its parts"),
    "methods.steady": Room(6, "steady, with its parts"),
    "methods.two_lobes": Room(6, "relax, reblur, and their histories"),
    "denoisers": Room(7, "the methods as functions"),
    "clips": Room(7, "public face of data"),
    "data.evidence": Room(7, "effects that a clip shows"),
    "zoo": Room(7, "methods with their weights"),
    "render.scenes": Room(5, "scene files, animation, lights, materials, media"),
    "render.tracing": Room(6, "path tracers, seeds, lobes"),
    "render.buffers": Room(7, "G-buffers, motion vectors, reflectance"),
    "render.families": Room(6, "procedural scenes"),
    "render.camera_paths": Room(8, "randomised camera paths"),
    "render": Room(8, "frames, clips, the worker pool"),
    "effects": Room(9, "public face of planning"),
    "evaluation": Room(9, "denoisers compared on clips"),
    "evaluation.overlay": Room(9, "the validation page of a shot"),
    "training": Room(9, "the training loop"),
    "sequence": Room(10, "files in, files out"),
    "commands": Room(11, "the command line"),
    "__main__": Room(12, "`python -m jaxdn`"),
}

PACKAGES = {
    "flax": {"networks"},
    "numba": {"ops.dispatch"},
    "optax": {"training"},
    "mitsuba": {"render"},
    "drjit": {"render"},
    "OpenEXR": {"data.exr"},
    "grain": {"data.training"},
    "array_record": {"data.training"},
    "orbax": {"training"},
    "matplotlib": {"evaluation.report"},
    "PIL": {"evaluation.report"},
    "safetensors": {"zoo"},
    "tyro": {"commands"},
    "pyoidn": {"ops"},
    "distributed": {"commands"},
}
"""Which rooms (with the folders in them) import which package from outside."""


def table() -> str:
    """The map as a Markdown table, highest floor first."""
    lines = ["| floor | room | what belongs there |", "|---|---|---|"]
    for name, room in sorted(ROOMS.items(), key=lambda item: (-item[1].floor, item[0])):
        lines.append(f"| {room.floor} | `{name}` | {room.holds} |")
    return "\n".join(lines)


BEGIN, END = "<!-- floors -->", "<!-- /floors -->"


def with_table(text: str) -> str:
    """The text with the table between its two markers."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{table()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    page = ROOT / "CONTRIBUTING.md"
    page.write_text(with_table(page.read_text()))
    sys.exit(0)
