"""What other programs have of a file that jaxdn wrote: OpenEXR, OpenImageIO and Blender's compositor.

Runs inside of Blender (``bpy``). Each reader raises ValueError where a file is not as it has to be.
"""

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
import OpenEXR

Pixels = dict[tuple[str, str], np.ndarray]
"""(Part, channel) -> pixels."""


def read(path: Path) -> Pixels:
    """Every channel of every part."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {
            (str(part.header.get("name") or index), name): np.array(channel.pixels)
            for index, part in enumerate(file.parts)
            for name, channel in part.channels.items()
        }


def compare(noisy: Path, denoised: Path, light: Sequence[str], *, lossy: bool = False) -> dict[str, float]:
    """How many channels were changed and kept.

    The set of channels, their types and sizes, and the header of each part have to be those of the noisy file. Data
    passes have to be the same bits; ``light`` are words of layers that may change besides the beauty. Of ``lossy``
    files data passes are compressed once more: ``recompressed`` is the largest difference of one, by its largest value.
    """
    one, two = read(noisy), read(denoised)
    if one.keys() != two.keys():
        raise ValueError(f"{denoised}: expected the channels of {noisy}, differing {sorted(one.keys() ^ two.keys())}")
    if other := [key for key in one if one[key].dtype != two[key].dtype or one[key].shape != two[key].shape]:
        raise ValueError(f"{denoised}: expected types and sizes of {noisy}, others in {other}")
    if odd := sorted(_headers(noisy) ^ _headers(denoised)):
        raise ValueError(f"{denoised}: expected the attributes of {noisy}, others are {odd}")
    changed = [key for key in one if not np.array_equal(one[key], two[key], equal_nan=True)]
    wrong = [key for key in changed if not is_light(key[1], light)]
    if wrong and not lossy:
        raise ValueError(f"{denoised}: expected data passes as they were, changed {wrong}")
    found: dict[str, float] = {"changed": len(changed), "kept": len(one) - len(changed)}
    if lossy:
        pairs = [(one[key].astype(np.float64), two[key].astype(np.float64)) for key in wrong]
        found["recompressed"] = max((float(np.abs(x - y).max() / np.abs(x).max()) for x, y in pairs), default=0.0)
    return found


def _headers(path: Path) -> set[tuple[int, str, str]]:
    """(Part, attribute, value) of everything but the table of channels."""
    with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
        return {
            (index, name, str(value))
            for index, part in enumerate(file.parts)
            for name, value in part.header.items()
            if name not in ("channels", "chunkCount")
        }


def is_light(channel: str, light: Sequence[str] = ()) -> bool:
    """Whether a channel is one that jaxdn may change."""
    return any(name in channel for name in ("Combined", *light)) or channel in "RGBA"


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
    settings.exr_codec, settings.color_mode = "ZIP", "RGB"
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


def open_with_oiio(path: Path) -> float:
    """The largest difference between OpenImageIO's pixels and OpenEXR's, of all channels of all parts."""
    import OpenImageIO as oiio

    expected, found, part, largest = read(path), 0, 0, 0.0
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise ValueError(f"{path}: expected a file that OpenImageIO opens, it says {oiio.geterror()}")
    while source.seek_subimage(part, 0):
        spec, pixels = source.spec(), source.read_image(part, 0, 0, source.spec().nchannels, oiio.FLOAT)
        if pixels is None:
            raise ValueError(f"{path}: expected pixels that OpenImageIO decodes, it says {source.geterror()}")
        for index, name in enumerate(spec.channelnames):
            own = expected.get((spec.get_string_attribute("name") or str(part), name))
            if own is None or own.shape != pixels.shape[:2]:
                continue
            found += 1
            usable = np.isfinite(own)
            largest = max(largest, float(np.max(np.abs(pixels[..., index] - own)[usable], initial=0.0)))
        part += 1
    source.close()
    if found != len(expected):
        raise ValueError(f"{path}: expected {len(expected)} channels, OpenImageIO has {found} of them in that size")
    return largest
