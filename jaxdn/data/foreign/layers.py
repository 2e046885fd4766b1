"""Which channels of another renderer's EXR file make up which buffer, by their names.

The names are those that Blender Cycles, pbrt, Arnold, V-Ray, RenderMan, Houdini, Mitsuba, Corona, LuxCore, Unreal,
Falcor, the tools of Open Image Denoise and the real-time denoisers (DLSS, FSR, MetalFX, NRD) use, a view layer's name
in front or not. Case, spaces, ``_`` and ``-`` make no difference. ``docs/how-to/denoise-sequence.md`` has what is read
of each program.
"""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from jaxdn.core.frame import BUFFERS, Buffer
from jaxdn.data.errors import ClipError

Channels = tuple[str, ...]
"""The full names of the channels that make up one buffer, in order."""
Groups = Mapping[str, Mapping[str, str]]
"""Layer -> component, lower case -> full name of the channel."""

NORMAL_ROUGHNESS = "normal_roughness"
"""Normals with the roughness as the fourth component (DLSS, NRD)."""

LAYERS: dict[str, tuple[str, ...]] = {
    "radiance": (
        "noisy image",
        "",
        "noisy_radiance",
        "noisy_beauty",
        "radiance_noisy",
        "beauty_noisy",
        "color_noisy",
        "beauty",
        "rgba",
        "combined",
        "color",
        "ci",
        "c",
        "rgb_color",
        "finalimage",
        "finalimagemovierenderqueue_beauty",
        "radiance",
        "noisy",
        "noisy_color",
        "scaling_input_color",  # Streamline's input; the output is the upscaled image
        "rgb",
        "image",
        "rgb_imagepipeline",
        "rgba_imagepipeline",
        "vrayrgb",
        "hdr",
        "main",
        "effectsresult",
    ),
    "albedo": (
        "albedo",
        "denoising albedo",
        "diffuse_albedo",
        "diffuse_albedo_noice",
        "diffusealbedo",
        "diff_albedo",
        "alb",
        "visiblediffuse",
        "diffusefilter",
        "vraydiffusefilter",
        "cshading_albedo",
        "diffcol",
        "diffuse color",
        "fused_albedo",
        "diffuse",  # V-Ray for Maya's filter, others' lighting: jaxdn.data.foreign.reflectance tells them apart
    ),
    "normal": (
        "denoising normal",
        "normal",
        "normals",
        "sh_normal",
        "n",
        "ns",
        "nrm",
        "n_noice",
        "visiblenormals",
        "optixnormals",
        "nn",
        "__nworld",
        "vraynormals",
        "hitn",
        "avg_shading_normal",
        "shading_normal",
        "world_normal",
        "cgeometry_normalsshading",
        NORMAL_ROUGHNESS,
        "normals_roughness",
    ),
    "depth": (
        "depth",
        "z",
        "zfiltered",
        "zdepth",
        "vrayzdepth",
        "pz",
        "hitpz",
        "denoising depth",
        "dd",
        "dd.y",
        "linear_depth",
        "view_z",
        "cgeometry_zdepth",
        "finalimagemovierenderqueue_worlddepth",
    ),
    "roughness": ("denoising roughness", "roughness", "specular_roughness"),
    "motion": (
        "vector",
        "motionvector",
        "motion",
        "mvec",
        "backward",
        "motionback",
        "motionvectors",
        "velocity",
        "vrayvelocity",
        "mv",
        "forward",
        "cgeometry_velocity",
    ),
    "ids": (
        "ids",
        "indexob",
        "object index",
        "shape_index",
        "object_id",
        "id",
        "cryptoobject00",
        "crypto_object00",
        "cryptoasset00",
        "crypto_asset00",
        "cryptomatte00",
        "vraycryptomatte00",
        "cryptomaterial00",
        "crypto_material00",
    ),
    "specular_reflectance": (
        "specular_albedo",
        "denoising specular albedo",
        "specularalbedo",
        "spec_albedo",
        "reflectionfilter",
        "vrayreflectionfilter",
    ),
    "specular_hit_distance": ("specular_hit_distance", "spec_hit_distance", "spec_hit_dist", "specular_hit_dist"),
}
"""The buffers that other renderers have a name for, with the names of their layers: lower case, the first that is
there is taken."""

