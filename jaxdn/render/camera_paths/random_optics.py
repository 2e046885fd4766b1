"""Random optics for training clips (``jaxdn render --random-optics``): a lens, a shutter and fog, drawn by a seed.

Each is there or not, by chance. What is blurred follows from what the camera sees: distances are read from small images
of the clip's first, middle and last frame. The record of the scene holds the result, rounded, so that it is built again
without them.
"""

import zlib
from typing import Any

import numpy as np

from jaxdn.render.buffers.gbuffer import trace_gbuffer
from jaxdn.render.families.staging import Stage
from jaxdn.render.scenes.optics import ENTRIES, Fog, Lens, SceneOptics
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.scenes.scene_file import SceneFile

_SIZE = (32, 18)
"""Width and height of the images that distances are read from."""
_LENS, _SHUTTER, _FOG = 0.4, 0.4, 0.2
"""How likely each is."""
_BLUR = (0.008, 0.08)
"""The circle of confusion that nine tenths of the image stay below, as a share of the image's width."""
_LEFT = (0.25, 0.9)
"""Share of light that fog leaves over the median distance."""


def randomise_optics(scene: AnimatedScene, seed: int, frames: int) -> AnimatedScene:
    """A family's scene or a scene file with random optics; the same arguments always give the same.

    Raises ValueError for other scenes, and for one that the camera sees nothing of.
    """
    if isinstance(scene, Stage):
        scene.set_optics(draw_optics(scene, seed, frames))
        return scene
    if not isinstance(scene, SceneFile):
        raise ValueError(f"random optics: expected a family or a scene file, got {scene.name!r}; leave them out.")
    record: dict[str, Any] = scene.record
    own = {name: value for name, value in record["animation"].items() if name not in ENTRIES}
    return SceneFile.from_record({**record, "animation": own | draw_optics(scene, seed, frames).record()})


def draw_optics(scene: AnimatedScene, seed: int, frames: int) -> SceneOptics:
    """Draw a lens, a shutter and fog for the first ``frames`` frames of a scene."""
    return draw_for_depths(_read_depths(scene, frames), scene.camera(0).x_fov, seed)


def draw_for_depths(depth: np.ndarray, x_fov: float, seed: int) -> SceneOptics:
    """The same by the view-space depths [n] that the camera sees, and its field of view in degrees."""
    rng = np.random.default_rng([seed, zlib.crc32(b"optics")])
    # All numbers are drawn whether or not they are used: one part must not change the others.
    chances, numbers = rng.random(3), rng.random(9)
    focus = float(np.quantile(depth, 0.1 + 0.8 * numbers[0]))
    blur = _BLUR[0] * (_BLUR[1] / _BLUR[0]) ** numbers[1]
    # The circle of confusion of depth z is W / tan(fov / 2) a |1 / f - 1 / z| wide, with the aperture's radius a.
    spread = float(np.quantile(np.abs(1 / focus - 1 / depth), 0.9))
    aperture = blur * float(np.tan(np.radians(x_fov) / 2)) / max(spread, 1e-6)
    lens = Lens(_round(min(aperture, 0.2 * float(depth.min()))), _round(focus))
    left = _LEFT[0] + (_LEFT[1] - _LEFT[0]) * numbers[2]
    tint = 0.6 + 0.38 * numbers[3] - 0.1 * numbers[4:7]
    fog = Fog(_round(-np.log(left) / float(np.median(depth))), (_round(tint[0]), _round(tint[1]), _round(tint[2])))
    return SceneOptics(
        lens if chances[0] < _LENS else None,
        _round(0.2 + 0.8 * numbers[7]) if chances[1] < _SHUTTER else 0.0,
        fog if chances[2] < _FOG else None,
    )


def _read_depths(scene: AnimatedScene, frames: int) -> np.ndarray:
    """View-space depths of the surfaces that the camera sees."""
    found = []
    for frame in sorted({0, frames // 2, frames - 1}):
        gbuffer = trace_gbuffer(scene.build(frame, *_SIZE))
        found.append(gbuffer.depth[gbuffer.ids >= 0])
    depth = np.concatenate(found).astype(np.float64)
    if not len(depth):
        raise ValueError(f"random optics of {scene.name}: expected a camera that sees a surface; leave them out.")
    return np.maximum(depth, 1e-6)


def _round(value: Any) -> float:
    """Four significant digits."""
    return float(f"{float(value):.4g}")
