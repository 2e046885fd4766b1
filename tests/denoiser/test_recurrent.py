"""The processing that all denoisers share, on toy cores: checks, sanitizing, age, bounds, demodulation, samples."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import RADIANCE_MAX, Clip, Frame, frame_at, present
from jaxdn.denoiser import Core, Recurrent, recurrent
from jaxdn.denoiser.rollout import denoise, stream, unroll
from jaxdn.methods.demodulation import demodulated
from jaxdn.ops.sampling import draw_random_numbers, from_layers

SIZE = (4, 6)
BY_ALBEDO = partial(demodulated, by="albedo")


def frame_of(rng, **buffers):
    return Frame(jnp.asarray(rng.exponential(size=(*SIZE, 3)), jnp.float32), **buffers)


def core_of(step, *, reads=(), start=lambda params, frame: jnp.zeros(()), **others):
    return Core(start, step, frozenset(reads), **others)


def identity(**others):
    """Its image and its state are the frame's radiance."""
    return core_of(
        lambda params, state, frame, first, statistics: (frame.radiance, frame.radiance, 0),
        start=lambda params, frame: jnp.zeros_like(frame.radiance),
        **others,
    )


def test_first_is_passed_once_and_age_counts_frames(rng):
    core = core_of(
        lambda params, state, frame, first, statistics: (first, frame.radiance, 0), start=lambda params, frame: False
    )
    denoiser, frame = recurrent(core), frame_of(rng)
    assert denoiser.core is core
    state = denoiser.start({}, frame)
    assert isinstance(state, Recurrent)
    assert (int(state.age), int(state.sanitized)) == (0, 0)
    for index in range(4):
        state, _ = denoiser.step({}, state, frame)
        assert bool(state.core) == (index == 0)
        assert int(state.age) == index + 1
    assert state.age.dtype == state.sanitized.dtype == jnp.int32


def test_first_is_passed_under_scan_too(rng):
    step = lambda params, state, frame, first, statistics: (state, jnp.where(first, 1.0, 2.0) + 0 * frame.radiance, 0)  # noqa: E731
    frames = jax.tree.map(lambda *buffers: jnp.stack(buffers), *[frame_of(rng) for _ in range(3)])
    images = jax.jit(lambda frames: unroll(recurrent(core_of(step)), {}, frames))(frames)
    np.testing.assert_array_equal(images[:, 0, 0, 0], [1, 2, 2])


def test_the_core_sees_sanitized_buffers_and_only_those_that_it_reads(rng):
    seen = []

    def step(params, state, frame, first, statistics):
        seen.append(frame)
        return state, frame.radiance, 0

    bad = jnp.full((*SIZE, 1), -1.0)
    frame = frame_of(rng, depth=bad, roughness=bad, albedo=jnp.full((*SIZE, 3), jnp.nan))
    frame = frame._replace(radiance=frame.radiance.at[0, 0].set(jnp.asarray([jnp.nan, -1.0, 1e30])))
    denoiser = recurrent(core_of(step, reads={"depth", "albedo"}))
    state, _ = denoiser.step({}, denoiser.start({}, frame), frame)
    assert present(seen[0]) == ("albedo", "depth")
    np.testing.assert_array_equal(seen[0].albedo, 1)
    np.testing.assert_array_equal(seen[0].depth, 0)
    np.testing.assert_array_equal(seen[0].radiance[0, 0], [0, 0, RADIANCE_MAX])
    # Buffers that are not read are not counted: 3 values of the radiance, all of albedo and depth.
    assert int(state.sanitized) == 3 + 24 * 3 + 24


