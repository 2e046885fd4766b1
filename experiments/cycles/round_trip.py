"""Files of each kind that Blender writes: rendered, denoised by jaxdn, and opened again by Blender and OpenImageIO.

    .venv-cycles/bin/python -m experiments.cycles.round_trip runs/round-trip --python .venv/bin/python

Of each kind, three frames of a cube, a ball and two lamps are rendered with Cycles. ``jaxdn denoise`` runs with the
Python that is given. Then the compositor of this Blender reads every result and writes what its image node gives; that
is compared with the file. OpenImageIO, as it comes with Blender, reads all pixels of all parts. A row a kind says what
was found, and the table is written as ``round-trip.json``.
"""

import argparse
import os
import runpy
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import OpenEXR

from jaxdn.runtime.atomic_files import write_json

ROOT = Path(__file__).parents[2]
KINDS = ("multilayer", "files", "stereo", "cryptomatte", "light groups", "panorama")
"""Multilayer files; a file for each pass; two views; with Cryptomatte; with light groups; equirectangular."""
FRAMES = 3
Pixels = dict[tuple[str, str], np.ndarray]
"""(Part, channel) -> pixels."""


def build_scene(kind: str, size: tuple[int, int], samples: int) -> None:
    """The moving cube and what the kind needs, with the passes of docs/how-to/blender_passes.py."""
    bpy.ops.wm.read_factory_settings(use_empty=False)
    scene = bpy.context.scene
    runpy.run_path(str(ROOT / "docs/how-to/blender_passes.py"))
    cube = bpy.data.objects["Cube"]
    cube.pass_index = 1
    for frame in (1, FRAMES):
        cube.location.x = 0.4 * frame
        cube.keyframe_insert("location", frame=frame)
    bpy.ops.mesh.primitive_uv_sphere_add(location=(-2, 1, 0))
    bpy.context.object.pass_index = 2
    bpy.ops.object.light_add(type="AREA", location=(3, -3, 4))
    bpy.context.object.data.energy = 300
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.cycles.device, scene.cycles.samples = "CPU", samples
    scene.frame_start, scene.frame_end = 1, FRAMES
    layer, camera = bpy.context.view_layer, scene.camera.data
    if kind == "stereo":
        scene.render.use_multiview, scene.render.views_format = True, "STEREO_3D"
        scene.render.image_settings.views_format = "MULTIVIEW"
    elif kind == "cryptomatte":
        layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = True
    elif kind == "light groups":
        for name, light in (("key", "Light"), ("fill", "Area")):
            layer.lightgroups.add(name=name)
            bpy.data.objects[light].lightgroup = name
        layer.lightgroups.add(name="world")
        scene.world.lightgroup = "world"
    elif kind == "panorama":
        camera.type, camera.panorama_type = "PANO", "EQUIRECTANGULAR"
        scene.camera.location = (0.5, -3.0, 0.8)  # among what there is to see
        bpy.ops.mesh.primitive_plane_add(size=20, location=(0, 0, -1))


def render(kind: str, folder: Path) -> None:
    """The frames of the scene into ``folder``; of *files*, a file for each pass by the compositor's File Output."""
    scene = bpy.context.scene
    folder.mkdir(parents=True, exist_ok=True)
    scene.render.filepath = str(folder.absolute() / "shot.####.exr")
    if kind == "files":
        scene.render.use_compositing = True
        scene.compositing_node_group = tree = bpy.data.node_groups.new("passes", "CompositorNodeTree")
        source = tree.nodes.new("CompositorNodeRLayers")
        for passed, name in (
            ("Image", "beauty"),
            ("Depth", "depth"),
            ("Denoising Albedo", "albedo"),
            ("Denoising Normal", "normal"),
        ):
            node = tree.nodes.new("CompositorNodeOutputFile")
            node.format.media_type = "IMAGE"
            node.format.file_format, node.format.color_depth = "OPEN_EXR", "32"
            node.directory, node.file_name = str(folder.absolute()), f"{name}."
            kinds = {"depth": "FLOAT", "normal": "VECTOR"}
            node.file_output_items.new(kinds.get(name, "RGBA"), "")
            tree.links.new(source.outputs[passed], node.inputs[0])
        scene.render.filepath = str(folder.absolute().parent / "unused" / "shot.####.exr")
    bpy.ops.render.render(animation=True)


