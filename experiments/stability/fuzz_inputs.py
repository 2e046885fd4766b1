"""Valid files of every kind that is read, and broken versions of them; input n is the same in every run.

Half of the inputs are corrupted at random: bits flipped, bytes cut, doubled, or replaced by numbers that are often
handled wrongly. The other half stay well-formed, to get past the first check: JSON that parses, with an unexpected
value, name or nesting (for safetensors, in the JSON header), EXR with a wrong number in its header.
"""

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np

KINDS = ("exr", "foreign", "record", "animation", "weights", "description")
"""Frames of ours, frames of other renderers, clip.json, animation files, safetensors and their JSON."""
_WORDS = (b"-1", b"0", b"1e999", b"NaN", b"99999999999999999999", b"null", b'"x"', b"[]", b"{}", b"true", b"-0.0")
_INTEGERS = (0, 1, 2**31 - 1, 2**32 - 1, 2**24, 65536)
_DEEP = "<deep>"  # becomes brackets in brackets, which json.dumps could not write
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 2**31, 2**63, 10**400, -(10**400), 0.5, -0.0, 1e-320, 1e308),
    *(float("inf"), float("nan"), "", "x", "../../outside", "/outside", "\ud800", "\0", "1" * 300, _DEEP),
    *([], {}, [[]], [{}], {"x": []}, [0] * 3, [1] * 16, list(range(5000)), ["radiance"], ["depth", "depth"]),
)


def good_files(folder: Path) -> dict[str, list[bytes]]:
    """Valid files of each kind, also written where a reader expects them: ``clip/``, ``weights.safetensors`` ..."""
    import jax

    from jaxdn.clips import write_clip
    from jaxdn.core.frame import Clip, Frame
    from jaxdn.data.exr.exr import read_exr
    from jaxdn.denoisers import ntd
    from jaxdn.zoo.weights import save_weights

    rng = np.random.default_rng(0)
    light = rng.random((2, 6, 8, 3), np.float32)
    frames = Frame(light, albedo=light, depth=light[..., :1], motion=light[..., :2])
    record: dict[str, Any] = {"cameras": [{"x_fov": 60.0}] * 2, "plan": None}
    write_clip(Clip(frames, light), folder / "clip", record=record)
    plan = {"frames": [["albedo", "depth", "motion"]] * 2, "held": [0, 0], "effects": ["textures"]}
    planned = json.loads((folder / "clip" / "clip.json").read_bytes()) | {"plan": plan}
    tiny = {"size": [[1]] * 5}
    params = ntd(size=((1,),) * 5).init(jax.random.key(0), Frame(light[0]))
    save_weights(folder / "weights.safetensors", params, factory="ntd", options=tiny, record={})
    description = json.loads((folder / "weights.json").read_bytes())
    richer = description | {"options": tiny | {"motion": "dual", "preset": "paper", "demodulate": "none"}}
    ours = read_exr(folder / "clip" / "frame_0000.exr")
    files = {
        "exr": _exr_files(folder, ours),
        "foreign": _exr_files(folder, _foreign(light[0])),
        "record": [(folder / "clip" / "clip.json").read_bytes(), json.dumps(planned).encode()],
        "animation": [json.dumps(_ANIMATION).encode()],
        "weights": [(folder / "weights.safetensors").read_bytes()],
        "description": [(folder / "weights.json").read_bytes(), json.dumps(richer).encode()],
    }
    (folder / "foreign").mkdir()
    (folder / "foreign" / "shot_0001.exr").write_bytes(files["foreign"][0])
    (folder / "animation.json").write_bytes(files["animation"][0])
    return files


_ANIMATION = {
    "frames": 4,
    "camera": [
        {"frame": 0, "origin": [0, 1, 5], "target": [0, 1, 0], "fov": 40},
        {"frame": 3, "origin": [1, 1, 5], "target": [0, 1, 0], "fov": 40},
    ],
    "shapes": {"box": {"pivot": [0, 0, 0], "keys": [{"frame": 0, "angle": 10, "axis": [0, 1, 0]}]}},
    "inserted": [{"id": "ball", "type": "sphere", "size": 0.4, "color": [0.8, 0.2, 0.1], "roughness": 0.3}],
    "lights": {"lamp": [{"frame": 0, "scale": 1}]},
}


def _foreign(light: np.ndarray) -> dict[str, np.ndarray]:
    """The channels of a Blender view layer."""
    names = {"Combined": "RGBA", "Denoising Albedo": "RGB", "Normal": "XYZ", "Depth": "Z", "Vector": "XYZW"}
    return {
        f"ViewLayer.{layer}.{letter}": np.ascontiguousarray(light[..., index % 3])
        for layer, letters in names.items()
        for index, letter in enumerate(letters)
    }