@pytest.mark.parametrize("wrap", [lambda denoiser: denoiser, demodulated])
@pytest.mark.parametrize("reads", [frozenset(), frozenset({"sample_count"})])
def test_a_core_is_told_which_pixels_were_not_measured(reads, wrap):
    def step(params, state, frame, first, statistics):
        return frame.sample_count, frame.radiance, 0

    core = Core(lambda params, frame: frame.radiance[..., :1], step, reads, requires_validity_mask=True)
    light = np.ones((1, 5, 3), np.float32)
    light[0, 1:4, 1] = np.nan, np.inf, -1.0
    frame = Frame(light, albedo=np.full_like(light, 0.5), sample_count=np.full((1, 5, 1), 3.0, np.float32))
    denoiser = wrap(recurrent(core))
    state = jax.jit(lambda frame: denoiser.step({}, denoiser.start({}, frame), frame)[0])(frame)
    state = jax.tree.map(np.asarray, state)
    np.testing.assert_array_equal(state.core[0, :, 0], np.float32([1, 0, 0, 1, 1]) * (3 if reads else 1))


def test_start_sees_sanitized_buffers_and_counts_nothing(rng):
    frame = frame_of(rng)._replace(radiance=jnp.full((*SIZE, 3), jnp.inf))
    denoiser = recurrent(core_of(identity().step, start=lambda params, frame: frame.radiance))
    state = denoiser.start({}, frame)
    np.testing.assert_array_equal(state.core, 0)
    assert int(state.sanitized) == 0


@pytest.mark.parametrize("lost", [2, jnp.asarray(2, jnp.int32)])
def test_sanitized_values_of_frames_and_of_the_history_add_up(lost, rng):
    core = core_of(lambda params, state, frame, first, statistics: (state, frame.radiance, lost))
    denoiser, frame = recurrent(core), frame_of(rng)
    broken = frame._replace(radiance=frame.radiance.at[1, 2].set(jnp.nan))
    state = denoiser.start({}, frame)
    for given, expected in ((broken, 5), (frame, 7), (broken, 12)):
        state, _ = denoiser.step({}, state, given)
        assert int(state.sanitized) == expected


def test_images_are_clamped_to_their_bounds(rng):
    given = np.array([-1e30, -1.0, -0.0, 0.0, 0.5, RADIANCE_MAX, 1e5, np.inf], np.float32)
    values = jnp.asarray(rng.choice(given, (*SIZE, 3)))
    denoiser, frame = (
        recurrent(core_of(lambda params, state, frame, first, statistics: (state, values, 0))),
        frame_of(rng),
    )
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    np.testing.assert_array_equal(image, np.clip(values, 0, RADIANCE_MAX))
    assert float(image.min()) == 0
    assert float(image.max()) == RADIANCE_MAX
    assert int(state.sanitized) == 0  # a method's own overshoot is not a sanitized value


def test_the_state_is_the_cores_own_and_is_not_clamped(rng):
    core = core_of(lambda params, state, frame, first, statistics: (-5.0 * frame.radiance, -5.0 * frame.radiance, 0))
    denoiser, frame = recurrent(core), frame_of(rng)
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    np.testing.assert_array_equal(state.core, -5 * frame.radiance)
    np.testing.assert_array_equal(image, 0)


