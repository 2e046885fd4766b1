"""The recurrent autoencoder, alone and behind the accumulation: its network against NumPy, what it remembers."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import FAR, Frame, frame_at
from jaxdn.denoiser import Denoiser
from jaxdn.denoiser.rollout import unroll
from jaxdn.denoiser.statistics import measure_frame
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods.arae import arae
from jaxdn.methods.rae import LARGE, SMALL, rae
from jaxdn.methods.registry import methods
from jaxdn.networks.recurrent import recurrent_unet
from tests.gradients import check_gradients

TINY = ((3, 4, 5), (5, 4), (4, 3))
SIZE = (10, 13)
"""Not a multiple of what the network works on."""
PLAIN: dict[str, Any] = {"size": TINY, "exposure": "given", "demodulate": "none"}


def clip_of(rng: np.random.Generator, count: int = 3, size: tuple[int, int] = SIZE) -> Frame:
    """All buffers that rae reads, a camera that stands still."""
    shape = (count, *size)
    normal = rng.normal(size=(*shape, 3))
    buffers = {
        "radiance": rng.exponential(size=(*shape, 3)),
        "albedo": rng.uniform(0.2, 1, size=(*shape, 3)),
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "depth": rng.uniform(1, 9, size=(*shape, 1)),
        "roughness": rng.uniform(size=(*shape, 1)),
    }
    return Frame(**{name: values.astype(np.float32) for name, values in buffers.items()})


@functools.partial(jax.jit, static_argnums=0)
def varied(denoiser: Denoiser, frames: Frame, key: jax.Array) -> Any:
    """Parameters with biases of every size."""
    params = denoiser.init(key, frame_at(frames, 0))
    return jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(key, leaf.shape), params)


def images_of(denoiser: Denoiser, params: Any, frames: Frame) -> np.ndarray:
    return np.asarray(compiled(denoiser)(params, frames))


@functools.cache
def compiled(denoiser: Denoiser) -> Callable[[Any, Frame], jax.Array]:
    """Images of params and frames, compiled once for each set of buffers."""
    return jax.jit(functools.partial(unroll, denoiser))


@functools.cache
def plain() -> Denoiser:
    """Once: what is compiled is kept by denoiser."""
    return rae(**PLAIN)


@functools.cache
def tiny() -> Denoiser:
    return rae(size=TINY)


# The network in NumPy, in float64.


def convolution(x: np.ndarray, layer: dict[str, np.ndarray], slope: float = 0.1) -> np.ndarray:
    height, width = x.shape[:2]
    padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    taps = (padded[i : i + height, j : j + width] @ layer["kernel"][i, j] for i in range(3) for j in range(3))
    y = sum(taps) + layer["bias"]
    return np.where(y > 0, y, slope * y)


def numpy_network(params: Any, x: np.ndarray, states: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """One frame [H, W, C]; the hidden states are those of the frame before, and then of this one."""
    params = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    kept = []
    for stage, state in enumerate(states):
        layers = params[f"encoder_{stage}"]
        if stage:
            height, width, channels = x.shape
            x = x.reshape(height // 2, 2, width // 2, 2, channels).max(axis=(1, 3))
        x = convolution(convolution(x, layers["convolution_0"]), layers["convolution_1"])
        x = convolution(np.concatenate([x, state], axis=-1), layers["convolution_2"])
        x = convolution(x, layers["convolution_3"])
        kept.append(x)
    for level in reversed(range(len(states) - 1)):
        x = np.concatenate([x.repeat(2, axis=0).repeat(2, axis=1), kept[level]], axis=-1)
        for layer in params[f"decoder_{level}"].values():
            x = convolution(x, layer)
    return convolution(x, params["output"], slope=1.0), kept


def numpy_compress(x: np.ndarray) -> np.ndarray:
    u = np.log1p(x)
    return np.where(u <= 1e-4, 1e-4 ** (1 / 2.2) / 1e-4 * u, np.maximum(u, 1e-300) ** (1 / 2.2))


@pytest.mark.slow
def test_three_frames_are_those_of_the_numpy_network(rng, key):
    frames, denoiser = clip_of(rng), plain()
    params = varied(denoiser, frames, key)
    found = images_of(denoiser, params, frames)
    measure = jax.jit(lambda frame: measure_frame(frame.radiance, frame.depth, frame).mean_depth)
    states = [np.zeros((12 >> stage, 16 >> stage, channels)) for stage, channels in enumerate(TINY[0])]
    for index, image in enumerate(found):
        frame = frame_at(frames, index)
        depth = np.asarray(jax.jit(depth_feature)(frame.depth, measure(frame)))
        seen = [numpy_compress(np.asarray(frame.radiance, np.float64)), frame.normal, depth, frame.roughness - 1.0]
        seen = [np.pad(each, ((0, 2), (0, 3), (0, 0)), mode="edge") for each in seen]
        output, states = numpy_network(params, np.concatenate(seen, axis=-1), states)
        positive = np.maximum(output[: SIZE[0], : SIZE[1]], 0)
        wanted = np.where(positive <= 1e-4 ** (1 / 2.2), positive / (1e-4 ** (1 / 2.2) / 1e-4), positive**2.2)
        np.testing.assert_allclose(image, np.expm1(wanted), rtol=2e-4, atol=1e-5)


def test_it_has_the_weights_of_the_published_layout(key):
    networks = [recurrent_unet((3, 2, 1, 1), 3, widths=widths) for widths in (LARGE, SMALL)]
    shapes = [jax.tree.leaves(jax.eval_shape(network.init, key)) for network in networks]
    weights = [sum(leaf.size for leaf in leaves) for leaves in shapes]
    assert weights[0] == pytest.approx(1.95e6, rel=0.005)
    assert weights[1] < 0.25 * weights[0]


def test_an_absent_buffer_is_neutral(rng, key):
    frames, denoiser = clip_of(rng), plain()
    params = varied(denoiser, frames, key)
    absent = frames._replace(normal=None, depth=None, roughness=None)
    neutral = frames._replace(
        normal=0 * frames.normal, depth=0 * frames.depth, roughness=np.ones_like(frames.roughness)
    )
    np.testing.assert_allclose(images_of(denoiser, params, absent), images_of(denoiser, params, neutral), atol=1e-4)


def test_it_remembers_what_it_saw_until_it_starts_again(rng, key):
    frames, denoiser = clip_of(rng), plain()
    params = varied(denoiser, frames, key)
    together = images_of(denoiser, params, frames)
    alone = images_of(denoiser, params, jax.tree.map(lambda buffer: buffer[2:], frames))
    assert np.abs(together[2] - alone[0]).max() > 0.01
    other = frames._replace(radiance=frames.radiance * np.float32([4, 1, 1])[:, None, None, None])
    changed = images_of(denoiser, params, other)
    assert np.abs(changed[2] - together[2]).max() > 1e-4


def test_a_frame_of_another_size_is_refused(rng, key):
    frames, denoiser = clip_of(rng), plain()
    params, first = varied(denoiser, frames, key), frame_at(frames, 0)
    state = jax.jit(denoiser.start)(params, first)
    larger = frame_at(clip_of(rng, 1, (40, 40)), 0)
    with pytest.raises(ValueError, match=r"expected the size of the first frame, got 40 x 40.*start again"):
        jax.jit(denoiser.step)(params, state, larger)


@pytest.mark.parametrize("gain", [1 / 64, 64.0])
def test_brighter_light_gives_the_same_picture(gain, rng, key):
    frames, denoiser = clip_of(rng), tiny()
    params = varied(denoiser, frames, key)
    usual = images_of(denoiser, params, frames)
    bright = images_of(denoiser, params, frames._replace(radiance=gain * frames.radiance))
    assert np.mean(np.abs(bright / gain - usual)) < 0.01 * np.mean(usual)


def test_the_sky_passes_through_and_gives_nothing(rng, key):
    frames, denoiser = clip_of(rng), tiny()
    sky = np.arange(SIZE[1])[None, None, :, None] < 4
    frames = frames._replace(depth=np.where(sky, np.float32(FAR), frames.depth), albedo=None)
    params = varied(denoiser, frames, key)
    bright, dark = (
        images_of(denoiser, params, frames._replace(radiance=np.where(sky, light, frames.radiance)))
        for light in np.float32([1000.0, 0.0])
    )
    np.testing.assert_allclose(bright[:, :, :4], 1000.0)
    np.testing.assert_allclose(bright[:, :, 4:], dark[:, :, 4:], rtol=1e-4)


def test_a_hidden_state_that_overflows_does_not_stay(rng, key):
    frames, denoiser = clip_of(rng), plain()
    params, first = varied(denoiser, frames, key), frame_at(frames, 0)
    state = jax.jit(denoiser.start)(params, first)
    worst = zip(state.core, (np.nan, 1e30, 0.0), strict=True)
    broken = state._replace(core=tuple(np.full_like(each, value) for each, value in worst))
    kept, image = jax.jit(denoiser.step)(params, broken, first)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((kept.core, image)))
    assert kept.sanitized > 0


@pytest.mark.slow
def test_gradients_flow_through_the_hidden_states(rng, key):
    frames, denoiser = clip_of(rng, 2, (4, 8)), plain()
    with jax.enable_x64(True):
        frames = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), frames)
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), varied(denoiser, frames, key))

        def last(params: Any, first_light: jax.Array) -> jax.Array:
            radiance = jnp.concatenate([first_light[None], frames.radiance[1:]])
            images = unroll(denoiser, params, frames._replace(radiance=radiance))
            return jnp.mean(jnp.sqrt(1.0 + images[1]))

        slopes = check_gradients(last, (params, frames.radiance[0]), eps=1e-6, rtol=1e-4)
        assert np.abs(slopes[1]).max() > 0


@pytest.mark.slow
def test_the_accumulation_gives_it_the_mean_of_all_frames(rng, key):
    """Nothing moves and no light changes: the last image is that of rae on the mean of the frames so far."""
    frames, options = clip_of(rng), {**PLAIN, "background": "filter"}
    still = jax.tree.map(lambda buffer: np.broadcast_to(buffer[:1], buffer.shape), frames)
    unchanged = np.broadcast_to(np.float32([0.0, 1.0]), (3, *SIZE, 2))
    still = still._replace(radiance=frames.radiance, luminance_gradient=unchanged)
    params = varied(rae(**options), frames, key)
    means = np.cumsum(frames.radiance, axis=0) / np.float32([1, 2, 3])[:, None, None, None]
    found = images_of(arae(**options), params, still)
    wanted = images_of(rae(**options), params, still._replace(radiance=means))
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("background", ["pass", "filter"])
def test_the_sky_keeps_its_radiance_behind_the_accumulation_too(background, rng, key):
    """Sky that goes out is dark at once, and not the mean of the frames so far."""
    frames = clip_of(rng, 6)
    sky = np.arange(SIZE[1])[None, :, None] < 4
    still = jax.tree.map(lambda buffer: np.broadcast_to(buffer[:1], buffer.shape), frames)
    light = np.where(sky, np.float32([1, 1, 1, 0, 0, 0])[:, None, None, None], frames.radiance)
    still = still._replace(radiance=light, depth=np.where(sky, np.float32(FAR), still.depth))
    denoiser = arae(**PLAIN, background=background)
    images = images_of(denoiser, varied(denoiser, frames, key), still)
    assert np.array_equal(images[:, :, :4], light[:, :, :4]) == (background == "pass")


@pytest.mark.slow
def test_light_that_changed_by_half_leaves_half_of_the_history_as_published(rng, key):
    """Of two frames the second weighs 1 / 2, and half of what is left goes: a quarter of the first stays."""
    frames, options = clip_of(rng, 2), {**PLAIN, "background": "filter"}
    still = jax.tree.map(lambda buffer: np.broadcast_to(buffer[:1], buffer.shape), frames)
    halved = np.broadcast_to(np.float32([0.5, 1.0]), (2, *SIZE, 2))
    still = still._replace(radiance=frames.radiance, luminance_gradient=halved)
    params = varied(rae(**options), frames, key)
    means = np.stack([frames.radiance[0], 0.25 * frames.radiance[0] + 0.75 * frames.radiance[1]])
    found = images_of(arae(**options, accumulation="published"), params, still)
    wanted = images_of(rae(**options), params, still._replace(radiance=means))
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


def test_the_papers_settings_are_presets():
    for name in ("rae", "arae"):
        row = methods()[name]
        assert row.parse_options({"preset": "paper"}).demodulate == "albedo"
        compared = row.parse_options({"preset": "hasselgren"})
        assert (compared.demodulate, compared.guides) == ("none", "materials")
        assert row.recipe_named("paper").frames == 7
    assert methods()["arae"].parse_options({"preset": "paper"}).accumulation == "published"
