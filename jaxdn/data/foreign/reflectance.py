"""What the surfaces in another renderer's frame reflect, from what its file brings of it.

A diffuse and a specular albedo are directional albedos already: their sum is the reflectance. A specular colour F0 is
not; with roughness and the cosine between normal and view it gives the directional albedo of a GGX lobe
(:func:`jaxdn.brdf.directional_albedo`). The cosine is known from normals and positions in camera space, or from both in
world space and the camera's place, which the file's header may have. Whatever lacks a part of this keeps its albedo
alone: nothing is guessed.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxdn.brdf import directional_albedo
from jaxdn.core.frame import BUFFERS, Frame
from jaxdn.data.foreign.layers import Channels, find_layer, group_layers, is_called, layer_of, stack_channels
from jaxdn.data.foreign.repairs import Repairs

_POINT = BUFFERS["normal"]
"""Positions have the components of a direction."""
CAMERA_NORMALS = ("denoising normal", "ncam", "normal_camera", "camera_normal")
"""Layers with normals in camera space; Cycles' denoising normals are."""
_CAMERA_POSITIONS = ("pcam", "position_camera", "camera_position")
_WORLD_POSITIONS = ("p", "position", "posw", "world_position")
_F0 = ("f0", "specular_f0")
"""Specular colours at normal incidence."""


def derive_reflectance(
    frame: Frame,
    buffers: Mapping[str, Channels],
    pixels: Mapping[str, np.ndarray],
    header: Mapping[str, Any],
    repairs: Repairs,
) -> tuple[Frame, str | None]:
    """The frame with ``reflectance`` and ``specular_reflectance`` where its file tells them, and how in a sentence.

    Args:
      frame: with the buffers that were found by name.
      buffers: buffer -> channels it was read from.
      pixels: every channel of the file.
      header: of the file.
      repairs: what is clamped is counted there.
    """
    if frame.albedo is None:
        return frame._replace(specular_reflectance=None), None
    albedo, diffuse = frame.albedo, layer_of(buffers["albedo"])
    if frame.specular_reflectance is not None:
        specular = frame.specular_reflectance
        how = f"{diffuse!r} + {layer_of(buffers['specular_reflectance'])!r}"
    else:
        color = find_layer(group_layers(list(pixels)), _F0, BUFFERS["specular_reflectance"])
        if color is None:
            return frame, None
        layer = layer_of(color)
        if frame.roughness is None:
            return frame, f"not used: {layer!r}, as what it reflects depends on the roughness, which is not there"
        cosine, where = _cosine(frame, buffers, pixels, header)
        if cosine is None:
            return frame, f"not used: {layer!r}, as what it reflects depends on the angle of view, and {where}"
        specular = _lobe(repairs.clamp("F0", layer, stack_channels(pixels, color)), np.asarray(frame.roughness), cosine)
        how = f"{diffuse!r} + GGX lobe of F0 {layer!r}, roughness {layer_of(buffers['roughness'])!r} and {where}"
    reflectance = np.clip(albedo + specular, 0.0, 1.0)
    return frame._replace(reflectance=reflectance, specular_reflectance=specular), f"derived: reflectance = {how}"


def _lobe(color: np.ndarray, roughness: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """The lobe's directional albedo [H, W, 3]; 0 where there is no lobe (F0 of 0) or no surface (no normal)."""
    given = (jnp.asarray(each) for each in (np.zeros_like(color), color, roughness, np.maximum(cosine, 0.0)))
    lobe = directional_albedo(*given)
    nothing = np.isnan(cosine) | np.all(color == 0, axis=-1, keepdims=True)
    return np.where(nothing, np.float32(0), np.asarray(lobe, np.float32))


def _cosine(
    frame: Frame,
    buffers: Mapping[str, Channels],
    pixels: Mapping[str, np.ndarray],
    header: Mapping[str, Any],
) -> tuple[np.ndarray | None, str]:
    """The cosine [H, W, 1] between normal and view, NaN where there is no normal; and from what, or why not."""
    groups = group_layers(list(pixels))
    normals, places = find_layer(groups, CAMERA_NORMALS, _POINT), find_layer(groups, _CAMERA_POSITIONS, _POINT)
    if normals and places:
        where = f"{layer_of(normals)!r} and {layer_of(places)!r} in camera space"
        return _between(stack_channels(pixels, normals), -stack_channels(pixels, places)), where
    places = find_layer(groups, _WORLD_POSITIONS, _POINT)
    world = frame.normal is not None and not _is_one_of(layer_of(buffers["normal"]), CAMERA_NORMALS)
    if not places or not world:
        return None, "there are no normals and positions of one space to find it"
    eye = _camera_place(header.get("worldToCamera"))
    if eye is None:
        return None, "the header has no worldToCamera with the place of the camera"
    where = f"{layer_of(buffers['normal'])!r} and {layer_of(places)!r} in world space"
    view = eye.astype(np.float32) - stack_channels(pixels, places)
    return _between(np.asarray(frame.normal), view), where


def _between(normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(normal, axis=-1, keepdims=True) * np.linalg.norm(view, axis=-1, keepdims=True)
    known = lengths > 0
    cosine = np.sum(normal * view, axis=-1, keepdims=True) / np.where(known, lengths, 1.0)
    return np.where(known, cosine, np.nan).astype(np.float32)


def _camera_place(matrix: Any) -> np.ndarray | None:
    """Where the camera is, from a header's ``worldToCamera``; None where that is missing or not usable.

    OpenEXR multiplies row vectors, so that the translation is the last row; some programs write the transpose.
    """
    if matrix is None or np.shape(matrix) != (4, 4) or not np.all(np.isfinite(rows := np.asarray(matrix, np.float64))):
        return None
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if not np.allclose(rows[:, 3], last):
        rows = rows.T
    if not np.allclose(rows[:, 3], last) or abs(np.linalg.det(rows)) < 1e-12:
        return None
    return (last @ np.linalg.inv(rows))[:3]


def _is_one_of(layer: str, names: Sequence[str]) -> bool:
    return any(is_called(layer, name) for name in names)
