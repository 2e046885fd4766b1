"""``trmv`` beside ``svgf`` on rendered clips of a moving shadow and of a moving reflection."""

from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

import jaxdn
from jaxdn import color, effects
from jaxdn.clips import read_clip
from jaxdn.render.clip import render_clip
from jaxdn.render.settings import RenderSettings
from tests.render.render_scenes import grey, shift
from tests.render.vector_scenes import FAST, Places, floor, look

pytestmark = [
    pytest.mark.slow,
    pytest.mark.needs("llvm"),  # only vectorised variants tell light apart
]

FRAMES = 8
WHITE: dict[str, Any] = {"type": "rgb", "value": 40.0}
CHECKERS = {
    "type": "twosided",
    "bsdf": {
        "type": "diffuse",
        "reflectance": {
            "type": "checkerboard",
            "color0": {"type": "rgb", "value": [0.8, 0.3, 0.2]},
            "color1": {"type": "rgb", "value": [0.2, 0.4, 0.7]},
        },
    },
}


def stage(ground, thing, lamp):
    """Something slides over a floor, in front of a wall."""
    parts = {
        "floor": floor(ground),
        "wall": {"type": "rectangle", "place": shift(0, 0, 3) @ np.diag([-10.0, 10, -1, 1]), "bsdf": grey(0.5)},
        "thing": thing,
        "lamp": lamp,
    }
    return Places(parts, lambda frame: look([0, 2.5, -5], [0, 0.4, 0]))


def clip_of(scene, folder):
    size: dict[str, Any] = {"width": 80, "height": 48}
    denoiser = jaxdn.denoisers.trmv()
    plan = effects.plan(effects.inspect(scene, frames=FRAMES, **size), denoiser, light="reflected")
    settings = RenderSettings(**size, plan=plan, light="reflected", reference_spp=64, variant=FAST)
    render_clip(scene, folder, settings, frames=FRAMES)
    return read_clip(folder)


def images_of(clip):
    methods = {name: getattr(jaxdn.denoisers, name)() for name in ("svgf", "trmv")}
    return {name: np.asarray(jax.jit(partial(jaxdn.denoise, each, {}))(clip)) for name, each in methods.items()}


def mean_error(image, reference, where):
    return np.abs(image - reference).mean(-1)[where].mean()


def test_the_trail_of_a_shadow_has_at_most_half_of_svgfs_error(tmp_path):
    def place(frame):
        return shift(-1.0 + 0.15 * frame, 1.5, 0.3) @ np.diag([0.5, 0.5, 0.5, 1.0])

    ball = {"type": "sphere", "place": place, "bsdf": grey(0.5)}
    lamp = {
        "type": "sphere",
        "place": shift(0.5, 5, 0) @ np.diag([0.2, 0.2, 0.2, 1.0]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 200.0}},
    }
    clip = clip_of(stage(None, ball, lamp), tmp_path)
    images, last = images_of(clip), clip.reference[-1]
    still = np.all(clip.frames.ids == clip.frames.ids[-1], axis=0)[..., 0]
    trail = still & np.any(clip.reference[2:-1].mean(-1) < 0.6 * last.mean(-1), axis=0)
    assert trail.sum() > 40
    mine, theirs = (mean_error(images[name][-1], last, trail) for name in ("trmv", "svgf"))
    assert theirs > 0.2 * last[trail].mean()
    assert mine < 0.5 * theirs


def test_a_moving_reflection_is_sharper_than_svgfs_and_leaves_no_trail(tmp_path):
    def place(frame):
        return shift(-1.0 + 0.1 * frame, 1.2, 1.0) @ np.diag([0.6, 0.6, 0.2, 1.0])

    cube = {"type": "cube", "place": place, "bsdf": CHECKERS}
    lamp = {"type": "point", "position": [1.5, 5.0, -3.0], "intensity": WHITE}
    clip = clip_of(stage({"type": "conductor"}, cube, lamp), tmp_path)
    images, last = images_of(clip), clip.reference[-1]
    scale = {name: np.asarray(color.tonemap(image[-1])) for name, image in (*images.items(), ("last", clip.reference))}
    mirror = clip.frames.roughness[-1, ..., 0] == 0
    changed = mirror & np.any(np.abs(clip.reference[2:-1] - last).max(-1) > 0.3 * last.max(-1), axis=0)
    assert changed.sum() > 40
    mine, theirs = (mean_error(scale[name], scale["last"], changed) for name in ("trmv", "svgf"))
    assert mine < 0.5 * theirs