def read(path: Path) -> Pixels:
    """Every channel of every part."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {
            (str(part.header.get("name") or index), name): np.array(channel.pixels)
            for index, part in enumerate(file.parts)
            for name, channel in part.channels.items()
        }


def is_light(channel: str) -> bool:
    """Whether a channel is one that jaxdn may change."""
    return any(name in channel for name in ("Combined", "Light", "key", "fill", "world")) or channel in "RGB"


def compare(noisy: Path, denoised: Path) -> dict[str, int]:
    """How many channels were changed and kept; raises ValueError for another set, or a data pass that was changed."""
    one, two = read(noisy), read(denoised)
    if one.keys() != two.keys():
        raise ValueError(f"{denoised}: expected the channels of {noisy}, differing {sorted(one.keys() ^ two.keys())}")
    changed = [key for key in one if not np.array_equal(one[key], two[key], equal_nan=True)]
    if wrong := [key for key in changed if not is_light(key[1])]:
        raise ValueError(f"{denoised}: expected data passes as they were, changed {wrong}")
    return {"changed": len(changed), "kept": len(one) - len(changed)}


def composite(path: Path, out: Path, matte: str = "") -> np.ndarray:
    """[H, W, 3] what Blender's compositor has of a file: its beauty, or the matte of an object."""
    scene = bpy.context.scene
    image = bpy.data.images.load(str(path.absolute()))
    image.colorspace_settings.name = "Linear Rec.709" if image.type != "MULTILAYER" else image.colorspace_settings.name
    scene.compositing_node_group = tree = bpy.data.node_groups.new("check", "CompositorNodeTree")
    tree.interface.new_socket(name="Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    if matte:
        node = tree.nodes.new("CompositorNodeCryptomatteV2")
        node.source, node.image, node.matte_id = "IMAGE", image, matte
        result = node.outputs["Matte"]
    else:
        node = tree.nodes.new("CompositorNodeImage")
        node.image = image
        result = node.outputs.get("Combined") or node.outputs["Image"]
    tree.links.new(result, tree.nodes.new("NodeGroupOutput").inputs[0])
    render, scene.cycles.samples = scene.render, 1
    render.use_compositing, render.use_multiview = True, False
    settings = render.image_settings
    settings.media_type, settings.file_format, settings.color_depth = "IMAGE", "OPEN_EXR", "32"
    settings.color_mode, render.use_file_extension = "RGB", False
    render.filepath = str(out.absolute())
    bpy.ops.render.render(write_still=True)
    bpy.data.images.remove(image)
    pixels = {name: values for (_, name), values in read(out).items()}
    return np.stack([pixels[letter] for letter in "RGB"], -1)


def beauty_of(path: Path) -> np.ndarray:
    """[H, W, 3] of the first view."""
    pixels = read(path)
    first = next((key for key in pixels if key[1].endswith("Combined.R")), None)
    if first is None:
        return np.stack([next(v for (_, name), v in pixels.items() if name == letter) for letter in "RGB"], -1)
    return np.stack([pixels[first[0], f"{first[1][:-1]}{letter}"] for letter in "RGB"], -1)


def open_with_oiio(path: Path) -> int:
    """The number of parts that OpenImageIO reads; raises ValueError unless all their pixels are those of the file."""
    import OpenImageIO as oiio

    expected, found, part = read(path), 0, 0
    source = oiio.ImageInput.open(str(path))
    while source.seek_subimage(part, 0):
        spec, pixels = source.spec(), source.read_image(part, 0, 0, source.spec().nchannels, oiio.FLOAT)
        for index, name in enumerate(spec.channelnames):
            own = expected.get((spec.get_string_attribute("name") or str(part), name))
            found += own is not None and np.array_equal(pixels[..., index], own.astype(np.float32), equal_nan=True)
        part += 1
    source.close()
    if found != len(expected):
        raise ValueError(f"{path}: expected {len(expected)} channels as written, OpenImageIO reads {found} of them")
    return part


def run_kind(kind: str, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """A row: sizes, times, and what each program found. Raises where anything is not as it has to be."""
    noisy, denoised = out / kind / "noisy", out / kind / "denoised"
    build_scene(kind, options.size, options.samples)
    render(kind, noisy)
    command = [options.python, "-m", "jaxdn", "denoise", str(noisy), "-o", str(denoised)]
    command += ["--method", options.method] if options.method else []
    command += ["--aovs", "additive"] if kind == "light groups" else []
    command += ["--wrap"] if kind == "panorama" else []  # Blender writes no envmap attribute
    start = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise ValueError(f"{kind}: jaxdn ended with {done.returncode}\n{(done.stdout + done.stderr)[-2000:]}")
    results = sorted(denoised.glob("*.exr"))
    row: dict[str, Any] = {"kind": kind, "frames": len(results), "seconds": round(seconds, 1)}
    row |= compare(noisy / results[-1].name, results[-1])
    sources = [noisy / path.name for path in results]
    row["bytes in"] = sum(path.stat().st_size for path in sources) // len(results)
    row["bytes out"] = sum(path.stat().st_size for path in results) // len(results)
    row["OpenImageIO, parts"] = [open_with_oiio(path) for path in results][-1]
    seen = composite(results[-1], out / kind / "seen.exr")
    wanted = beauty_of(results[-1])
    row["Blender, largest difference"] = float(np.abs(seen - wanted).max() / wanted.max())
    row["pixels changed"] = float(np.mean(wanted != beauty_of(sources[-1])))
    if kind == "cryptomatte":
        given, kept = (composite(path, out / kind / "matte.exr", "Cube") for path in (sources[-1], results[-1]))
        row["matte"] = float(kept.mean())
        if not (np.array_equal(given, kept) and 0.01 < row["matte"] < 0.9):
            raise ValueError(f"{kind}: expected the matte of the noisy file, got another one")
    if kind == "light groups":
        pixels = {name: values.astype(np.float64) for (_, name), values in read(results[-1]).items()}
        groups = ("key", "fill", "world")
        total = sum(next(v for name, v in pixels.items() if name.endswith(f"_{group}.G")) for group in groups)
        whole = next(v for name, v in pixels.items() if name.endswith("Combined.G"))
        row["sum minus beauty"] = float(np.sqrt(np.mean((total - whole) ** 2)) / whole.mean())
    return row


def main() -> int:
    """Print a row for each kind, and write the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.cycles.round_trip", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the frames and the table")
    parser.add_argument("--python", default="python", help="Python that has jaxdn")
    parser.add_argument("--method", default="", help="as of jaxdn denoise")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS, help="kinds of files")
    parser.add_argument("--size", type=int, nargs=2, default=(128, 96), help="width and height in pixels")
    parser.add_argument("--samples", type=int, default=4, help="a pixel")
    options = parser.parse_args()
    own = Path(bpy.utils.resource_path("LOCAL"))
    sys.path += [str(place) for place in own.glob("python/lib/python*/site-packages")]  # OpenImageIO's
    rows = []
    for kind in options.kinds:
        rows.append(run_kind(kind, options.out, options))
        print("RESULT", rows[-1], flush=True)
    write_json(options.out / "round-trip.json", rows)
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # bpy sometimes crashes while the interpreter ends, when all files are written
