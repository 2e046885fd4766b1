"""The reflectance of the surface in every pixel: the share F_b of uniform incident light that it reflects.

``F_b(w_o) = integral of f_r(w_i, w_o) cos(theta_i) dw_i`` is the mean of the weights f cos / pdf that ``bsdf.sample``
gives (Zhuang et al. 2021, eq. 7), so it agrees with the renderer, which samples the same BSDF. It is found in one of
three ways, depending on the material:

* diffuse: the albedo, which is its F_b;
* constant over the surface: a table over the cosine, computed once per material;
* any other (textures, bumps, blends by a texture): the mean of a few samples in every pixel, at the camera ray's hit.

The samples are fixed low-discrepancy points, the same in every pixel and frame: no noise and no flicker.

Transmitted light counts as reflected. Its radiance is scaled by 1 / eta^2 on the way in and back on the way out, which
is not a loss: without that factor clear glass has F_b = 1, so its radiance is not divided. For a mask, the light that
passes through counts as 1: ``opacity * F_b + 1 - opacity``.

The specular part of F_b is the mean of the same weights with those of diffuse lobes left out, as the path tracer tells
diffuse and specular samples apart (:mod:`jaxdn.render.tracing.lobes`).
"""

import functools
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.materials import is_lambertian
from jaxdn.render.scenes.plugins import list_children, list_materials

COSINES = 64
"""Entries of a material's table on each side of the surface, from grazing to head-on."""
TABLE_SAMPLES = 2048
"""Samples that an entry is the mean of."""
PIXEL_SAMPLES = 32
"""Samples per pixel of a material that varies over the surface."""
_KEPT = 1024
"""Tables kept, of 1.5 KiB each: an animated scene is rebuilt for every frame, with the same materials."""

_TABLED, _ALBEDO, _NEITHER, _AVERAGED = 0, -1, -2, -3
"""The ways. A material with a table is numbered from 0 upwards by it, one that is averaged from -3 downwards."""

# Classes whose value depends on nothing but the cosine where all of their parameters are constant.
_UNIFORM = frozenset(
    ("SmoothDiffuse", "SmoothConductor", "RoughConductor", "SmoothDielectric", "ThinDielectric", "RoughDielectric")
    + ("SmoothPlastic", "RoughPlastic", "Principled", "PrincipledThin", "BlendBSDF", "MaskBSDF", "TwoSidedBRDF", "Null")
)
_KNOWN = _UNIFORM | {"BumpMap", "NormalMap"}


