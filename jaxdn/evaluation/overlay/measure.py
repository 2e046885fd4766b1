"""What one frame and the one before it tell: maps to look at, and figures to judge by."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.evaluation.overlay.camera import CameraMatrices, camera_motion, read_camera
from jaxdn.evaluation.overlay.evidence import (
    box_mean,
    fireflies,
    lit_level,
    luminance,
    noise_map,
    normal_figures,
    orientation_figures,
    relative_noise,
    second_difference,
)
from jaxdn.evaluation.overlay.geometry import Space, compare_normals, occlusion_order
from jaxdn.filters.motion_search import MeasuredMotion, measure_motion, measure_nearness, reduce_size
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import guides_of, surface_mask
from jaxdn.ops.motion import occlusion_mask, on_screen
from jaxdn.ops.warp import warp

MOVES = 0.5
"""Pixels; shorter vectors do not tell one meaning from another."""
FEWEST = 64
"""Pixels that a figure is measured on; of fewer it is left out."""
TURNED = {
    "as given": (1.0, 1.0),
    "turned around": (-1.0, -1.0),
    "with y turned": (1.0, -1.0),
    "with x turned": (-1.0, 1.0),
    "left out": (0.0, 0.0),
}
"""What the given vectors are tried as, and the factors of x and y."""
DISAGREES = (1.0, 0.2)
"""Given and measured motion differ by more than so many pixels and this share of the measured one."""
MANY_REJECTED = 0.3
"""Share of the pixels from which on it is asked which guide rejects them."""

_warp = jax.jit(warp)
_reproject = jax.jit(partial(reproject, implementation="reference"))  # compiled in half the time of the other


class FrameOverlay(NamedTuple):
    """One frame's maps and figures."""

    name: str
    layers: dict[str, np.ndarray]
    """Name -> [H, W, C]."""
    figures: dict[str, float]
    """What cannot be measured is left out."""


class Measurer:
    """Consecutive frames, one after the other."""

    def __init__(self) -> None:
        self._before: Frame | None = None
        self._camera: CameraMatrices | None = None
        self._history: jax.Array | None = None

    def restart(self) -> None:
        """The next frame has no frame before it."""
        self._before = self._camera = self._history = None

    def add(
        self,
        name: str,
        frame: Frame,
        *,
        header: Mapping[str, Any] | None = None,
        stored: Mapping[str, np.ndarray] | None = None,
        space: Space = "world",
    ) -> FrameOverlay:
        """Measure the next frame.

        Args:
          name: of its file.
          frame: its buffers, as NumPy arrays.
          header: the attributes of its file.
          stored: albedo and depth as they are in the file, before they are clamped.
          space: what the normals are taken for.
        """
        layers, figures = _look_at_one(frame, stored or {})
        figures.update(_look_at_geometry(frame, space))
        camera = read_camera(header or {})
        before = self._before
        history = jnp.ones((*frame.radiance.shape[:2], 1), jnp.float32)
        if before is not None and before.radiance.shape == frame.radiance.shape:
            assert self._history is not None
            history = self._add_history(before, frame, layers, figures)
            moved = None
            if camera is not None and self._camera is not None and frame.depth is not None:
                moved = camera_motion(np.asarray(frame.depth), camera, self._camera)
            _compare_motion(before, frame, moved, layers, figures)
            _compare_noise(before, frame, figures)
        layers["history"] = np.asarray(history)
        figures["history"] = float(np.mean(history))
        self._before, self._camera, self._history = frame, camera, history
        return FrameOverlay(name, layers, figures)

    def _add_history(
        self, before: Frame, frame: Frame, layers: dict[str, np.ndarray], figures: dict[str, float]
    ) -> jax.Array:
        """[H, W, 1] how many frames each pixel has behind it; where it was hidden, outside or rejected."""
        assert self._history is not None
        found = _reproject(self._history, guides_of(before), _tested(frame), jnp.asarray(False))
        valid = np.asarray(found.valid)
        inside = np.ones_like(valid) if frame.motion is None else np.asarray(on_screen(jnp.asarray(frame.motion)))
        layers["outside"] = ~inside
        layers["rejected"] = inside & ~valid
        figures["rejected"] = float(np.mean(layers["rejected"]))
        if frame.dual_motion is not None and frame.motion is not None:
            layers["disoccluded"] = np.asarray(occlusion_mask(frame.motion, frame.dual_motion)) > 0
        elif frame.visible is not None:
            layers["disoccluded"] = ~np.asarray(frame.visible, bool)
        if figures["rejected"] > MANY_REJECTED:
            for guide in ("depth", "normal", "ids"):
                if getattr(frame, guide) is None:
                    continue
                others = {other: None for other in ("depth", "normal", "ids") if other != guide}
                alone = _tested(frame)._replace(**others)
                kept = guides_of(before)._replace(**others)
                passed = np.asarray(_reproject(self._history, kept, alone, jnp.asarray(False)).valid)
                figures[f"rejected by {guide}"] = float(np.mean(inside & ~passed))
        return jnp.where(found.valid, found.history + 1, 1.0)


