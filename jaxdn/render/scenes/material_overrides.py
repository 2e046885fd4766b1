"""Material overrides: other colours and another roughness for a loaded scene, as an animation's "materials" say.

The loaded objects are edited and not the file, so that a texture changes like a constant colour.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from jaxdn.color import srgb_decode
from jaxdn.render.scenes.animation import make_rotation
from jaxdn.render.scenes.plugins import list_children, list_shape_groups

_COLORS = frozenset({"reflectance", "diffuse_reflectance", "specular_reflectance", "base_color"})
_GREY = np.full(3, 3**-0.5)


def override_materials(shapes: Iterable[Any], materials: Mapping[str, Mapping[str, Any]]) -> None:
    """Edit the materials of loaded shapes in place.

    A reflectance c becomes ``clip(tint * (g + s (R c - g)), 0, 1)``: R rotates by the ``hue`` about the axis of greys,
    g is the mean of R c's channels, s the ``saturation``. ``roughness`` r sets alpha = r^2 (a principled BSDF's
    roughness r). Textures of 8 bits change in linear light; a colour of one channel and bump maps stay as they are.
    Raises ValueError for a roughness of a material that has none to set.

    Args:
      shapes: such as :func:`list_shapes` gives. A BSDF that several of them share changes once; shapes that were
        loaded apart from each other have one each.
      materials: id of a BSDF, or of a shape whose BSDF has no id -> its changes, as in
        :mod:`jaxdn.render.scenes.animation`.
    """
    done: list[Any] = []
    for name, bsdf in _pair_with_names(shapes):
        if name in materials and not any(bsdf is other for other in done):
            done.append(bsdf)
            _change(bsdf, name, materials[name])


def list_shapes(scene: Any) -> list[Any]:
    """The shapes of a scene, those of shape groups included."""
    grouped = [part for group in list_shape_groups(scene) for _, part in list_children(group) if hasattr(part, "bsdf")]
    return [*scene.shapes(), *grouped]


def name_materials(scene: Any) -> list[tuple[str, Any]]:
    """Name and BSDF of every shape of a scene: the BSDF's id, else the shape's."""
    return _pair_with_names(list_shapes(scene))


def _pair_with_names(shapes: Iterable[Any]) -> list[tuple[str, Any]]:
    pairs = [(shape.id(), shape.bsdf()) for shape in shapes]
    return [(bsdf.id() or name, bsdf) for name, bsdf in pairs if bsdf is not None]


def can_override(bsdf: Any) -> tuple[bool, bool]:
    """Whether a BSDF has colours, and a roughness, that can be changed."""
    parameters = mi.traverse(bsdf)
    return any(_is_color(key, value) for key, value in parameters), bool(_find_rough_keys(parameters))


def _change(bsdf: Any, name: str, changes: Mapping[str, Any]) -> None:
    parameters = mi.traverse(bsdf)
    for key in list(parameters.keys()):
        value = parameters[key]
        if _is_color(key, value):
            colors = np.array(value)
            texture = key.endswith(".data")
            # A constant colour has its channels first, or is one vector; a texture has them last.
            changed = _recolor(colors if texture else colors.reshape(3, -1).T, changes)
            parameters[key] = type(value)(changed if texture else changed.reshape(3).tolist())
    if "roughness" in changes:
        rough = _find_rough_keys(parameters)
        if not rough:
            raise ValueError(
                f"animation materials {name!r} roughness: expected a material with a constant roughness, got "
                f"{bsdf.class_name()}; leave it out."
            )
        for key in rough:
            linear = float(changes["roughness"])
            kind = type(parameters[key])
            parameters[key] = kind(linear if key.rpartition("roughness")[1] else max(linear**2, 1e-3))
    parameters.update()


def _recolor(colors: np.ndarray, changes: Mapping[str, Any]) -> np.ndarray:
    """[..., 3] linear reflectances, or 8-bit sRGB codes, after a change; the same type."""
    codes = colors.dtype == np.uint8
    linear = _decode_levels(0.0)[colors] if codes else colors
    turned = linear @ make_rotation(_GREY, float(changes.get("hue", 0.0))).T
    grey = turned.mean(axis=-1, keepdims=True)
    mixed = grey + float(changes.get("saturation", 1.0)) * (turned - grey)
    changed = np.clip(np.array(changes.get("tint", (1.0, 1.0, 1.0))) * mixed, 0.0, 1.0)
    if codes:  # the nearest code: the number of half-way levels below
        return np.searchsorted(_decode_levels(0.5)[:-1], changed).astype(np.uint8)
    return changed.astype(colors.dtype)


def _decode_levels(offset: float) -> np.ndarray:
    """[256] linear light of the 8-bit sRGB codes 0 ... 255 plus an offset."""
    return np.asarray(srgb_decode(np.minimum(np.arange(256) + offset, 255) / np.float64(255)), np.float64)


def _is_color(key: str, value: Any) -> bool:
    """Whether a parameter is a reflectance of three channels: a constant, or a texture's data."""
    *path, last = key.split(".")
    if not _COLORS.intersection(path) or last not in ("value", "data"):
        return False
    shape = np.shape(value)
    return (shape[-1:] == (3,) and len(shape) == 3) if last == "data" else shape[:1] == (3,)


def _find_rough_keys(parameters: Any) -> list[str]:
    """The keys of constant alphas and roughnesses."""
    return [
        key
        for key in list(parameters.keys())
        if key.removesuffix(".value").rpartition(".")[2] in ("alpha", "alpha_u", "alpha_v", "roughness")
    ]