_DIFFUSE_PARTNERS: dict[str, str] = {
    "specular_albedo": "diffuse_albedo",  # Arnold, whose "albedo" is the sum of all
    "denoising specular albedo": "denoising albedo",  # Blender 5.2; before, its albedo had rough reflections in it
    "specularalbedo": "diffusealbedo",  # Falcor, ray reconstruction
    "spec_albedo": "diff_albedo",
    "reflectionfilter": "diffusefilter",  # V-Ray
    "vrayreflectionfilter": "vraydiffusefilter",
}
"""Specular albedo -> the layer that is the diffuse rest. Any other albedo may have the specular part in it already."""

UNSURE_ALBEDO = "diffuse"
"""The layer that is an albedo in one program and a lighting pass in the others."""

NOT_WANTED = "none"
"""``channels={"roughness": "none"}`` leaves a buffer out."""


def detect_channels(
    names: Sequence[str], *, channels: Mapping[str, str] | None = None, layer: str | None = None
) -> dict[str, Channels]:
    """Which channels make up which buffer, by their names; buffers without channels are left out.

    A specular albedo is found only together with the diffuse albedo that belongs to it, which is then the albedo: any
    other albedo may be the sum of both. ``channels`` names the layer of a buffer outright, for example
    ``{"radiance": "ViewLayer.Combined"}``; ``"none"`` leaves the buffer out. ``layer`` is a view layer or part, such as
    ``"ViewLayer"``: what is not named outright is looked for in it alone. Raises ClipError if two layers fit a buffer
    equally well, if a named layer is not there, or if there is no radiance.
    """
    groups = group_layers(names)
    inside = groups if layer is None else _inside(groups, layer)
    stated = channels or {}
    unknown = set(stated) - set(LAYERS)
    if unknown:
        raise ClipError(f"channels: expected buffers among {', '.join(LAYERS)}, got {', '.join(sorted(unknown))}.")
    found = {}
    for buffer, layers in LAYERS.items():
        if stated.get(buffer) == NOT_WANTED and NOT_WANTED not in groups:
            continue
        fitting = (
            _named(groups, buffer, stated[buffer])
            if buffer in stated
            else find_layer(
                inside, layers, BUFFERS[buffer], f"{buffer}: ", f"; {advise_naming(buffer)}, or a view layer: --layer"
            )
        )
        if fitting:
            found[buffer] = fitting
    if "roughness" not in found and "roughness" not in stated and "normal" in found:
        found |= _packed_roughness(inside, found["normal"])
    if "radiance" not in found and "radiance" not in stated:
        found |= _grey(inside)
    if "radiance" not in found:
        raise ClipError(f"no radiance among the channels {', '.join(sorted(names))}; {advise_naming('radiance')}.")
    return _with_partner(inside, found, stated)


def _inside(groups: Groups, layer: str) -> Groups:
    """The layers of a view layer, and itself. Raises ClipError if there are none."""
    found = {name: group for name, group in groups.items() if name == layer or name.startswith(f"{layer}.")}
    if not found:
        heads = dict.fromkeys(name.partition(".")[0] for name, group in groups.items() if name and set(group) != {""})
        raise ClipError(f"layer: there is none called {layer!r}; there are {', '.join(map(repr, heads)) or 'none'}.")
    return found


def group_layers(names: Sequence[str]) -> Groups:
    """The channels of a file by their layers."""
    groups: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, component = name.rpartition(".")
        groups.setdefault(layer, {})[component.lower()] = name
        if not layer:
            groups.setdefault(name, {})[""] = name  # a channel that is a layer of its own, such as "Z"
    return groups


