"""Streams: the images of the whole clip frame by frame, one program per set of buffers, and the sanitized values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Clip, Frame, frame_at
from jaxdn.denoiser import Core, Denoiser, recurrent
from jaxdn.denoiser.rollout import denoise, stream
from jaxdn.denoisers import ntd, svgf
from tests.hard_cases.inputs import good
from tests.methods.test_ntd import TINY

COUNT = 4
METHODS = {"svgf": lambda: svgf(levels=2), "ntd": lambda: ntd(size=TINY)}


@pytest.fixture(scope="module")
def clip():
    """A wall with a square that moves over it, with every buffer."""
    return good(frames=COUNT).clip._replace(reference=None)


@pytest.fixture(scope="module", params=METHODS)
def method(request, clip):
    """A denoiser, its parameters, and the images of the whole clip by one scan."""
    denoiser = METHODS[request.param]()
    params = denoiser.init(jax.random.key(0), frame_at(clip.frames, 0))
    images = jax.jit(lambda params, clip: denoise(denoiser, params, clip))(params, clip)
    return denoiser, params, np.asarray(images)


def frames_of(clip, numbers=np):
    return [jax.tree.map(lambda buffer, i=i: numbers.asarray(buffer[i]), clip.frames) for i in range(COUNT)]


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [np, jnp])
def test_a_stream_gives_the_images_of_the_whole_clip(method, clip, numbers):
    denoiser, params, expected = method
    one = stream(denoiser, params)
    images = [one(frame) for frame in frames_of(clip, numbers)]
    # Compared at the end: a state that reuses the memory of an image would have overwritten it by now.
    for image, wanted in zip(images, expected, strict=True):
        np.testing.assert_allclose(image, wanted, rtol=2e-4, atol=1e-5)
    assert one.programs == {tuple(name for name in Frame._fields[1:] if name in denoiser.reads)}
    assert one.sanitized == 0


def test_every_stream_starts_without_history_and_keeps_its_arguments_unchanged(method, clip):
    denoiser, params, expected = method
    frames = frames_of(clip, jnp)
    before = jax.tree.map(np.array, (params, frames))
    for _ in range(2):
        images = list(stream(denoiser, params).each(frames))
        np.testing.assert_allclose(images, expected, rtol=2e-4, atol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, (params, frames), before)


def test_each_takes_a_frame_when_its_image_is_requested(method, clip):
    denoiser, params, expected = method
    taken = []

    def source():
        for index, frame in enumerate(frames_of(clip)):
            taken.append(index)
            yield frame

    images = stream(denoiser, params).each(source())
    assert taken == []
    np.testing.assert_allclose(next(images), expected[0], rtol=2e-4, atol=1e-5)
    assert taken == [0]
    assert len(list(images)) == COUNT - 1


def test_a_program_is_compiled_for_each_set_of_buffers_that_is_read(clip):
    """Only buffers that are read make a set; a repeated set is compiled once."""
    traced = []

    def step(params, state, frame, first, statistics):
        traced.append(frame)
        return state, frame.radiance, 0

    one = stream(recurrent(Core(lambda p, f: jnp.zeros(()), step, frozenset({"motion", "albedo"}))), {})
    whole = frames_of(clip)[0]
    bare = Frame(whole.radiance)
    sets = [whole, bare, whole._replace(depth=None), bare._replace(motion=whole.motion), whole, bare]
    for frame in sets:
        one(frame)
    assert one.programs == {("albedo", "motion"), (), ("motion",)}
    assert len(traced) == len(one.programs)


@pytest.mark.slow
def test_buffers_that_come_and_go_are_their_neutral_values(method, clip):
    """Frames without vectors among frames with them, as a renderer writes them where nothing moves."""
    denoiser, params, _ = method
    still = jax.tree.map(lambda buffer: buffer, clip.frames)
    vectors = np.array(still.motion)
    vectors[2] = 0
    still = still._replace(motion=vectors, dual_motion=vectors, previous_depth=still.depth)
    written = [frame_at(still, index) for index in range(COUNT)]
    absent = [
        frame._replace(motion=None, dual_motion=None, previous_depth=None) if index == 2 else frame
        for index, frame in enumerate(written)
    ]
    one, other = stream(denoiser, params), stream(denoiser, params)
    for first, second in zip(written, absent, strict=True):
        np.testing.assert_allclose(other(second), one(first), rtol=2e-4, atol=1e-5)
    assert len(one.programs) == 1
    assert len(other.programs) == 2


def test_what_was_sanitized_is_counted_over_all_frames(method, clip):
    denoiser, params, _ = method
    one = stream(denoiser, params)
    assert one.sanitized == 0
    for count, frame in enumerate(frames_of(clip)):
        radiance = np.array(frame.radiance)
        radiance[3, 4] = np.nan
        radiance[5, 6, 0] = -1
        image = one(frame._replace(radiance=radiance))
        assert np.isfinite(image).all()
        assert one.sanitized == 4 * (count + 1)


def test_a_denoiser_without_a_count_has_sanitized_nothing(clip):
    def step(params, state, frame):
        return state + 1, frame.radiance * state

    bare = Denoiser(lambda key, frame: {}, lambda params, frame: jnp.zeros(()), step, frozenset())
    one = stream(bare, {})
    images = [one(frame) for frame in frames_of(clip)]
    assert one.sanitized == 0
    for index, image in enumerate(images):
        np.testing.assert_allclose(image, index * clip.frames.radiance[index], rtol=1e-6)


def test_a_clip_with_different_sizes_is_refused(method, clip):
    denoiser, params, _ = method
    shorter = clip._replace(frames=clip.frames._replace(albedo=clip.frames.albedo[:, 1:]))
    with pytest.raises(ValueError, match=r"clip\.frames\.albedo: expected \[T, H, W\]"):
        denoise(denoiser, params, shorter)
    with pytest.raises(ValueError, match=r"clip\.frames\.radiance"):
        denoise(denoiser, params, Clip(frame_at(clip.frames, 0)))


def test_a_state_may_be_what_was_given_and_hold_it_twice():
    """Its memory is used again, and that of frames and parameters is not."""

    def start(params, frame):
        return frame.radiance, frame.radiance, params["light"], jnp.zeros(()), jnp.zeros(())

    def step(params, state, frame):
        state = jax.tree.map(lambda x: x + 1, state)
        return state, state[0] + state[1] + params["light"]

    given = Frame(jnp.full((4, 4, 3), 0.5))
    params = {"light": jnp.full((4, 4, 3), 0.25)}
    one = stream(Denoiser(lambda key, frame: params, start, step, frozenset()), params)
    images = [np.asarray(one(given)) for _ in range(3)]
    np.testing.assert_array_equal([image[0, 0, 0] for image in images], [3.25, 5.25, 7.25])
    np.testing.assert_array_equal(given.radiance, 0.5)
    np.testing.assert_array_equal(params["light"], 0.25)


def test_the_first_frame_takes_two_programs(clip):
    """Each has to be traced, and compiled or loaded, before there is an image."""
    names = []

    def note(event, duration_secs, **about):
        if event.endswith("backend_compile_duration"):
            names.append(about.get("fun_name", ""))

    def step(params, state, frame):
        return state + frame.radiance, state

    bare = Denoiser(lambda key, frame: {}, lambda params, frame: 0 * frame.radiance, step, frozenset())
    frame = frames_of(clip)[0]
    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        image = stream(bare, {})(frame)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    np.testing.assert_array_equal(image, 0)
    assert len(names) == 2, names