WRONG = {
    "a clip": (lambda frame: frame._replace(radiance=frame.radiance[None]), r"frame\.radiance: expected \[H, W, C\]"),
    "two channels": (lambda frame: frame._replace(radiance=frame.radiance[..., :2]), r"frame\.radiance.*3 channels"),
    "no pixels": (lambda frame: frame._replace(radiance=frame.radiance[:0]), r"frame\.radiance.*at least one pixel"),
    "integers": (lambda frame: frame._replace(radiance=frame.radiance.astype(int)), r"frame\.radiance.*floating"),
    "another height": (lambda frame: frame._replace(depth=frame.depth[1:]), r"frame\.depth.*same size"),
    "another width": (lambda frame: frame._replace(depth=frame.depth[:, 1:]), r"frame\.depth.*same size"),
    "a vector of one number": (
        lambda frame: frame._replace(motion=frame.motion[..., :1]),
        r"frame\.motion.*2 channels",
    ),
    "three depths": (lambda frame: frame._replace(depth=frame.depth[..., [0, 0, 0]]), r"frame\.depth.*1 channels"),
    "a depth in bytes": (lambda frame: frame._replace(depth=frame.depth.astype(jnp.uint8)), r"frame\.depth.*floating"),
    "one axis too many": (lambda frame: frame._replace(depth=frame.depth[None]), r"frame\.depth.*same size"),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("wrap", [lambda denoiser: denoiser, demodulated], ids=["plain", "demodulated"])
def test_shapes_that_do_not_fit_raise(wrong, wrap, rng):
    spoil, told = WRONG[wrong]
    frame = frame_of(rng, depth=jnp.ones((*SIZE, 1)), albedo=jnp.ones((*SIZE, 3)), motion=jnp.zeros((*SIZE, 2)))
    reads = {"depth", "motion"}
    denoiser = wrap(recurrent(identity(reads=reads, samples=lambda params, state, frame, first, most: frame.depth)))
    state = denoiser.start({}, frame)
    for function in (
        lambda given: denoiser.start({}, given),
        lambda given: denoiser.step({}, state, given),
        lambda given: denoiser.samples({}, state, given, 7),
    ):
        with pytest.raises(ValueError, match=told):
            function(spoil(frame))


def test_a_buffer_that_is_not_read_may_have_any_shape(rng):
    frame = frame_of(rng, depth=jnp.ones((9, 9, 1)))
    denoiser = recurrent(identity())
    _, image = denoiser.step({}, denoiser.start({}, frame), frame)
    np.testing.assert_array_equal(image, frame.radiance)


# Radiance divided by the albedo.


def albedo_of(rng):
    """Albedos of all magnitudes, with zeros and values at the threshold of division."""
    values = rng.uniform(0.011, 1, (*SIZE, 3))
    values[0] = rng.choice([0.0, 0.01, 0.005, 1.0], values[0].shape)
    return jnp.asarray(values, jnp.float32)


def test_demodulating_an_identity_gives_the_radiance_back(rng):
    frame = frame_of(rng, albedo=albedo_of(rng))
    denoiser = demodulated(recurrent(identity()), by="albedo")
    assert denoiser.reads == {"albedo"}
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    np.testing.assert_allclose(image, frame.radiance, rtol=1e-6, atol=0)
    # The core's input and state are demodulated: divided where the albedo exceeds the threshold.
    albedo = np.asarray(frame.albedo, np.float64)
    expected = np.asarray(frame.radiance, np.float64) / np.where(albedo > np.float32(0.01), albedo, 1)
    np.testing.assert_allclose(state.core, expected, rtol=1e-6)
    assert int(state.age) == 1
    assert int(state.sanitized) == 0


def test_demodulated_start_gets_divided_radiance_too(rng):
    frame = frame_of(rng, albedo=jnp.full((*SIZE, 3), 0.5))
    core = identity()._replace(start=lambda params, frame: frame.radiance)
    np.testing.assert_allclose(
        demodulated(recurrent(core), by="albedo").start({}, frame).core, 2 * frame.radiance, rtol=1e-6
    )


def test_values_are_sanitized_and_counted_once_before_they_are_divided(rng):
    albedo = jnp.full((*SIZE, 3), 0.5).at[0, 0, 0].set(jnp.nan)
    frame = frame_of(rng, albedo=albedo)
    frame = frame._replace(radiance=frame.radiance.at[2, 3, 1].set(jnp.inf))
    denoiser = demodulated(recurrent(identity()), by="albedo")
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    assert int(state.sanitized) == 2
    np.testing.assert_allclose(image, frame.radiance.at[2, 3, 1].set(0), rtol=1e-6)


def test_divided_radiance_is_not_clamped_and_the_image_is(rng):
    """A clamp of the divided radiance would make the image depend on the exposure."""
    frame = Frame(jnp.full((*SIZE, 3), 60000.0), albedo=jnp.full((*SIZE, 3), 0.02))
    denoiser = demodulated(recurrent(identity()), by="albedo")
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    np.testing.assert_allclose(state.core, 60000 / 0.02, rtol=1e-6)
    np.testing.assert_allclose(image, 60000, rtol=1e-6)


def test_without_albedo_or_by_none_nothing_is_divided(rng):
    plain, frame = recurrent(identity()), frame_of(rng)
    assert demodulated(plain, by="none") is plain
    denoiser = demodulated(plain)
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    np.testing.assert_array_equal(image, frame.radiance)
    np.testing.assert_array_equal(state.core, frame.radiance)
    with pytest.raises(ValueError, match="'brdf', 'albedo', 'none', got 'normal'"):
        demodulated(plain, by="normal")


def test_radiance_is_divided_by_the_reflectance_or_else_by_the_albedo(rng):
    albedo, reflectance = (jnp.asarray(rng.uniform(0, 1, (*SIZE, 3)), jnp.float32) for _ in range(2))
    denoiser = demodulated(recurrent(identity()))
    assert denoiser.reads == {"albedo", "reflectance"}
    buffers = ({"albedo": albedo, "reflectance": reflectance}, {"albedo": albedo}, {"reflectance": reflectance}, {})
    for given in buffers:
        frame = frame_of(rng, **given)
        state, image = denoiser.step({}, denoiser.start({}, frame), frame)
        np.testing.assert_allclose(image, frame.radiance, rtol=1e-6)
        by = np.asarray(given.get("reflectance", given.get("albedo", 1.0)), np.float64)
        expected = ((by**4 + 0.15**4) / (1 + 0.15**4)) ** 0.25 if given else by
        np.testing.assert_allclose(state.core, np.asarray(frame.radiance, np.float64) / expected, rtol=1e-6)


def test_no_reflectance_is_the_albedo_written_out(rng):
    albedo = albedo_of(rng)
    denoiser = demodulated(recurrent(identity()))
    frame = frame_of(rng, albedo=albedo)
    cores = []
    for each in (frame, frame._replace(reflectance=albedo)):
        state, _ = denoiser.step({}, denoiser.start({}, each), each)
        cores.append(state.core)
    np.testing.assert_array_equal(*cores)


@pytest.mark.parametrize("name", ["albedo", "reflectance"])
def test_similar_reflectances_have_similar_divisors(name):
    """A ramp of dark values through 0.01, where dividing by the albedo jumps by a factor of 100."""
    ramp = np.linspace(0, 0.03, 31, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    frame = Frame(np.ones((1, 31, 3), np.float32), **{name: ramp})
    largest = {}
    for by in ("brdf", "albedo"):
        denoiser = demodulated(recurrent(identity()), by=by)
        state, _ = jax.jit(denoiser.step)({}, jax.jit(denoiser.start)({}, frame), frame)
        light = np.asarray(state.core)[0, :, 0]
        largest[by] = np.max(light[1:] / light[:-1])
    assert largest["brdf"] < 1.01
    assert name == "reflectance" or largest["albedo"] > 50


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-40, 1e-9, 1.0, 1e9, 1e38])
def test_any_reflectance_gives_the_radiance_back(rng, value):
    frame = frame_of(rng)._replace(reflectance=jnp.full((*SIZE, 3), value, jnp.float32))
    denoiser = demodulated(recurrent(identity()))
    state, image = denoiser.step({}, denoiser.start({}, frame), frame)
    assert np.all(np.isfinite(state.core))
    np.testing.assert_allclose(image, frame.radiance, rtol=1e-6)


