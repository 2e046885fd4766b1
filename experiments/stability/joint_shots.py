"""The shots of :mod:`experiments.stability.joints`: four synthetic ones, and those that Mitsuba renders."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.speed.works import scene
from jaxdn.clips import read_clip
from jaxdn.core.frame import Clip
from jaxdn.render import ClipJob, RenderSettings, render_clips
from jaxdn.render.mitsuba.variant import use_variant

LAMP_OUT = 8
"""The lamp goes out so many frames before the chunk begins."""
CUT = 2
"""The cut comes so many frames after the chunk begins."""
_REFERENCE_SPP = 128


def make_shots(frames: int, size: int, chunk: int) -> dict[str, Clip]:
    """Four synthetic shots of ``frames`` frames, with clean references; ``chunk`` is the first frame of the chunk."""
    pan = scene.clip(frames, size, size, seed=1)
    still = scene.clip(1, size, size, seed=2)
    noise = np.random.default_rng(3).exponential(size=(frames, size, size, 3)).astype(np.float32)
    repeated = jax.tree.map(lambda image: np.repeat(image, frames, axis=0), still)
    motion = np.zeros_like(repeated.frames.motion)
    guides = repeated.frames._replace(radiance=repeated.reference * noise, motion=motion, dual_motion=motion)
    light = np.where(np.arange(frames) < chunk - LAMP_OUT, 1.0, 0.2).astype(np.float32)[:, None, None, None]
    dimmed = pan.frames._replace(radiance=pan.frames.radiance * light)
    return {
        "camera pans": pan,
        "camera stands": Clip(guides, repeated.reference),
        "lamp goes out": Clip(dimmed, pan.reference * light),
        "cut": _cut(pan, scene.clip(frames, size, size, seed=4), chunk + CUT),
    }


def _cut(one: Clip, other: Clip, place: int) -> Clip:
    """The frames of one clip, from ``place`` on those of another; no vector leads from there to the frame before."""
    joined = jax.tree.map(lambda first, second: np.concatenate([first[:place], second[place:]]), one, other)
    motion, dual = (np.array(vectors) for vectors in (joined.frames.motion, joined.frames.dual_motion))
    motion[place] = dual[place] = np.nan
    return Clip(joined.frames._replace(motion=motion, dual_motion=dual), joined.reference)


def render_shot(scene: str, folder: Path, frames: int, size: int) -> Clip:
    """A shot of ``frames`` frames of Mitsuba's, 1 sample a pixel; its reference has 128, and their noise.

    ``scene``: a family, or a file (.xml), through which a random camera moves past objects that move.
    """
    settings = RenderSettings(width=size, height=size, reference_spp=_REFERENCE_SPP)
    record = _animate(scene, frames) if scene.endswith(".xml") else {"family": scene, "seed": 1}
    (clip,) = render_clips([ClipJob(record, str(folder), frames, settings)], progress=False)
    return read_clip(clip)


def _animate(file: str, frames: int) -> dict[str, Any]:
    """The record of a scene file with a random animation."""
    use_variant()
    # Its names of Mitsuba exist only after a variant is chosen.
    from jaxdn.render.camera_paths.randomised_scene import randomise_scene

    return randomise_scene(file, 1, frames).record


def name_shot(scene: str) -> str:
    """What the rows of a rendered shot are called."""
    name = Path(scene).parent.name if scene.endswith(".xml") else scene
    return f"{'robot walks' if name == 'robot' else name}, rendered"
