"""Wrappers, tiles and exported steps of a denoiser that is written by hand, as three functions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn import brdf
from jaxdn.core.frame import Clip, Frame, frame_at, only
from jaxdn.denoiser import Core, core_of, recurrent, stages_of
from jaxdn.denoiser.rollout import stream, unroll
from jaxdn.denoiser.tiles import GRID, stream_tiled
from jaxdn.denoisers import demodulated, taa
from jaxdn.export.step import exported_step

KEEP = 0.8
SIZE = (38, 70)


def init(key, frame):
    return {"keep": jnp.float32(KEEP)}


def start(params, frame):
    """The history begins with the first frame: what ``start`` returns is not zero and matters."""
    return {"history": 0.5 * frame.radiance, "age": jnp.int32(0)}


def step(params, state, frame):
    assert frame.depth is None, "a buffer that it does not read"
    motion = jnp.zeros((*frame.radiance.shape[:2], 2)) if frame.motion is None else frame.motion
    history = jnp.where(state["age"] == 0, state["history"], jaxdn.warp(state["history"], motion))
    image = params["keep"] * history + (1.0 - params["keep"]) * frame.radiance
    return {"history": image, "age": state["age"] + 1}, image


MEAN = jaxdn.Denoiser(init, start, step, frozenset({"motion"}))


def clip_of(rng, count=3, size=SIZE):
    def draw(channels, low, high):
        return rng.uniform(low, high, (count, *size, channels)).astype(np.float32)

    motion = np.broadcast_to(np.float32([3.0, -2.0]), (count, *size, 2))
    return Frame(draw(3, 0, 4), albedo=draw(3, 0.02, 1), motion=motion, depth=draw(1, 1, 9))


def running_mean(light, motion):
    """The same in NumPy: whole-pixel motion, with the edge repeated."""
    height, width = light.shape[1:3]
    rows, columns = np.mgrid[:height, :width]
    dx, dy = int(motion[0, 0, 0, 0]), int(motion[0, 0, 0, 1])
    rows, columns = np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)
    history, images = 0.5 * light[0].astype(np.float64), []
    for index, noisy in enumerate(light):
        fetched = history if index == 0 else history[rows, columns]
        history = KEEP * fetched + (1 - KEEP) * noisy
        images.append(history)
    return np.stack(images)


@pytest.mark.parametrize("by", ["brdf", "albedo"])
def test_it_can_be_demodulated(by, rng):
    """Its history is of divided light."""
    frames = clip_of(rng)
    denoiser = demodulated(MEAN, by=by)
    albedo = np.asarray(frames.albedo, np.float64)
    divisor = albedo if by == "albedo" else np.asarray(jax.jit(brdf.divisor)(albedo))
    expected = running_mean(frames.radiance / divisor, frames.motion) * divisor
    images = jax.jit(partial(unroll, denoiser))(denoiser.init(jax.random.key(0), frame_at(frames, 0)), frames)
    np.testing.assert_allclose(images, expected, rtol=2e-5, atol=1e-6)
    assert denoiser.reads >= {"motion", "albedo"}
    assert demodulated(MEAN, by="none") is MEAN


def test_invalid_values_are_sanitized_before_they_are_divided(rng):
    frames = clip_of(rng)
    radiance = frames.radiance.copy()
    radiance[1, 4, 5] = np.nan
    denoiser = demodulated(MEAN)
    denoise = stream(denoiser, {"keep": jnp.float32(KEEP)})
    for index in range(3):
        assert np.isfinite(denoise(frame_at(frames._replace(radiance=radiance), index))).all()
    assert denoise.sanitized == 3
    zeroed = np.where(np.isnan(radiance), 0, radiance)
    images = jax.jit(partial(unroll, denoiser))({"keep": jnp.float32(KEEP)}, frames._replace(radiance=zeroed))
    expected = np.asarray(images)[-1]
    np.testing.assert_allclose(denoise(frame_at(frames, 2)).shape, expected.shape)


def test_it_can_be_antialiased(rng):
    """With a box that holds every colour the image is the mean of its own images along the vectors."""
    frames = clip_of(rng)._replace(motion=np.zeros((3, *SIZE, 2), np.float32), depth=None)
    denoiser = taa(after=MEAN, gamma=1e3)
    images = jax.jit(partial(unroll, denoiser))({"keep": jnp.float32(KEEP)}, frames)
    own = running_mean(frames.radiance, frames.motion)
    expected = np.stack([own[: index + 1].mean(axis=0) for index in range(3)])
    np.testing.assert_allclose(images, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("wrap", [lambda denoiser: denoiser, demodulated], ids=["plain", "demodulated"])
def test_it_can_be_tiled_once_it_says_how_far_it_sees(wrap, rng):
    """Its age is no image: every tile gets it whole."""
    side = 2 * (1 + 10 + GRID) + 3 * GRID
    frames = clip_of(rng, size=(SIZE[0], side + 5 * GRID + 7))
    size = frames.radiance.shape[1:3]
    params = {"keep": jnp.float32(KEEP)}
    with pytest.raises(ValueError, match=r"expected a denoiser whose receptive_field is known, got None; give its rad"):
        stream_tiled(wrap(MEAN), params, side, size)
    denoiser = wrap(MEAN._replace(receptive_field=1))
    tiled, whole = stream_tiled(denoiser, params, side, size), stream(denoiser, params)
    for index in range(3):
        frame = frame_at(frames, index)
        np.testing.assert_allclose(tiled(frame), whole(frame), rtol=1e-6, atol=1e-6)
    assert int(tiled._state["age"]) == 3


def test_its_step_can_be_exported(rng):
    """As named arrays: the state, whose first value does not matter, and what follows it."""
    frames = clip_of(rng)
    exported = exported_step(MEAN, {"keep": jnp.float32(KEEP)}, size=SIZE)
    assert set(exported.inputs) == {"radiance", "motion", "state.age", "state.history", "first"}
    state = {name: np.zeros(spec.shape, spec.dtype) for name, spec in exported.inputs.items() if "state" in name}
    function = jax.jit(exported.function)
    images = []
    for index in range(3):
        frame = {"radiance": frames.radiance[index], "motion": frames.motion[index], "first": np.asarray(index == 0)}
        found = function({**frame, **state})
        state = {name: found["next" + name.removeprefix("state")] for name in state}
        images.append(found["image"])
    np.testing.assert_allclose(images, running_mean(frames.radiance, frames.motion), rtol=1e-5)
    assert int(state["state.age"]) == 3
    assert int(found["sanitized"]) == 0


def test_requested_samples_go_through_the_wrappers(rng):
    """The request sees divided light, and at the first frame the state of ``start``."""

    def samples(params, state, frame, most):
        return state["history"][..., :1] + frame.radiance[..., :1]

    frame = frame_at(clip_of(rng), 0)
    denoiser = demodulated(MEAN._replace(samples=samples), by="albedo")
    state = jax.tree.map(np.zeros_like, jax.jit(denoiser.start)({}, frame))
    divided = frame.radiance[..., :1] / frame.albedo[..., :1]
    ask = jax.jit(denoiser.samples, static_argnums=3)
    np.testing.assert_allclose(ask({}, state, frame, 8), 1.5 * divided, rtol=1e-5)


def test_two_stages_are_a_step(rng):
    """Of a denoiser with the shared processing, whose statistics are measured, and of one without."""

    def middle(params, state, frame, first, statistics):
        return state, frame.radiance * statistics.mean_depth, 1

    @partial(jax.jit, static_argnums=0)
    def by_stages(denoiser, params, frame):
        stages = stages_of(denoiser)
        statistics, prepared, replaced = stages.prepare(frame)
        first = jnp.asarray(True)
        _, image, invalid = stages.step(params, stages.start(params, frame), prepared, first, statistics)
        return image, replaced + invalid

    core = Core(lambda params, frame: jnp.zeros(()), middle, frozenset({"depth"}))
    for denoiser, params in ((recurrent(core), {}), (MEAN, {"keep": jnp.float32(KEEP)})):
        frame = only(frame_at(clip_of(rng), 0), denoiser.reads)
        frame = frame._replace(radiance=np.where(np.arange(70)[:, None] == 3, -frame.radiance, frame.radiance))
        image, replaced = by_stages(denoiser, params, frame)
        state, expected = jax.jit(denoiser.step)(params, jax.jit(denoiser.start)(params, frame), frame)
        np.testing.assert_allclose(image, expected, rtol=1e-6)
        assert int(replaced) == (0 if denoiser is MEAN else int(state.sanitized))
    assert core_of(recurrent(core)) is core


def test_antialiasing_keeps_what_the_denoiser_before_asks_for(rng):
    """Its validity mask and its statistics: both were once dropped with ``after``."""

    def masked(params, state, prepared, first, statistics):
        return state, jnp.where(prepared.sample_count > 0, prepared.radiance, 7.0) + 0 * statistics.exposure, 0

    core = Core(lambda params, frame: (), masked, frozenset(), requires_validity_mask=True, receptive_field=2)
    denoiser = taa(after=recurrent(core))
    radiance = np.ones((1, 4, 5, 3), np.float32)
    radiance[0, 2, 3] = np.nan
    images = jax.jit(partial(jaxdn.denoise, denoiser))({}, Clip(Frame(radiance)))
    np.testing.assert_allclose(np.asarray(images)[0, 2, 3], 7.0)
    assert denoiser.receptive_field == 6