def test_a_wrapped_denoiser_can_be_wrapped_again(rng):
    """Demodulated twice is divided twice, as its core is that of the first wrapper."""
    frame = frame_of(rng, albedo=jnp.full((*SIZE, 3), 0.5))
    twice = BY_ALBEDO(BY_ALBEDO(recurrent(identity())))
    state, image = twice.step({}, twice.start({}, frame), frame)
    np.testing.assert_allclose(state.core, 4 * frame.radiance, rtol=1e-6)
    np.testing.assert_allclose(image, frame.radiance, rtol=1e-6)


# Requested samples.


def adaptive(wrap=lambda denoiser: denoiser):
    """Requests more samples where the radiance rendered before is brighter, up to a learned number."""

    def samples(params, state, frame, first, most):
        return params["most"] * frame.radiance[..., :1] / (1 + frame.radiance[..., :1])

    def step(params, state, frame, first, statistics):
        image = params["gain"] * frame.radiance + 0.01 * jnp.where(first, 0.0, state)
        kept = image if frame.sample_count is None else image + 0 * frame.sample_count
        return kept, image, 0

    def init(key, frame):
        return {"most": jnp.asarray(6.0), "gain": jnp.asarray(0.9)}

    core = identity(reads={"sample_count"}, init=init, samples=samples)._replace(step=step)
    return wrap(recurrent(core))


