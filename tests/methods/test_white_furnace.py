"""A white furnace through every filter: under even light of 1 an image is the reflectance, whatever moves."""

import functools

import numpy as np
import pytest

from jaxdn import denoisers
from jaxdn.core.frame import Frame
from jaxdn.methods.registry import methods
from tests.methods.lobe_scenes import run

HEIGHT, WIDTH, FRAMES = 12, 32, 16
SPEED = 0.37
DARK = {"darker": (0.12, 0.04), "lighter": (0.04, 0.12), "to_paint": (0.05, 0.6)}
"""What surfaces reflect in the first and in the last frame."""
FILTERS = sorted(name for name, method in methods().items() if method.filter and name != "oidn")
"""Of our own: what another library's network does is not ours to mend."""


def furnace(reflectance, *, glossy, speed=0.0):
    """Frames without noise of a plane that reflects [T, H, W] of light that is 1 from everywhere.

    Where it is not glossy, half of the light comes straight from lights.
    """
    frames = []
    for plane in reflectance:
        reflected = np.repeat(plane[..., None], 3, axis=-1).astype(np.float32)
        one = np.ones((*plane.shape, 1), np.float32)
        parts = dict.fromkeys(("shadowed", "unshadowed"), reflected / 2)
        if glossy:
            parts = dict.fromkeys(("specular", "specular_reflectance"), reflected)
        frames.append(
            Frame(
                radiance=reflected,
                reflectance=reflected,
                albedo=np.full_like(reflected, 0.01),
                depth=5 * one,
                previous_depth=5 * one,
                normal=np.broadcast_to(np.float32([0, 0, -1]), reflected.shape),
                roughness=0.6 * one,
                ids=np.zeros_like(one, np.int32),
                motion=np.broadcast_to(np.float32([-speed, 0]), (*plane.shape, 2)),
                **parts,
            )
        )
    return frames


filter_named = functools.cache(lambda name: getattr(denoisers, name)())
"""One of each, so that its step is compiled once."""


def whiteness(name, frames):
    """What each image is in parts of the reflectance, [T, H, W, 3]."""
    images = run(filter_named(name), frames)[1]
    return np.stack([image / frame.reflectance for image, frame in zip(images, frames, strict=True)])


@pytest.mark.slow
@pytest.mark.parametrize("glossy", [False, True], ids=["matt", "glossy"])
@pytest.mark.parametrize("change", DARK)
@pytest.mark.parametrize("name", FILTERS)
def test_a_reflectance_that_changes_darkens_nothing(name, change, glossy):
    first, last = DARK[change]
    levels = np.r_[np.full(6, first), np.linspace(first, last, 7), np.full(3, last)]
    frames = furnace(np.broadcast_to(levels[:, None, None], (FRAMES, HEIGHT, WIDTH)), glossy=glossy)
    np.testing.assert_allclose(whiteness(name, frames), 1.0, atol=0.02)


@pytest.mark.parametrize("glossy", [False, True], ids=["matt", "glossy"])
@pytest.mark.parametrize("name", [name for name in FILTERS if name != "taa"])
def test_a_dark_texture_that_moves_is_not_blurred(name, glossy):
    """Not of ``taa``, which has the whole radiance in its history."""
    pixel = np.arange(WIDTH) + (np.arange(16)[:, None] + 0.5) / 16
    stripes = [np.where((pixel - SPEED * index + 100) % 8 < 4, 0.04, 0.12).mean(0) for index in range(FRAMES)]
    frames = furnace([np.broadcast_to(line, (HEIGHT, WIDTH)) for line in stripes], glossy=glossy, speed=SPEED)
    np.testing.assert_allclose(whiteness(name, frames)[:, :, 12:-4], 1.0, atol=0.02)
