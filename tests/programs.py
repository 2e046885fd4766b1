"""EXR files as each program writes them: channel names, parts, precision, windows, tiles and metadata; one small scene.

The scene: a square slides over a wall with a texture; the camera is still. Its buffers are known exactly, and so is its
motion, in our conventions (:class:`Truth`). A :class:`Program` says how it is written and what must be read from it.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

HEIGHT, WIDTH = 24, 32
STEP = (3, -2)
"""The square moves by so many pixels a frame: x, y down."""
FULL = (0, 0, WIDTH - 1, HEIGHT - 1)
Channels = dict[str, np.ndarray]


class Truth(NamedTuple):
    """One frame, in our conventions; [H, W, C] float64."""

    light: np.ndarray
    diffuse: np.ndarray
    """A part of ``light``; the rest is specular."""
    alpha: np.ndarray
    albedo: np.ndarray
    specular_albedo: np.ndarray
    normal: np.ndarray
    depth: np.ndarray
    ids: np.ndarray
    """0 the wall, 1 the square."""
    motion: np.ndarray
    """Previous minus current, y down."""
    forward: np.ndarray
    """Next minus current, y down."""


def corner(frame: int) -> tuple[int, int]:
    """Column and row of the square's upper left pixel."""
    return 6 + STEP[0] * frame, 12 + STEP[1] * frame


def truth(frame: int, samples: int = 4) -> Truth:
    """The scene at a frame, its light with the noise of so many samples."""
    rng = np.random.default_rng(100 + frame)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    column, row = corner(frame)
    square = ((columns >= column) & (columns < column + 10) & (rows >= row) & (rows < row + 8))[..., None]
    texture = np.random.default_rng(0).uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))
    painted = np.random.default_rng(1).uniform(0.3, 0.9, (8, 10, 3))
    albedo = texture.copy()
    albedo[row : row + 8, column : column + 10] = painted
    normal = np.where(square, np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, 1.0]))
    noise = rng.gamma(samples, 1 / samples, (HEIGHT, WIDTH, 2, 1))
    shade = 0.35 + 0.3 * columns[..., None] / WIDTH
    diffuse, specular_albedo = (
        albedo * shade * noise[..., 0, :],
        np.broadcast_to(np.where(square, 0.1, 0.04), albedo.shape),
    )
    moved = np.where(square, np.array(STEP, np.float64), 0.0)
    return Truth(
        diffuse + specular_albedo * noise[..., 1, :], diffuse, np.where(rows > 0, 1.0, 0.5)[..., None], albedo,
        specular_albedo, normal, np.where(square, 4.0, 9.0), square.astype(np.int64), -moved, moved,
    )  # fmt: skip


def layer(name: str, image: np.ndarray, letters: str, dtype: type = np.float32) -> Channels:
    """``name.R`` ...; of an empty name, ``R`` ..."""
    image = np.broadcast_to(image, (*image.shape[:2], max(image.shape[2], len(letters))))
    return {f"{name}.{one}" if name else one: image[..., i].astype(dtype) for i, one in enumerate(letters)}


def cryptomatte(name: str, ids: np.ndarray, letters: str = "RGBA") -> Channels:
    """A Cryptomatte of one level: the preview, and id and coverage of the two objects that cover most of a pixel."""
    hashes = np.array([0x2F35A1C7, 0xBE0D44D2], np.uint32).view(np.float32)  # both are legal floats
    nothing = np.zeros_like(ids, np.float32)
    data = np.concatenate([hashes[ids], nothing + 1, nothing, nothing], axis=-1)
    return layer(name, nothing, letters[:3]) | layer(f"{name}00", data, letters)


def cryptomatte_header(name: str) -> dict[str, Any]:
    """The metadata that goes with it."""
    key = "cryptomatte/1a2b3c4/"
    return {
        f"{key}name": name,
        f"{key}hash": "MurmurHash3_32",
        f"{key}conversion": "uint32_to_float32",
        f"{key}manifest": '{"wall":"2f35a1c7","square":"be0d44d2"}',
    }