ONES = jnp.ones((*SIZE, 1))


def layered(rng, count=3):
    """A clip with layers of 1, 2 and 4 samples, and the radiance rendered before."""
    shape = (count, *SIZE, 3)
    layers = {1 << bit: jnp.asarray(rng.exponential(size=shape), jnp.float32) for bit in range(3)}
    beforehand = jnp.asarray(rng.exponential(2.0, size=shape), jnp.float32)
    albedo = jnp.asarray(rng.uniform(0.2, 1.0, shape), jnp.float32)
    return Clip(Frame(beforehand, albedo=albedo), None, layers)


WRAPS = [lambda denoiser: denoiser, BY_ALBEDO]


@pytest.mark.parametrize("wrap", WRAPS, ids=["plain", "demodulated"])
def test_requested_samples_come_from_the_layers(wrap, rng):
    """A loop in NumPy that requests samples, combines the layers, and steps."""
    denoiser, clip = adaptive(wrap), layered(rng)
    params = denoiser.init(jax.random.key(0), frame_at(clip.frames, 0))
    images = denoise(denoiser, params, clip)
    state, asked = None, []
    for index in range(3):
        frame = frame_at(clip.frames, index)
        divisor = np.asarray(frame.albedo) if wrap is BY_ALBEDO else np.ones((*SIZE, 3))
        bright = np.asarray(clip.layers[1][index], np.float64) / divisor  # what was rendered before: one sample
        wanted = 6 * bright[..., :1] / (1 + bright[..., :1])
        uniform = np.asarray(draw_random_numbers(*SIZE, index))
        counts = (np.floor(wanted) + (uniform < wanted - np.floor(wanted))).astype(int)
        taken = sum(np.where(counts & n, n, 0) * np.asarray(layer[index]) for n, layer in clip.layers.items())
        light = taken / np.maximum(counts, 1) / divisor
        expected = 0.9 * light + (0 if state is None else 0.01 * state)
        state = expected
        asked.append(counts)
        np.testing.assert_allclose(images[index], expected * divisor, rtol=1e-5, atol=1e-6)
    assert len(np.unique(asked)) > 4


@pytest.mark.parametrize("wrap", WRAPS, ids=["plain", "demodulated"])
def test_a_stream_gives_samples_as_a_clip_does(wrap, rng):
    denoiser, clip = adaptive(wrap), layered(rng)
    params = denoiser.init(jax.random.key(0), frame_at(clip.frames, 0))
    images, one = denoise(denoiser, params, clip), stream(denoiser, params)
    for index in range(3):
        layers = {samples: layer[index] for samples, layer in clip.layers.items()}
        np.testing.assert_allclose(one(frame_at(clip.frames, index), layers), images[index], rtol=1e-6, atol=1e-7)
    assert len(one.programs) == 1


