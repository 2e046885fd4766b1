"""A white furnace: under even light of 1 an image is the reflectance, whatever moves.

Through every filter, also of dark surfaces. Through shipped weights only where surfaces reflect more than the floor of
the divisor: their histories do not keep what a division left.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import denoisers
from jaxdn.core.frame import Clip, Frame
from jaxdn.denoiser.rollout import denoise
from jaxdn.methods.registry import methods
from jaxdn.zoo.ready import find_model
from tests.methods.lobe_scenes import run
from tests.needs import require

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
    frames = furnace(stripes(0.04, 0.12), glossy=glossy, speed=SPEED)
    np.testing.assert_allclose(whiteness(name, frames)[:, :, 12:-4], 1.0, atol=0.02)


def stripes(dark, light, *, height=HEIGHT, width=WIDTH):
    """The reflectance [T, H, W] of stripes that move."""
    pixel = np.arange(width) + (np.arange(16)[:, None] + 0.5) / 16
    lines = [np.where((pixel - SPEED * index + 100) % 8 < 4, dark, light).mean(0) for index in range(FRAMES)]
    return np.stack([np.broadcast_to(line, (height, width)) for line in lines])


def whiteness_of_weights(name, frames):
    """What each image of shipped weights is in parts of the reflectance, without the sides, where things come in."""
    model = find_model(name)
    clip = jax.tree.map(lambda *each: jnp.stack(each), *frames)
    images = jax.jit(lambda params, clip: denoise(model.denoiser, params, Clip(clip)))(model.params, clip)
    return np.asarray(images / clip.reflectance)[:, :, 12:-4]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["steady-balanced", "steady-fast", "ntd-small"])
def test_weights_keep_a_grey_texture_that_moves(name):
    """Above the floor of the divisor, at most 1.5 % is left of the texture."""
    frames = furnace(stripes(0.3, 0.6, height=32, width=64), glossy=False, speed=SPEED)
    np.testing.assert_allclose(whiteness_of_weights(name, frames), 1.0, atol=0.02)


@pytest.mark.slow
def test_the_combiner_is_as_bright_as_the_light_on_the_whole():
    """Pixel by pixel it is as the library's network makes it, which keeps no furnace."""
    require("pyoidn")
    frames = [
        frame._replace(albedo=frame.reflectance)
        for frame in furnace(stripes(0.04, 0.12, height=32, width=64), glossy=False, speed=SPEED)
    ]
    np.testing.assert_allclose(whiteness_of_weights("combiner-high", frames).mean((1, 2)), 1.0, atol=0.01)
