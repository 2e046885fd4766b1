"""The clips of the failures, rendered with every buffer that any method reads."""

import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.papers.failures.scenes import SCENES
from jaxdn.core.frame import GUIDES
from jaxdn.denoisers import svgf
from jaxdn.render.clip import render_clip
from jaxdn.render.families.staging import Stage
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import plan_clip


def render_failure(data: Path, name: str, *, size: tuple[int, int], frames: int, reference_spp: int) -> Path:
    """The folder of a clip with one sample of all reflected light a pixel, rendered if it is not there.

    A scene that was changed since gets a folder of its own: the record of a clip names its scene, and no more.

    Args:
      data: the folder for all clips.
      name: of :data:`experiments.papers.failures.scenes.SCENES`.
      size: width and height in pixels.
      frames: of the clip.
      reference_spp: samples a pixel of the reference.
    """
    make, more = SCENES[name]
    width, height = size
    scene = make()
    folder = data / f"{name.replace(' ', '-')}-{width}x{height}-{digest_scene(scene, frames)}"
    how: dict[str, Any] = {"width": width, "height": height, "light": "reflected", "max_depth": 4, **more}
    how["reference_spp"] = reference_spp
    reader = svgf()._replace(reads=frozenset(GUIDES))
    planned = plan_clip(scene, RenderSettings(**how), frames=frames, denoiser=reader)
    assert planned is not None
    render_clip(scene, folder, RenderSettings(**how, plan=planned.plan), frames=frames)
    return folder


def digest_scene(scene: Stage, frames: int) -> str:
    """Eight digits that differ for scenes with other parts, places of them, materials, light, optics, or cameras."""
    values: list[Any] = [scene.optics, [scene.camera(frame) for frame in range(frames)]]
    for name, part in scene.parts.items():
        poses = [part.pose(frame) for frame in range(frames)]
        values.append((name, part.shape, poses, part.material, part.glow))
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(values):
        text = f"{leaf.shape} {leaf.dtype}" if isinstance(leaf, np.ndarray) else repr(leaf)
        digest.update(text.encode() + (leaf.tobytes() if isinstance(leaf, np.ndarray) else b""))
    return digest.hexdigest()[:8]
