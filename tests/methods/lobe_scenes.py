"""Clips with light by lobes, and steps that are compiled once, for the tests of filters that keep lobes apart."""

import functools

import jax
import numpy as np

from jaxdn.core.frame import FAR, Frame, written_out

HEIGHT, WIDTH = 12, 14


def scene(rng, count=3, dtype=np.float32):
    """A slanted plane, half of it glossy, that moves by parts of a pixel under a row of sky."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    sky = y < 1
    buffers = {
        "depth": np.where(sky, FAR, 6 + 0.1 * x)[..., None],
        "previous_depth": np.where(sky, FAR, 6 + 0.1 * (x + 0.4))[..., None],
        "ray_length": np.where(sky, FAR, 7 + 0.1 * x)[..., None],
        "normal": np.where(sky[..., None], 0.0, np.array([0.0, 0.6, -0.8])),
        "roughness": np.where(x < WIDTH // 2, 0.2, 1.0)[..., None],
        "motion": np.broadcast_to([0.4, -0.3], (HEIGHT, WIDTH, 2)).copy(),
        "far_motion": np.broadcast_to([-0.8, 0.1], (HEIGHT, WIDTH, 2)).copy(),
        "albedo": rng.uniform(0.1, 0.6, (HEIGHT, WIDTH, 3)),
        "specular_reflectance": rng.uniform(0.05, 0.3, (HEIGHT, WIDTH, 3)),
    }
    buffers["reflectance"] = buffers["albedo"] + buffers["specular_reflectance"]
    buffers["motion"][2, 3] = buffers["far_motion"][5, 4] = np.nan
    frames = []
    for _ in range(count):
        radiance = rng.gamma(0.5, 1.0, (HEIGHT, WIDTH, 3))
        light = {"radiance": radiance, "specular": radiance * rng.integers(0, 2, (HEIGHT, WIDTH, 1))}
        light["specular_hit_distance"] = (light["specular"][..., :1] > 0) * rng.uniform(1, 9, (HEIGHT, WIDTH, 1))
        light["hit_distance"] = rng.integers(0, 2, (HEIGHT, WIDTH, 1)) * rng.uniform(1, 9, (HEIGHT, WIDTH, 1))
        arrays = {name: np.asarray(value, dtype) for name, value in (buffers | light).items()}
        frames.append(Frame(**arrays, ids=np.where(sky, -1, 2).astype(np.int32)[..., None]))
    return frames


def mirror_frames(rng, count=12):
    """A mirror whose surface passes at 3 px a frame, and in it the far sky, which stands still on the screen."""
    y, x = np.mgrid[:24, :32]
    sky = (1.0 + np.sin(x / 1.5) * np.cos(y / 2.0))[..., None] * np.ones(3)
    still, passing = np.zeros((24, 32, 2), np.float32), np.full((24, 32, 2), [3.0, 0.0], np.float32)
    one = np.ones((24, 32, 1), np.float32)
    frames = []
    for _ in range(count):
        light = (sky * rng.gamma(2.0, 0.5, (24, 32, 1))).astype(np.float32)
        frames.append(
            Frame(
                light,
                specular=light,
                depth=5 * one,
                normal=np.broadcast_to(np.array([0, 0, -1], np.float32), light.shape),
                roughness=0 * one,
                motion=passing,
                far_motion=still,
                specular_hit_distance=FAR * one,
            )
        )
    return sky, frames


def neutral(frame, names):
    """The neutral values of absent buffers, written out, of those that a method reads."""
    return written_out(frame._replace(**dict.fromkeys(names)), names)


@functools.cache
def compiled(denoiser):
    """Its step: compiled once for each set of buffers."""
    return jax.jit(denoiser.step)


@functools.cache
def starting(denoiser):
    """Its first state: one program, not one for each plane."""
    return jax.jit(denoiser.start)


def run(denoiser, frames):
    step, state, images = compiled(denoiser), starting(denoiser)({}, frames[0]), []
    for frame in frames:
        state, image = step({}, state, frame)
        images.append(np.asarray(image))
    return state, images


def check_light_and_options(loss, light, params, rng, *, by):
    """The gradient of ``loss(*light, params)`` in float64, by one program.

    All of the light has one, two of the params at the least, and along random directions of all params and of each of
    the arrays ``by`` it is that of central differences.
    """
    program = jax.jit(jax.value_and_grad(loss, tuple(range(len(light) + 1))))
    found = program(*light, params)[1]
    for each in found[:-1]:
        assert each.dtype == np.float64
        assert np.isfinite(each).all()
        assert np.abs(each).max() > 1e-6
    slopes = jax.tree.leaves(found[-1])
    assert all(np.isfinite(slope).all() for slope in slopes)
    assert sum(float(np.abs(slope).max()) > 0 for slope in slopes) >= 2
    at = (*light, params)
    for index in (*by, len(light)):
        way = jax.tree.map(lambda leaf: rng.normal(size=np.shape(leaf)) * 1e-6, at[index])
        ahead, behind = (
            program(*at[:index], jax.tree.map(lambda a, b, s=sign: a + s * b, at[index], way), *at[index + 1 :])[0]
            for sign in (1, -1)
        )
        told = sum(np.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (found[index], way)), strict=True))
        np.testing.assert_allclose(told, (ahead - behind) / 2, rtol=2e-2)
