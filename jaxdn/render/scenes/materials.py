"""Materials read from Mitsuba's BSDF objects, also nested ones: lobes, roughness, textures.

BSDF flags are not sufficient: ``principled`` always reports a diffuse and a glossy lobe, a roughness may be textured,
and a rough conductor of roughness 1 is no sharper than a diffuse surface. So the tree of objects is traversed and its
values are read.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.plugins import list_children


class Material(NamedTuple):
    """One BSDF with everything nested in it."""

    lobes: frozenset[str]
    """As in :class:`jaxdn.planning.scene_properties.Surface`."""
    textured: bool = False
    unsure: Mapping[str, str] = {}
    """Effect -> why it could not be decided."""


class ParameterRange(NamedTuple):
    """The values of a parameter over a surface."""

    low: float
    high: float
    varies: bool = False
    known: bool = True


NOTHING = Material(frozenset())


def is_lambertian(bsdf: Any) -> bool:
    """Whether a BSDF has no lobe but perfectly diffuse ones, so that it reflects just its albedo."""
    known = mi.BSDFFlags
    return bool(int(bsdf.flags()) & int(known.All) == int(known.DiffuseReflection))


def _numbers(value: Any) -> np.ndarray | None:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None
    return array if array.size else None


def range_of(texture: Any) -> ParameterRange:
    """The values of a texture or spectrum; unknown ones may have any value."""
    parameters = mi.traverse(texture)
    data = _numbers(parameters["data"]) if "data" in parameters else None
    if data is not None:
        varies = data.ndim > 2 and bool(np.any(np.ptp(data.reshape(-1, data.shape[-1]), axis=0) > 0))
        return ParameterRange(float(data.min()), float(data.max()), varies)
    parts = [range_of(child) for _, child in list_children(texture)]
    if parts:
        low, high = min(part.low for part in parts), max(part.high for part in parts)
        return ParameterRange(low, high, len({*parts}) > 1 or any(p.varies for p in parts), all(p.known for p in parts))
    value = _numbers(parameters["value"]) if "value" in parameters else None
    if value is not None:
        return ParameterRange(float(value.min()), float(value.max()))
    return ParameterRange(0.0, np.inf, varies=bool(texture.is_spatially_varying()), known=False)


def _parameter(bsdf: Any, name: str, default: float) -> ParameterRange:
    for label, child in list_children(bsdf):
        if label == name:
            return range_of(child)
    parameters = mi.traverse(bsdf)
    value = _numbers(parameters[name]) if name in parameters else None
    return ParameterRange(default, default) if value is None else ParameterRange(float(value.min()), float(value.max()))


def _join(parts: list[Material]) -> Material:
    lobes = frozenset().union(*(part.lobes for part in parts))
    unsure = {effect: reason for part in parts for effect, reason in part.unsure.items()}
    return Material(lobes, any(part.textured for part in parts), unsure)


def _nested(bsdf: Any) -> list[Material]:
    return [describe_material(child) for _, child in list_children(bsdf) if isinstance(child, mi.BSDF)]


def _diffuse(bsdf: Any, *names: str) -> Material:
    for name in names:
        if any(label == name for label, _ in list_children(bsdf)):
            color = _parameter(bsdf, name, 0.5)
            return Material(frozenset({"diffuse"}), color.varies) if color.high > 0 else NOTHING
    return Material(frozenset({"diffuse"}))


def _rough(bsdf: Any, *, squared: bool) -> Material:
    """The glossy lobe of a microfacet BSDF; none at roughness 1."""
    if squared:
        found = _parameter(bsdf, "roughness", 0.5)
        name = "roughness"
    else:
        ranges = [_parameter(bsdf, name, 0.1) for name in ("alpha", "alpha_u", "alpha_v") if _has(bsdf, name)]
        ranges = ranges or [ParameterRange(0.1, 0.1)]
        low, high = min(one.low for one in ranges), max(one.high for one in ranges)
        found = ParameterRange(low, high, any(one.varies for one in ranges), all(one.known for one in ranges))
        name = "alpha"
    if not found.known:
        reason = f"{bsdf.class_name()}: the values of its {name} texture cannot be read"
        return Material(frozenset({"glossy"}), unsure={"glossy": reason})
    return Material(frozenset({"glossy"})) if found.low < 1 else NOTHING


def _has(bsdf: Any, name: str) -> bool:
    return name in mi.traverse(bsdf) or any(label == name for label, _ in list_children(bsdf))


def _specular(bsdf: Any, lobe: str, name: str = "specular_reflectance") -> Material:
    return Material(frozenset({lobe})) if _parameter(bsdf, name, 1.0).high > 0 else NOTHING


def _glass(bsdf: Any) -> Material:
    through = _specular(bsdf, "transmission", "specular_transmittance")
    return _join([_specular(bsdf, "mirror"), through])


def _plastic(bsdf: Any) -> Material:
    return _join([_diffuse(bsdf, "diffuse_reflectance"), _specular(bsdf, "mirror")])


def _rough_plastic(bsdf: Any) -> Material:
    return _join([_diffuse(bsdf, "diffuse_reflectance"), _rough(bsdf, squared=False)])


def _rough_conductor(bsdf: Any) -> Material:
    rough = _rough(bsdf, squared=False)
    # At roughness 1 it still reflects, but no sharper than a diffuse surface.
    return rough if rough.lobes else Material(frozenset({"diffuse"}))


def _rough_glass(bsdf: Any) -> Material:
    return _join([_rough(bsdf, squared=False), Material(frozenset({"transmission"}))])


def _principled(bsdf: Any) -> Material:
    metallic, through = _parameter(bsdf, "metallic", 0.0), _parameter(bsdf, "spec_trans", 0.0)
    parts = [_rough(bsdf, squared=True)]
    if metallic.low < 1 and through.low < 1:
        parts.append(_diffuse(bsdf, "base_color"))
    elif not parts[0].lobes:
        parts.append(Material(frozenset({"diffuse"})))
    if through.high > 0 or _parameter(bsdf, "diff_trans", 0.0).high > 0:
        parts.append(Material(frozenset({"transmission"})))
    if _parameter(bsdf, "clearcoat", 0.0).high > 0:
        parts.append(Material(frozenset({"glossy"})))
    return _join(parts)


def _blend(bsdf: Any) -> Material:
    weight = _parameter(bsdf, "weight", 0.5)
    nested = _nested(bsdf)
    if len(nested) == 2 and weight.known:
        nested = [part for part, used in zip(nested, (weight.low < 1, weight.high > 0), strict=True) if used]
    return _join(nested)


def _mask(bsdf: Any) -> Material:
    opacity = _parameter(bsdf, "opacity", 0.5)
    parts = _nested(bsdf) if opacity.high > 0 else []
    return _join([*parts, Material(frozenset({"transmission"}))] if opacity.low < 1 else parts)


def _wrapper(bsdf: Any) -> Material:
    return _join(_nested(bsdf))


_CLASSES: dict[str, Callable[[Any], Material]] = {
    "SmoothDiffuse": lambda bsdf: _diffuse(bsdf, "reflectance"),
    "SmoothConductor": lambda bsdf: _specular(bsdf, "mirror"),
    "RoughConductor": _rough_conductor,
    "SmoothDielectric": _glass,
    "ThinDielectric": _glass,
    "RoughDielectric": _rough_glass,
    "SmoothPlastic": _plastic,
    "RoughPlastic": _rough_plastic,
    "Principled": _principled,
    "PrincipledThin": _principled,
    "BlendBSDF": _blend,
    "MaskBSDF": _mask,
    "TwoSidedBRDF": _wrapper,
    "BumpMap": _wrapper,
    "NormalMap": _wrapper,
    "Null": lambda bsdf: Material(frozenset({"transmission"})),
}


def describe_material(bsdf: Any) -> Material:
    """The material of a BSDF; an unknown class is classified by its flags and marked as uncertain."""
    kind = bsdf.class_name()
    if kind in _CLASSES:
        return _CLASSES[kind](bsdf)
    known: Any = mi.BSDFFlags
    flags = int(bsdf.flags())
    lobes = {
        "diffuse": flags & int(known.DiffuseReflection),
        "glossy": flags & (int(known.GlossyReflection) | int(known.GlossyTransmission)),
        "mirror": flags & (int(known.DeltaReflection) | int(known.Delta1DReflection)),
        "transmission": flags & int(known.Transmission),
    }
    present = frozenset(lobe for lobe, bits in lobes.items() if bits)
    reason = f"{kind}: classified only by its flags, as the class is unknown"
    return Material(present, textured=True, unsure=dict.fromkeys(sorted(present - {"diffuse"} | {"texture"}), reason))