def test_the_step_gets_the_actual_number_of_samples(rng):
    told = []

    def step(params, state, frame, first, statistics):
        jax.debug.callback(lambda counts: told.append(np.array(counts)), frame.sample_count)
        return state, frame.radiance, 0

    core = core_of(
        step, reads={"sample_count"}, samples=lambda params, state, frame, first, most: 100.0 * frame.radiance[..., :1]
    )
    clip = layered(rng, count=1)
    one = stream(recurrent(core), {})
    layers = {samples: layer[0] for samples, layer in clip.layers.items()}
    image = one(frame_at(clip.frames, 0), layers)
    jax.effects_barrier()
    np.testing.assert_array_equal(told[0], np.clip(np.round(100 * clip.layers[1][0, ..., :1]), 0, 7))
    np.testing.assert_allclose(image, from_layers(layers, told[0])[0], rtol=1e-6)


def test_layers_are_bounded_and_what_is_no_number_in_them_is_sanitized_and_counted(rng):
    """The largest number in every layer: eight of it are more than float32 has."""
    core = core_of(
        lambda params, state, frame, first, statistics: (state, frame.radiance, 0), samples=lambda *given: 7.0 * ONES
    )
    clip = layered(rng, count=1)
    bright = {n: layer.at[0, 0, 0].set(3e38).at[0, 0, 1].set(np.nan) for n, layer in clip.layers.items()}
    one = stream(recurrent(core), {})
    image = one(frame_at(clip.frames, 0), {n: layer[0] for n, layer in bright.items()})
    np.testing.assert_array_equal(image[0, 0], RADIANCE_MAX)
    np.testing.assert_array_equal(image[0, 1], 0)
    assert one.sanitized >= 3  # the mean of the largest may be larger by a rounding


@pytest.mark.parametrize("rematerialize", [False, True])
def test_gradients_through_a_denoiser_that_requests_samples_are_finite(rematerialize, rng):
    denoiser, clip = adaptive(), layered(rng)
    params = denoiser.init(jax.random.key(0), frame_at(clip.frames, 0))

    def loss(params):
        return jnp.sum(unroll(denoiser, params, clip.frames, clip.layers, rematerialize=rematerialize))

    slope = jax.jit(jax.grad(loss))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    ahead, behind = (loss({**params, "gain": params["gain"] + step}) for step in (0.01, -0.01))
    np.testing.assert_allclose(slope["gain"], (ahead - behind) / 0.02, rtol=1e-3)
    assert slope["most"] == 0  # the number of samples is rounded, and from_layers says so with a gradient of 0


def test_a_request_without_layers_raises(rng):
    denoiser, clip = adaptive(), layered(rng)
    frame = frame_at(clip.frames, 0)
    params = denoiser.init(jax.random.key(0), frame)
    with pytest.raises(ValueError, match="layers: expected independent noisy layers"):
        denoise(denoiser, params, clip._replace(layers=None))
    with pytest.raises(ValueError, match="layers: expected independent noisy layers"):
        unroll(denoiser, params, clip.frames)
    with pytest.raises(ValueError, match="layers: expected independent noisy layers"):
        stream(denoiser, params)(frame)


def test_layers_without_a_request_leave_no_operation(rng):
    clip = layered(rng)
    denoiser = recurrent(identity())
    assert denoiser.samples is None
    with_layers, without = (
        jax.jit(lambda clip: denoise(denoiser, {}, clip)).lower(each).as_text()
        for each in (clip, clip._replace(layers=None))
    )
    assert with_layers.count("\n") == without.count("\n")
    one = stream(denoiser, {})
    layers = {samples: layer[0] for samples, layer in clip.layers.items()}
    np.testing.assert_array_equal(one(frame_at(clip.frames, 0), layers), clip.frames.radiance[0])