def _tested(frame: Frame) -> Frame:
    """What the surface test reads."""
    return Frame(
        frame.radiance,
        normal=frame.normal,
        depth=frame.depth,
        motion=frame.motion,
        previous_depth=frame.previous_depth,
        ids=frame.ids,
    )


def _look_at_geometry(frame: Frame, space: Space) -> dict[str, float]:
    """How well normals agree with depth."""
    if frame.normal is None or frame.depth is None:
        return {}
    ids = None if frame.ids is None else np.asarray(frame.ids)[..., 0]
    normal, depth = np.nan_to_num(np.asarray(frame.normal)), np.asarray(frame.depth)[..., 0]
    found = compare_normals(normal, depth, ids, space=space)
    if found is None:
        return {}
    return {f"normals agree {name}": share for name, share in found.agree.items()} | {
        "normals agreeing": found.agreeing,
        "normals away": found.away,
    }


def _look_at_one(frame: Frame, stored: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """The maps and figures that need no other frame."""
    light = np.nan_to_num(np.asarray(frame.radiance, np.float64), posinf=0.0, neginf=0.0)
    noise, bright = relative_noise(light), fireflies(light)
    layers: dict[str, np.ndarray] = {"noise": noise[..., None], "fireflies": bright[..., None]}
    lit = luminance(light) > 0
    figures = {
        "invalid": float(np.mean(~np.isfinite(frame.radiance).all(axis=-1))),
        "fireflies": float(bright.mean()),
        "light": float(np.mean(np.minimum(luminance(light), 10 * lit_level(light)))),
    }
    if lit.any():
        surface = surface_mask(frame.depth, frame.ids)
        shaded = lit if surface is None else lit & np.asarray(surface)  # a sky has no noise, however few the samples
        figures["noise"] = float(np.median(noise[shaded if shaded.any() else lit]))
    for guide in ("albedo", "normal"):
        if (buffer := getattr(frame, guide)) is not None:
            layers[f"{guide}_noise"] = noise_map(np.nan_to_num(buffer))[..., None]
            figures[f"{guide} noise"] = float(np.median(layers[f"{guide}_noise"]))
    for guide in ("albedo", "normal", "depth"):
        if (buffer := getattr(frame, guide)) is not None:
            values = np.log(np.asarray(buffer, np.float64) + 1e-6) if guide == "depth" else np.asarray(buffer)
            found = orientation_figures(values, light)
            figures.update({f"{guide} {name}": value for name, value in found.items()})
    if frame.normal is not None:
        figures.update(normal_figures(np.nan_to_num(frame.normal)))
    if "albedo" in stored:
        albedo = np.nan_to_num(stored["albedo"])
        figures["negative albedo"] = float(np.mean(albedo.min(axis=-1) < -0.02))
        figures["albedo of normals"] = normal_figures(albedo).get("encoded normals", 0.0)
    if "depth" in stored:
        low, high = float(np.nanmin(stored["depth"])), float(np.nanmax(stored["depth"]))
        figures["normalised depth"] = float(0 <= low < high == 1)
    return layers, figures


def features(frame: Frame) -> np.ndarray:
    """[H, W, C] of about 0 to 1, what shows where surfaces are with the least noise: guides, else smoothed light."""
    parts = []
    if frame.albedo is not None:
        parts.append(np.asarray(frame.albedo))
    if frame.normal is not None:
        parts.append(0.5 * np.asarray(frame.normal))
    if not parts:
        light = np.maximum(np.nan_to_num(frame.radiance), 0.0)
        level = lit_level(light) or 1.0
        parts.append(box_mean(light / (light + level), 1))
    return np.clip(np.nan_to_num(np.concatenate(parts, axis=-1)), -2, 2).astype(np.float32)


def _measure_motion(first: np.ndarray, second: np.ndarray, frame: Frame) -> MeasuredMotion:
    """The motion between two frames' features, as NumPy arrays; depth tells what a camera moves."""
    nearness = None if frame.depth is None else measure_nearness(jnp.asarray(frame.depth)[..., 0])
    found = measure_motion(
        reduce_size(jnp.asarray(first)), reduce_size(jnp.asarray(second)), nearness, size=second.shape[:2]
    )
    return MeasuredMotion(*map(np.asarray, found))


def _compare_motion(
    before: Frame, frame: Frame, moved: np.ndarray | None, layers: dict[str, np.ndarray], figures: dict[str, float]
) -> None:
    """Given vectors against measured ones, against themselves turned around, and against those of the camera."""
    first, second = features(before), features(frame)
    found = _measure_motion(first, second, frame)
    layers["measured_motion"] = np.where(found.certain[..., None], found.motion, np.nan)
    length = np.abs(found.motion).max(axis=-1)
    figures["certain"] = float(found.certain.mean())
    if found.certain.sum() >= FEWEST:
        figures["measured motion"] = float(np.mean(length[found.certain] > MOVES))
    if frame.motion is None:
        return
    given = np.asarray(frame.motion, np.float32)
    layers["motion"] = given
    known = np.asarray(np.isfinite(given).all(-1))
    filled = np.where(known[..., None], given, 0.0)
    surface = surface_mask(frame.depth, frame.ids)
    tested = known & (np.ones(known.shape, bool) if surface is None else np.asarray(surface))
    moves = tested & (np.abs(filled).max(axis=-1) > MOVES)
    for factors in ((1.0, 1.0), (-1.0, -1.0)):  # what leaves the frame either way compares nothing
        moves &= np.asarray(on_screen(jnp.asarray(filled * np.asarray(factors, np.float32))))[..., 0]
    if moves.sum() >= FEWEST:
        for name, factors in TURNED.items():
            figures[f"left {name}"] = _left(first, second, filled * np.asarray(factors, np.float32), moves)
        figures["left swapped"] = _left(first, second, filled[..., ::-1], moves)
    figures.update(_read_forward(before, first, second))
    if frame.depth is not None and (frame.albedo is not None or frame.normal is not None):
        change = np.abs(np.asarray(_warp(first, filled)) - second).mean(axis=-1)
        order = occlusion_order(np.asarray(frame.depth)[..., 0], filled, change, tested)
        figures |= {} if order is None else {"occlusion order": order}
    difference = np.linalg.norm(filled - found.motion, axis=-1)
    both = found.certain & tested & np.asarray(on_screen(jnp.asarray(filled)))[..., 0] & ~_hidden(layers, tested)
    layers["motion_error"] = np.where(both, difference, np.nan)[..., None]
    if both.sum() >= FEWEST:
        bound = DISAGREES[0] + DISAGREES[1] * np.linalg.norm(found.motion, axis=-1)
        figures["disagrees"] = float(np.mean(difference[both] > bound[both]))
        figures["left by given"] = _left(first, second, filled, both)
        figures["left by measured"] = _left(first, second, np.asarray(found.motion), both)
    if moved is not None:
        layers["camera_motion"] = moved
        follows = tested & np.isfinite(moved).all(-1)
        follows &= np.asarray(on_screen(jnp.asarray(np.nan_to_num(moved))))[..., 0]
        if follows.sum() >= FEWEST:
            figures["camera differs"] = float(np.mean(np.linalg.norm(filled - moved, axis=-1)[follows] > MOVES))
            figures["left by camera"] = _left(first, second, np.nan_to_num(moved), follows)
            figures["left beside camera"] = _left(first, second, filled, follows)


def _read_forward(before: Frame, first: np.ndarray, second: np.ndarray) -> dict[str, float]:
    """What the vectors of the frame before leave, taken for vectors to this frame, with both signs."""
    if before.motion is None:
        return {}
    given = np.nan_to_num(np.asarray(before.motion, np.float32))
    moves = np.abs(given).max(axis=-1) > MOVES
    for sign in (1, -1):
        moves &= np.asarray(on_screen(jnp.asarray(sign * given)))[..., 0]
    if moves.sum() < FEWEST:
        return {}
    return {
        "left as forward": _left(second, first, given, moves),
        "left as forward turned": _left(second, first, -given, moves),
    }


def _hidden(layers: dict[str, np.ndarray], tested: np.ndarray) -> np.ndarray:
    """[H, W] bool, pixels that the frame before cannot show."""
    hidden = layers.get("disoccluded")
    return np.zeros(tested.shape, bool) if hidden is None else hidden[..., 0]


def _left(first: np.ndarray, second: np.ndarray, motion: np.ndarray, where: np.ndarray) -> float:
    """The mean difference that vectors leave of two frames' features."""
    warped = np.asarray(_warp(first, np.ascontiguousarray(motion, np.float32)))
    return float(np.abs(warped - second)[where].mean())


def _compare_noise(before: Frame, frame: Frame, figures: dict[str, float]) -> None:
    """The share of the still pixels whose noise is that of the frame before; only of frames that have noise."""
    one, two = (second_difference(np.log1p(np.nan_to_num(np.maximum(each.radiance, 0)))) for each in (before, frame))
    still = np.abs(two).mean(axis=-1) > 0
    if frame.motion is not None:
        still &= np.nan_to_num(np.abs(frame.motion), nan=9.0).max(axis=-1) < 0.02
    if still.sum() >= FEWEST:
        same = np.abs(two - one).mean(axis=-1) < 0.1 * np.abs(two).mean(axis=-1)
        figures["same noise"] = float(same[still].mean())