class Reflectances:
    """The materials of one scene, each with the way its F_b is found."""

    def __init__(self, scene: Any) -> None:
        tables: list[np.ndarray] = []
        self._averaged: list[Any] = []
        self._numbers: dict[int, int] = {}
        # The wrappers are kept, so that Mitsuba returns the same ones again and their ids identify the materials.
        self._materials = list(list_materials(scene))
        for material in self._materials:
            number = _choose_way(material)
            if number == _TABLED:
                number = len(tables)
                tables.append(_make_table(material))
            elif number == _AVERAGED:
                number = _AVERAGED - len(self._averaged)
                self._averaged.append(material)
            self._numbers[id(material)] = number
        self._tables = np.stack(tables) if tables else np.ones((1, 2 * COSINES, 6), np.float32)

    def average_pixels(self, hit: Any, bsdf: Any, active: Any, albedo: Any) -> tuple[Any, Any]:
        """F_b of all hits at once and its specular part, for the vectorised variants.

        F_b is NaN where a material cannot be averaged.
        """
        numbers = {int(_number_bsdf(mi.BSDFPtr(one))[0]): self._numbers[id(one)] for one in self._materials}
        by_identity = np.full(max(numbers, default=0) + 1, _NEITHER, np.int32)
        by_identity[list(numbers)] = list(numbers.values())
        there = active & (_number_bsdf(bsdf) < dr.opaque(mi.UInt32, len(by_identity)))
        number = dr.select(there, dr.gather(mi.Int32, mi.Int32(by_identity), _number_bsdf(bsdf), there), _NEITHER)
        low, share = _locate_cosine(hit.wi.z, dr)
        tabled = there & (number >= 0)
        start = mi.UInt32(number) * (2 * COSINES) + mi.UInt32(low)
        found, specular = (self._look_up(part, start, share, tabled) for part in (slice(3), slice(3, 6)))
        found = dr.select(number == _ALBEDO, albedo, dr.select(tabled, found, dr.nan))
        # Called one by one: a call through the pointer would be compiled for every material of the scene.
        for place, material in enumerate(self._averaged):
            mine = there & (number == _AVERAGED - place)
            whole, part = _averages(hit, material, _make_points(PIXEL_SAMPLES), mine)
            found, specular = dr.select(mine, whole, found), dr.select(mine, part, specular)
        return found, specular

    def _look_up(self, part: slice, start: Any, share: Any, tabled: Any) -> Any:
        """Three of the tables' columns between two entries; 0 where there is no table."""
        stored = mi.Float(np.ascontiguousarray(self._tables[..., part]).ravel())
        ends = [dr.gather(mi.Color3f, stored, start + step, tabled) for step in (0, 1)]
        return dr.select(tabled, dr.lerp(ends[0], ends[1], share), 0.0)

    def average_one(self, hit: Any, bsdf: Any, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F_b [3] of one hit and its specular part [3], for the variant without vectorisation."""
        number = self._numbers.get(id(bsdf), _NEITHER)
        if number == _ALBEDO:
            return albedo, np.zeros(3)
        if number == _NEITHER:
            return np.full(3, np.nan), np.zeros(3)
        if number <= _AVERAGED:
            found = _average(hit, bsdf, _compute_points(PIXEL_SAMPLES))
        else:
            low, share = _locate_cosine(hit.wi[2], np)
            ends = self._tables[number, int(low) : int(low) + 2]
            found = np.asarray((1 - share) * ends[0] + share * ends[1], np.float64)
        return found[:3], found[3:]


def _number_bsdf(bsdf: Any) -> Any:
    """The number that a vectorised variant assigns to a BSDF; 0 is none."""
    reinterpret: Any = dr.reinterpret_array
    return reinterpret(mi.UInt32, bsdf)


def _choose_way(bsdf: Any) -> int:
    """How the F_b of a material is found."""
    if is_lambertian(bsdf):
        return _ALBEDO
    parts = list(_walk_tree(bsdf))
    # An unknown class may not support sampling: it is tested, as an error in the tracer would end the whole frame.
    if any(part.class_name() not in _KNOWN for part in parts if isinstance(part, mi.BSDF)) and not _can_sample(bsdf):
        return _NEITHER
    uniform = all(
        part.class_name() in _UNIFORM if isinstance(part, mi.BSDF) else not part.is_spatially_varying()
        for part in parts
        if isinstance(part, mi.BSDF | mi.Texture)
    )
    return _TABLED if uniform and not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Anisotropic) else _AVERAGED


def _walk_tree(plugin: Any) -> Iterator[Any]:
    yield plugin
    for _, child in list_children(plugin):
        yield from _walk_tree(child)


def _can_sample(bsdf: Any) -> bool:
    """Whether a BSDF can be sampled at all."""
    try:
        weight = bsdf.sample(mi.BSDFContext(), _make_hit(0.6, 0.8), 0.5, mi.Point2f(0.4, 0.6), True)[1]
        return bool(np.all(np.isfinite(np.array(weight, np.float64))))
    except Exception:
        return False


def _make_hit(x: Any, z: Any) -> Any:
    """A flat surface, seen from the direction (x, 0, z) of its own frame."""
    hit = dr.zeros(mi.SurfaceInteraction3f, dr.width(z))
    hit.n = mi.Normal3f(0, 0, 1)
    hit.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    hit.dp_du, hit.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    hit.wi = mi.Vector3f(x, 0, z)
    return hit


def _locate_cosine(cosine: Any, numbers: Any) -> tuple[Any, Any]:
    """The entry of a table below a cosine, and how far it is from there to the next.

    Entries lie at ``(i + 0.5) / COSINES`` on each side, the outside after the inside: a surface may have two.
    """
    outside = cosine >= 0
    select = dr.select if numbers is dr else np.where
    at = numbers.clip(abs(cosine) * COSINES - 0.5, 0.0, COSINES - 1.0)
    low = numbers.minimum(numbers.floor(at), COSINES - 2.0)
    return select(outside, low + COSINES, low), at - low


@functools.cache
def _compute_points(count: int) -> np.ndarray:
    """[count, 3] low-discrepancy points in (0, 1)^3 (Hammersley): lobe, and direction in it; count: a power of 2."""
    index = np.arange(count)

    def inverse(base: int) -> np.ndarray:
        value, scale, rest = np.zeros(count), 1.0 / base, index + 0
        while rest.any():
            value, rest, scale = value + scale * (rest % base), rest // base, scale / base
        return value

    even = 3.0 ** -np.ceil(np.log(count) / np.log(3.0))  # from the lower ends of equal intervals to their centres
    return np.stack([(index + 0.5) / count, inverse(2) + 0.5 / count, (inverse(3) + even / 2) % 1.0], axis=-1)


def _make_points(count: int) -> Any:
    return mi.Float(_compute_points(count).astype(np.float32).ravel())


@dr.syntax
def _averages(hit: Any, bsdf: Any, points: Any, active: Any) -> tuple[Any, Any]:
    """The mean weight of the samples at ``points``, and that of specular lobes, in every lane that is active."""
    context = mi.BSDFContext()
    # Opaque values are data, in which a loop is recorded once; literals would turn into data in a second recording.
    nothing, count = dr.opaque(mi.Float, 0), dr.opaque(mi.UInt32, PIXEL_SAMPLES)
    total = mi.Color3f(nothing, nothing, nothing)
    specular = mi.Color3f(nothing, nothing, nothing)
    index: Any = dr.opaque(mi.UInt32, 0)
    running: Any = mi.Bool(active)
    while running:
        lobe, x, y = (dr.gather(mi.Float, points, index * 3 + axis, running) for axis in range(3))
        sampled, weight = bsdf.sample(context, hit, lobe, mi.Point2f(x, y), running)
        light = mi.Color3f(weight * dr.square(sampled.eta))
        total += dr.select(running, light, 0.0)
        is_specular = running & ~mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Diffuse)
        specular += dr.select(is_specular, light, 0.0)
        index += 1
        running &= index < count
    return total / float(PIXEL_SAMPLES), specular / float(PIXEL_SAMPLES)


def _average(hit: Any, bsdf: Any, points: np.ndarray) -> np.ndarray:
    """The same of one hit as one array [6], for the variant without vectorisation."""
    # Numbers one by one: arrays of three take longer to make and to add than a sample takes.
    context, diffuse, total = mi.BSDFContext(), int(mi.BSDFFlags.Diffuse), [0.0] * 6
    for lobe, x, y in points.tolist():
        sampled, weight = bsdf.sample(context, hit, lobe, [x, y])
        if sampled.pdf > 0:
            square, specular = sampled.eta**2, not int(sampled.sampled_type) & diffuse
            for channel in range(3):
                light = weight[channel] * square
                total[channel] += light
                total[3 + channel] += light if specular else 0.0
    return np.array(total) / len(points)


_made: dict[str, np.ndarray] = {}


def _make_table(bsdf: Any) -> np.ndarray:
    """[2 * COSINES, 6] F_b of a material that is constant over the surface, from inside and from outside, and its
    specular part."""
    content = _describe_content(bsdf)
    if content not in _made:
        if len(_made) >= _KEPT:
            _made.clear()
        make = _make_table_one_by_one if str(mi.variant()).startswith("scalar") else _make_table_at_once
        centres = (np.arange(COSINES) + 0.5) / COSINES
        _made[content] = make(bsdf, np.concatenate([-centres, centres])).astype(np.float32)
    return _made[content]


def _describe_content(bsdf: Any) -> str:
    """All parameters of a material as text: equal for the same material in the next frame's scene."""
    parameters = mi.traverse(bsdf)
    exact = (np.asarray(parameters[name], np.float64).tobytes().hex() for name in parameters.keys())  # noqa: SIM118
    return "|".join([str(mi.variant()), str(bsdf), *exact])


def _make_table_at_once(bsdf: Any, cosines: np.ndarray) -> np.ndarray:
    lane = dr.arange(mi.UInt32, len(cosines) * TABLE_SAMPLES)
    count = dr.opaque(mi.UInt32, TABLE_SAMPLES)
    place = lane // count
    sample = (lane - place * count) * 3
    cosine = dr.gather(mi.Float, mi.Float(cosines.astype(np.float32)), place)
    points = _make_points(TABLE_SAMPLES)
    lobe, x, y = (dr.gather(mi.Float, points, sample + axis) for axis in range(3))
    hit = _make_hit(dr.safe_sqrt(1 - dr.square(cosine)), cosine)
    sampled, weight = bsdf.sample(mi.BSDFContext(), hit, lobe, mi.Point2f(x, y), True)
    # A weight that is the same for all lanes (thin glass) has only one value.
    weight = mi.Color3f(weight * dr.square(sampled.eta)) + mi.Color3f(dr.zeros(mi.Float, dr.width(lane)))
    specular = dr.select(mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Diffuse), mi.Color3f(0.0), weight)
    dr.eval(weight, specular)
    lights = [np.array(each, np.float64).T.reshape(len(cosines), TABLE_SAMPLES, 3) for each in (weight, specular)]
    return np.concatenate([each.mean(axis=1) for each in lights], axis=-1)


def _make_table_one_by_one(bsdf: Any, cosines: np.ndarray) -> np.ndarray:
    points = _compute_points(TABLE_SAMPLES // 8)  # a microsecond each
    return np.stack([_average(_make_hit((1 - c * c) ** 0.5, c), bsdf, points) for c in cosines.tolist()])