_AFFIXES = re.compile(r"(?:^|(?<=\.))(?:kBufferType|p?In(?=[A-Z_])|in_)(?=[^.])|(?<=[^.])[\s_-]?[Tt]exture(?=\.|$)")
"""What interfaces put around the name of a buffer: Streamline's tags, arguments (``pInColor``), Metal's properties."""
_STREAMLINE_ALBEDO = re.compile(r"kBufferTypeAlbedo(?=\.|$)")
"""Beside a specular albedo it is the diffuse one."""


def plain(name: str) -> str:
    """A name in lower case, without what interfaces put around it and programs part its words by; dots stay."""
    inner = _AFFIXES.sub("", _STREAMLINE_ALBEDO.sub("diffuse_albedo", name))
    return re.sub(r"[\s_-]", "", inner.lower())


def is_called(layer: str, name: str) -> bool:
    """Whether a layer has a name, a view layer's or part's in front or not."""
    given, wanted = plain(layer), plain(name)
    return given == wanted or (wanted != "" and given.endswith("." + wanted))


def find_layer(
    groups: Groups, layers: Sequence[str], buffer: Buffer, what: str = "", hint: str = ""
) -> Channels | None:
    """The channels of the first of ``layers`` (lower case) that is there and has the components of ``buffer``.

    Raises ClipError, with ``what`` in front and ``hint`` at its end, if two layers fit equally well.
    """
    for wanted in layers:
        fitting = {}
        for layer, group in groups.items():
            if is_called(layer, wanted):
                channels = _fitting(group, buffer)
                if channels:
                    fitting[layer] = channels
        # Blender's compositor output stands next to the view layer that it was made from.
        rendered = {layer: channels for layer, channels in fitting.items() if not layer.startswith("Composite.")}
        fitting = rendered or fitting
        exact = {layer: channels for layer, channels in fitting.items() if plain(layer) == plain(wanted)}
        fitting = exact or fitting
        if len(set(fitting.values())) > 1:
            raise ClipError(f"{what}{' and '.join(map(repr, sorted(fitting)))} fit equally well{hint}.")
        if fitting:
            return next(iter(fitting.values()))
    return None


def stack_channels(pixels: Mapping[str, np.ndarray], channels: Channels) -> np.ndarray:
    """The channels [H, W] of a buffer as one image [H, W, C], in their precision."""
    return np.stack([pixels[channel] for channel in channels], axis=-1)


def layer_of(channels: Channels) -> str:
    """The layer that the channels of a buffer lie in; the channels themselves where they have none."""
    return channels[0].rpartition(".")[0] or ", ".join(dict.fromkeys(channels))


def advise_naming(buffer: str) -> str:
    """How to name the layer of a buffer."""
    return f"name its layer: channels={{{buffer!r}: LAYER}} (jaxdn denoise --channels {buffer}=LAYER)"


def last_name(channels: Channels) -> str:
    """The last part of the name of the layer that the channels of a buffer lie in, lower case."""
    return layer_of(channels).rpartition(".")[2].lower()


def is_cryptomatte(channels: Channels) -> bool:
    """Whether they lie in the first layer of a Cryptomatte, whose first two channels are an id's bits and its cover."""
    return re.fullmatch(r".*crypto.*00", last_name(channels)) is not None


def beauty_channels(names: Sequence[str], buffers: Mapping[str, Channels]) -> Channels:
    """The channels that a denoised image belongs in: those that the radiance was read from.

    If that was Blender's ``Noisy Image``, they are those of the ``Combined`` beside it, which Blender denoises into.
    """
    read = buffers["radiance"]
    head, _, last = layer_of(read).rpartition(".")
    if last.lower() == "noisy image":
        combined = _fitting(
            group_layers(names).get(f"{head}.Combined" if head else "Combined", {}), BUFFERS["radiance"]
        )
        return combined or read
    return read