def box(window: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    return np.array(window[:2], np.int32), np.array(window[2:], np.int32)


def part(channels: Channels, window: tuple[int, int, int, int] = FULL, **header: Any) -> OpenEXR.Part:
    """Channels [H, W] of the picture, of which the data window is stored."""
    left, top, right, bottom = window
    stored = {
        name: np.ascontiguousarray(pixels[top : bottom + 1, left : right + 1]) for name, pixels in channels.items()
    }
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    return OpenEXR.Part({**about, "dataWindow": box(window), "displayWindow": box(FULL)}, stored)


def blender(path: Path, frame: int) -> None:
    """Multilayer EXR of Cycles with denoising data, one part, full float; the compositor's result beside it."""
    now = truth(frame)
    vector = np.concatenate([now.motion * [1, -1], -now.forward * [1, -1]], axis=-1)  # y up; the second pair reversed
    rgba = np.concatenate([now.light, now.alpha], axis=-1)
    view = "View Layer"
    channels = layer("Composite.Combined", rgba, "RGBA") | layer(f"{view}.Combined", rgba, "RGBA")
    channels |= layer(f"{view}.Noisy Image", rgba, "RGBA") | layer(f"{view}.Depth", now.depth, "Z")
    channels |= layer(f"{view}.Vector", vector, "XYZW") | layer(f"{view}.Normal", now.normal, "XYZ")
    channels |= layer(f"{view}.Denoising Normal", now.normal, "XYZ") | layer(f"{view}.DiffCol", now.albedo, "RGB")
    channels |= layer(f"{view}.Denoising Albedo", now.albedo, "RGB") | layer(f"{view}.DiffDir", now.diffuse, "RGB")
    channels |= layer(f"{view}.Denoising Depth", now.depth, "Z") | cryptomatte(f"{view}.CryptoObject", now.ids, "rgba")
    about = {"BlenderMultiChannel": "Blender V2.55.1 and newer", "Camera": "Camera", "Frame": f"{frame:03d}",
             "RenderTime": "00:01.20", "Scene": "Scene", "Software": "Blender 4.5.0"}  # fmt: skip
    OpenEXR.File([part(channels, **about, **cryptomatte_header(f"{view}.CryptoObject"))]).write(str(path))


def mitsuba(path: Path, frame: int) -> None:
    """hdrfilm of an aov integrator: the path tracer's image also under its own name; PIZ, float."""
    now = truth(frame)
    channels = layer("", now.light, "RGB") | layer("image", np.concatenate([now.light, now.alpha], -1), "RGBA")
    channels |= layer("albedo", now.albedo, "RGB") | layer("dd", now.depth, "T") | layer("nn", now.normal, "XYZ")
    about = {"generatedBy": "Mitsuba version 3.9.1", "compression": OpenEXR.PIZ_COMPRESSION}
    OpenEXR.File([part(channels, **about)]).write(str(path))


def pbrt(path: Path, frame: int) -> None:
    """pbrt-v4's GBufferFilm with a crop window: half, positions and variances beside the guides."""
    now, half = truth(frame), np.float16
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    place = np.stack([columns / WIDTH - 0.5, 0.5 - rows / HEIGHT, np.ones(rows.shape)], -1) * now.depth
    channels = layer("", now.light, "RGB", half) | layer("Albedo", now.albedo, "RGB", half)
    channels |= layer("P", place, "XYZ", half) | layer("u", columns[..., None] / WIDTH, "", half)
    channels |= {name: np.full((HEIGHT, WIDTH), 0.25, half) for name in ("u", "v", "dzdx", "dzdy")}
    channels |= layer("N", now.normal, "XYZ", half) | layer("Ns", now.normal, "XYZ", half)
    channels |= layer("Variance", 0.1 * now.light, "RGB", half) | layer(
        "RelativeVariance", 0.1 * now.light, "RGB", half
    )
    eye = np.eye(4, dtype=np.float32)
    about = {"renderTimeSeconds": 1.5, "samplesPerPixel": 4, "worldToCamera": eye, "worldToNDC": eye}
    OpenEXR.File([part(channels, (2, 1, WIDTH - 3, HEIGHT - 2), **about)]).write(str(path))


def arnold_window(frame: int) -> tuple[int, int, int, int]:
    """What autocrop leaves: another data window in each frame."""
    return 1, 2 + frame, WIDTH - 2, HEIGHT - 1 - frame


def arnold(path: Path, frame: int) -> None:
    """driver_exr: tiles of 64, autocrop, float; the motion vector is for 2-D motion blur (forwards, y up)."""
    now = truth(frame)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 64
    vector = np.concatenate([now.forward * [1, -1], 0 * now.depth], axis=-1)
    channels = layer("", np.concatenate([now.light, now.alpha], -1), "RGBA") | layer("N", now.normal, "XYZ")
    channels |= layer("albedo", now.albedo + now.specular_albedo, "RGB") | layer("diffuse_albedo", now.albedo, "RGB")
    channels |= layer("specular_albedo", now.specular_albedo, "RGB") | layer("", now.depth, "Z")
    channels |= layer("diffuse", now.diffuse, "RGB") | layer("specular", now.light - now.diffuse, "RGB")
    channels |= layer("motionvector", vector, "RGB") | cryptomatte("crypto_object", now.ids)
    about = {"arnold/version": "7.3.2.1", "arnold/renderpass": "beauty", "type": OpenEXR.tiledimage, "tiles": tiles}
    window = arnold_window(frame)
    OpenEXR.File([part(channels, window, **about, **cryptomatte_header("crypto_object"))]).write(str(path))


def renderman(path: Path, frame: int) -> None:
    """d_openexr of a denoisable beauty: half, lower-case components, light called ``diffuse`` and ``specular``."""
    now, half = truth(frame), np.float16
    still = 0 * now.depth
    channels = layer("Ci", now.light, "rgb", half) | {"a": now.alpha[..., 0].astype(half)}
    channels |= layer("albedo", now.albedo, "rgb", half) | layer("diffuse", now.diffuse, "rgb", half)
    channels |= layer("specular", now.light - now.diffuse, "rgb", half) | layer("Nn", now.normal, "xyz", half)
    channels |= {"zfiltered": now.depth[..., 0].astype(np.float32), "sampleCount": np.full((HEIGHT, WIDTH), 4, half)}
    channels |= layer("motionBack", np.concatenate([now.motion, still], -1), "xyz", half)
    channels |= layer("motionFore", np.concatenate([now.forward, still], -1), "xyz", half)
    about = {
        "Nl": np.eye(4, dtype=np.float32),
        "NP": np.eye(4, dtype=np.float32),
        "compression": OpenEXR.ZIPS_COMPRESSION,
    }
    OpenEXR.File([part(channels, **about)]).write(str(path))


def vray(path: Path, frame: int) -> None:
    """V-Ray for Maya: render elements in half, a render region as the data window; ``diffuse`` is its albedo."""
    now, half = truth(frame), np.float16
    channels = layer("", np.concatenate([now.light, now.alpha], -1), "RGBA", half) | layer(
        "diffuse", now.albedo, "RGB", half
    )
    channels |= layer("lighting", now.diffuse, "RGB", half) | layer("normals", now.normal, "XYZ", half)
    channels |= layer("zDepth", now.depth, "Z") | cryptomatte("cryptomatte", now.ids)
    channels |= layer("velocity", np.concatenate([now.forward * [1, -1], 0 * now.depth], -1), "XYZ", half)
    about = {"vrayInfo/vrayversion": "V-Ray 6.20", "vrayInfo/camera": "persp", "vrayInfo/frame": str(frame)}
    OpenEXR.File([part(channels, (4, 3, WIDTH - 1, HEIGHT - 1), **about)]).write(str(path))


def houdini(path: Path, frame: int) -> None:
    """husk with Karma: a part for each render variable, half for light and float for data."""
    now, half = truth(frame), np.float16
    vector = np.concatenate([now.forward * [1, -1], 0 * now.depth], axis=-1)
    parts = {
        "C": layer("", np.concatenate([now.light, now.alpha], -1), "RGBA", half),
        "albedo": layer("albedo", now.albedo, "rgb", half),
        "directdiffuse": layer("directdiffuse", now.diffuse, "rgb", half),
        "N": layer("N", now.normal, "xyz", half),
        "depth": layer("", now.depth, "Z"),
        "motionvector": layer("motionvector", vector, "xyz"),
        "CryptoObject": cryptomatte("CryptoObject", now.ids, "rgba"),
    }
    about = {"husk:render_stats": "{}", "compression": OpenEXR.ZIPS_COMPRESSION, **cryptomatte_header("CryptoObject")}
    OpenEXR.File([part(channels, name=name, **about) for name, channels in parts.items()]).write(str(path))


class Program(NamedTuple):
    """How a program writes a frame, and what must be read from it."""

    write: Callable[[Path, int], None]
    buffers: Mapping[str, str]
    """Buffer -> layer it must be read from."""
    beauty: tuple[str, ...]
    """The channels that the denoised light replaces."""
    motion_convention: str | None = None
    """What has to be stated; None: nothing."""
    window: Callable[[int], tuple[int, int, int, int]] = lambda frame: FULL


def _view(name: str) -> str:
    return f"View Layer.{name}"


PROGRAMS: dict[str, Program] = {
    "Blender": Program(
        blender,
        {
            "radiance": _view("Noisy Image"), "albedo": _view("Denoising Albedo"), "normal": _view("Denoising Normal"),
            "depth": _view("Depth"), "motion": _view("Vector"), "dual_motion": _view("Vector"),
            "ids": _view("CryptoObject00"),
        },
        tuple(_view(f"Combined.{letter}") for letter in "RGB"),
    ),
    "Mitsuba": Program(
        mitsuba, {"radiance": "R, G, B", "albedo": "albedo", "normal": "nn", "depth": "dd"}, ("R", "G", "B")
    ),
    "pbrt-v4": Program(
        pbrt, {"radiance": "R, G, B", "albedo": "Albedo", "normal": "N"}, ("R", "G", "B"),
        window=lambda frame: (2, 1, WIDTH - 3, HEIGHT - 2),
    ),
    "Arnold": Program(
        arnold,
        {
            "radiance": "R, G, B", "albedo": "diffuse_albedo", "specular_reflectance": "specular_albedo", "normal": "N",
            "depth": "Z", "motion": "motionvector", "ids": "crypto_object00",
        },
        ("R", "G", "B"), "forward-up", arnold_window,
    ),
    "RenderMan": Program(
        renderman, {"radiance": "Ci", "albedo": "albedo", "normal": "Nn", "depth": "zfiltered", "motion": "motionBack"},
        ("Ci.r", "Ci.g", "Ci.b"), "previous-current",
    ),
    "V-Ray": Program(
        vray,
        {"radiance": "R, G, B", "albedo": "diffuse", "normal": "normals", "depth": "zDepth", "motion": "velocity",
         "ids": "cryptomatte00"},
        ("R", "G", "B"), "forward-up", lambda frame: (4, 3, WIDTH - 1, HEIGHT - 1),
    ),
    "Houdini": Program(
        houdini,
        {"radiance": "C", "albedo": "albedo", "normal": "N", "depth": "depth", "motion": "motionvector",
         "ids": "CryptoObject.CryptoObject00"},
        ("C.R", "C.G", "C.B"), "forward-up",
    ),
}  # fmt: skip


def write_shot(name: str, folder: Path, frames: int = 3, first: int = 1) -> Path:
    """A sequence of a program in a folder; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(frames):
        PROGRAMS[name].write(folder / f"shot.{first + frame:04d}.exr", frame)
    return folder