def _exr_files(folder: Path, channels: dict[str, np.ndarray]) -> list[bytes]:
    """The same channels in each of OpenEXR's compressions, as scanlines, and as tiles."""
    import OpenEXR

    written = []
    names = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
    kinds = [(name, OpenEXR.scanlineimage) for name in names] + [("ZIP", OpenEXR.tiledimage)]
    for name, kind in kinds:
        header: dict[str, Any] = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": kind}
        if kind == OpenEXR.tiledimage:
            header["tiles"] = OpenEXR.TileDescription()
        file = folder / "made.exr"
        OpenEXR.File(header, {channel: pixels.copy() for channel, pixels in channels.items()}).write(str(file))
        written.append(file.read_bytes())
        file.unlink()
    return written


def broken(kind: str, good: list[bytes], number: int) -> bytes:
    """Input ``number`` of a kind: one of its valid files with one to eight faults."""
    draw = random.Random(f"{kind} {number}")
    data = draw.choice(good)
    if draw.random() < 0.5:
        return blindly(data, draw)
    if kind in ("exr", "foreign"):
        return _header(data, draw)
    if kind == "weights":
        length = int.from_bytes(data[:8], "little")
        head = _json(data[8 : 8 + length], draw)
        return len(head).to_bytes(8, "little") + head + data[8 + length :]
    return _json(data, draw)


def blindly(good: bytes, draw: random.Random) -> bytes:
    """Bits and bytes changed regardless of their meaning."""
    data = bytearray(good)
    for _ in range(draw.choice((1, 1, 1, 2, 3, 5, 8))):
        at, length = draw.randrange(len(data) + 1), draw.randint(1, 16)
        how = draw.randrange(6)
        if how == 0 and data:
            data[at % len(data)] ^= 1 << draw.randrange(8)
        elif how == 1:
            del data[at : at + length]
        elif how == 2:
            data[at:at] = data[at : at + length]
        elif how == 3:
            data[at : at + length] = draw.randbytes(length)
        elif how == 4:
            data[at : at + draw.randint(1, 4)] = draw.choice(_WORDS)
        elif draw.random() < 0.2:
            del data[at:]
        else:
            data[at : at + 4] = draw.choice(_INTEGERS).to_bytes(4, "little")
    return bytes(data)


def _header(good: bytes, draw: random.Random) -> bytes:
    """An EXR file with a wrong number or a wrong character in one of its header's attributes."""
    data = bytearray(good)
    attributes = ["dataWindow", "displayWindow", "channels", "compression", "lineOrder", "tiles", "type", "name"]
    at = data.find(draw.choice(attributes).encode() + b"\0")
    if at < 0 or draw.random() < 0.2:
        at = draw.randrange(8, len(data) // 2)
        data[at] = draw.randrange(256)
        return bytes(data)
    start = data.index(b"\0", data.index(b"\0", at) + 1) + 1  # after the names of attribute and type: size, then value
    size = int.from_bytes(data[start : start + 4], "little")
    place = start + 4 * draw.randint(0, max(1, min(size, 64) // 4))
    if draw.random() < 0.5:
        number = draw.choice((*_INTEGERS, draw.randrange(2**32), draw.randrange(99)))
        data[place : place + 4] = number.to_bytes(4, "little")
    else:
        data[start + draw.randrange(size + 4)] = draw.randrange(256)
    return bytes(data)


def _json(good: bytes, draw: random.Random) -> bytes:
    """JSON that parses, with unexpected contents in one to three places."""
    root = [json.loads(good)]
    for _ in range(draw.choice((1, 1, 2, 3))):
        places = _places(root)
        holder, key = draw.choice(places)
        how = draw.randrange(6)
        if how <= 2:
            holder[key] = copy.deepcopy(draw.choice(_VALUES))
        elif how == 3:
            other, name = draw.choice(places)
            holder[key] = copy.deepcopy(other[name])  # no container may contain itself
        elif how == 4 and isinstance(holder, dict):
            holder[draw.choice(("frame", "x", "", "../x", "keys", "size", "__metadata__"))] = holder.pop(key)
        elif holder is not root:
            del holder[key]
    deep = "[" * 20_000 + "]" * 20_000
    return json.dumps(root[0]).replace(json.dumps(_DEEP), deep).encode()


def _places(holder: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree of lists and dicts."""
    keys = list(holder) if isinstance(holder, dict) else range(len(holder)) if isinstance(holder, list) else ()
    return [place for key in keys for place in ((holder, key), *_places(holder[key]))]