def find_alpha(names: Sequence[str], beauty: Channels) -> str | None:
    """The alpha beside a beauty, or that of the file's own image; None if there is none."""
    groups = group_layers(names)
    beside = groups[layer_of(beauty) if "." in beauty[0] else ""]
    return beside.get("a") or groups.get("", {}).get("a")


def unpaired_specular(names: Sequence[str], found: Mapping[str, Channels]) -> str | None:
    """The layer of a specular albedo that was left out, as no diffuse albedo belongs to it; None if there is none."""
    if "specular_reflectance" in found:
        return None
    there = find_layer(group_layers(names), LAYERS["specular_reflectance"], BUFFERS["specular_reflectance"])
    return None if there is None else layer_of(there)


def _with_partner(groups: Groups, found: dict[str, Channels], stated: Mapping[str, str]) -> dict[str, Channels]:
    """Albedo and specular albedo of one program, or no specular albedo; what was named outright stays."""
    if "specular_reflectance" not in found or "specular_reflectance" in stated:
        return found
    specular = plain(layer_of(found["specular_reflectance"]))
    name = next(name for name in _DIFFUSE_PARTNERS if is_called(specular, name))
    wanted = specular.removesuffix(plain(name)) + _DIFFUSE_PARTNERS[name]
    partner = find_layer(groups, (wanted,), BUFFERS["albedo"])
    if partner is not None and ("albedo" not in stated or found.get("albedo") == partner):
        return {**found, "albedo": partner}
    return {buffer: channels for buffer, channels in found.items() if buffer != "specular_reflectance"}


def _grey(groups: Groups) -> dict[str, Channels]:
    """The radiance of a picture without colours, whose one channel is called ``Y``."""
    luminance = groups.get("", {}).get("y")
    return {} if luminance is None else {"radiance": (luminance,) * 3}


def _packed_roughness(groups: Groups, normal: Channels) -> dict[str, Channels]:
    """The roughness in the fourth component of normals whose name says so."""
    layer = layer_of(normal)
    fourth = groups.get(layer, {}).get("a") or groups.get(layer, {}).get("w")
    if fourth is None or not plain(layer).endswith("roughness"):
        return {}
    return {"roughness": (fourth,)}


_XYZ = ("x", "y", "z")


def _components(buffer: Buffer) -> tuple[Channels, ...]:
    """What the channels of such a buffer may be called within their layer, lower case; the first that fits is taken."""
    color = (("r", "g", "b"), ("red", "green", "blue"))
    if buffer.channels == 3:
        return (_XYZ, *color) if buffer.kind == "direction" else color
    if buffer.channels == 2:
        return (("x", "y"), ("r", "g"), ("u", "v"))
    if buffer.kind == "distance":
        return (("z",), ("v",), ("y",), ("",), ("t",), ("r",))
    return (("z",), ("y",), ("v",), ("x",), ("r",), ("i",), ("",))


def _fitting(group: Mapping[str, str], buffer: Buffer) -> Channels | None:
    for wanted in _components(buffer):
        if all(component in group for component in wanted):
            return tuple(group[component] for component in wanted)
    return None


def _is_letter(name: str, group: Mapping[str, str]) -> bool:
    """Whether a channel without a layer is a letter of the image itself; ``Z`` is a depth, which can be named."""
    return set(group) == {""} and len(name) == 1 and name.lower() != "z"


def _named(groups: Groups, buffer: str, layer: str) -> Channels:
    """The channels of a layer that was named outright: a colour may be called X, Y, Z, too."""
    group = groups.get(layer, {})
    channels = _fitting(group, BUFFERS[buffer])
    if channels is None and BUFFERS[buffer].channels == 3 and group.keys() >= set(_XYZ):
        channels = tuple(group[component] for component in _XYZ)
    if channels is None:
        there = [name for name, group in sorted(groups.items()) if name and not _is_letter(name, group)]
        raise ClipError(f"channels: no {buffer} in layer {layer!r}; there are {', '.join(map(repr, there)) or 'none'}.")
    return channels
