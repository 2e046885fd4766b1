"""The maps of a frame as pictures."""

from collections.abc import Mapping

import numpy as np

from jaxdn.core.frame import FAR, Frame
from jaxdn.evaluation.overlay.evidence import box_mean, lit_level, luminance
from jaxdn.evaluation.report.images import ERROR_COLORS

LONGEST = 64.0
"""Pixels; longer vectors have the full colour, shorter ones less of it, by the logarithm."""
LEGEND = {
    "beauty": "the noisy picture",
    "albedo": "as it is read",
    "normal": "0.5 + 0.5 n",
    "depth": "near is bright, by the logarithm; black: nothing was hit",
    "given motion": "the colour is the direction, its strength the length; grey: no vector",
    "measured motion": "the same, where it is certain; grey elsewhere",
    "camera motion": "the same, from depth and camera",
    "motion error": "given against measured, black 0 to white 4 pixels; grey: not measured",
    "history": "black: none, white: 16 frames",
    "rejected": "red: another surface, yellow: hidden in the frame before, blue: outside of it",
    "noise": "of the light, black 0 to white 100%",
    "fireflies": "single bright pixels in magenta",
    "albedo noise": "black 0 to white 0.2",
    "normal noise": "black 0 to white 0.2",
}
"""View -> what its colours mean; in the order in which they are offered."""


def draw_views(frame: Frame, layers: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """View -> picture [H, W, 3] in 0..1, display-encoded; views that a frame lacks are left out."""
    beauty = _display(np.nan_to_num(frame.radiance))
    views = {"beauty": beauty}
    if frame.albedo is not None:
        views["albedo"] = np.clip(np.nan_to_num(frame.albedo), 0, 1) ** (1 / 2.2)
    if frame.normal is not None:
        views["normal"] = np.clip(0.5 + 0.5 * np.nan_to_num(frame.normal), 0, 1)
    if frame.depth is not None:
        views["depth"] = _depth(np.asarray(frame.depth)[..., 0])
    vectors = {"given motion": "motion", "measured motion": "measured_motion", "camera motion": "camera_motion"}
    views |= {view: _wheel(layers[layer]) for view, layer in vectors.items() if layer in layers}
    scales = {"motion error": ("motion_error", 4.0), "history": ("history", 16.0), "noise": ("noise", 1.0)}
    scales |= {"albedo noise": ("albedo_noise", 0.2), "normal noise": ("normal_noise", 0.2)}
    views |= {view: _heat(layers[layer][..., 0] / top) for view, (layer, top) in scales.items() if layer in layers}
    grey = 0.35 + 0.3 * luminance(beauty)[..., None].repeat(3, axis=-1)
    if "rejected" in layers:
        marked = grey
        # What was hidden is rejected, and ought to be: red is left for what nothing explains.
        for layer, colour in (("rejected", (0.9, 0.1, 0.1)), ("disoccluded", (1, 0.85, 0)), ("outside", (0.2, 0.4, 1))):
            if layer in layers:
                marked = np.where(layers[layer], np.array(colour), marked)
        views["rejected"] = marked
    around = box_mean(layers["fireflies"].astype(np.float64), 1) > 0
    views["fireflies"] = np.where(around, np.array((1.0, 0.0, 1.0)), grey)
    return {name: views[name] for name in LEGEND if name in views}


def _display(radiance: np.ndarray) -> np.ndarray:
    """Radiance [H, W, 3] with its median at middle grey."""
    level = lit_level(radiance) or 1.0
    x = np.clip(radiance, 0, 1e6 * level) * (0.36 / level)
    return (x / (1 + x)) ** (1 / 2.2)


def _depth(depth: np.ndarray) -> np.ndarray:
    """Depth [H, W] from near to far."""
    hit = depth < FAR
    if not hit.any():
        return np.zeros((*depth.shape, 3))
    logs = np.log(np.where(hit, np.maximum(depth, 1e-6), 1.0))
    near, far = np.percentile(logs[hit], (1, 99))
    shade = 1 - 0.85 * np.clip((logs - near) / max(far - near, 1e-6), 0, 1)
    return np.where(hit, shade, 0.0)[..., None].repeat(3, axis=-1)


def _wheel(motion: np.ndarray) -> np.ndarray:
    """Vectors [H, W, 2] as colours: white for none, grey where they are not finite."""
    known = np.isfinite(motion).all(axis=-1, keepdims=True)
    filled = np.where(known, motion, 0.0).astype(np.float64)
    angle = np.arctan2(filled[..., 1], filled[..., 0])
    strength = np.clip(np.log1p(np.linalg.norm(filled, axis=-1)) / np.log1p(LONGEST), 0, 1)[..., None]
    hue = np.stack([0.5 + 0.5 * np.cos(angle - turn) for turn in (0, 2 * np.pi / 3, 4 * np.pi / 3)], axis=-1)
    return np.where(known, 1 - strength * (1 - hue), 0.5)


def _heat(values: np.ndarray) -> np.ndarray:
    """Values [H, W] of 0 to 1 in the report's colours, grey where they are not finite."""
    known = np.isfinite(values)
    at = np.clip(np.where(known, values, 0.0), 0, 1) * (len(ERROR_COLORS) - 1)
    anchors = np.asarray(ERROR_COLORS, np.float64) / 255
    colours = np.stack([np.interp(at, np.arange(len(anchors)), anchors[:, channel]) for channel in range(3)], axis=-1)
    return np.where(known[..., None], colours, 0.5)
