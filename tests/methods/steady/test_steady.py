"""``steady``: what it promises before it has learnt anything, and that it can learn."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import FAR, Frame, frame_at
from jaxdn.denoiser import Denoiser
from jaxdn.denoiser.rollout import unroll
from jaxdn.methods.steady.levels import LEVELS
from jaxdn.methods.steady.method import FEATURES, HALF_FEATURES, INITIAL, split_heads, steady
from jaxdn.ops.sampling import allot_evenly
from jaxdn.ops.scales import space_to_depth
from tests.gradients import check_gradients
from tests.methods.steady.short import TINY, short_steady

SIZE = (24, 40)
"""Not a multiple of what the network works on."""


def tiny(**options: Any) -> Denoiser:
    return steady(quality=TINY, **options)


def room(rng, count=3, *, size=SIZE):
    """A floor that recedes and a textured box before it, all buffers, a camera that stands still."""
    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
    box = (abs(rows - 12) < 6) & (abs(columns - 20) < 8)
    albedo = np.where(box[..., None], 0.2 + 0.6 * (columns[..., None] % 2), np.float32([0.7, 0.5, 0.3]))
    frame = Frame(
        radiance=np.ones((*size, 3), np.float32),
        albedo=albedo.astype(np.float32),
        normal=np.where(box[..., None], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]).astype(np.float32),
        depth=np.where(box, 2.0, 90 / (rows + 10))[..., None].astype(np.float32),
        motion=np.zeros((*size, 2), np.float32),
        ids=box.astype(np.int32)[..., None],
    )
    clip = jax.tree.map(lambda each: np.broadcast_to(each, (count, *each.shape)), frame)
    light = rng.exponential(size=(count, *size, 1)).astype(np.float32)
    return jax.tree.map(jnp.asarray, clip._replace(radiance=light * clip.albedo))


def denoised(frames, *, key=None, sharper=0.0):
    """With the same decisions for all pixels, or (``key``) with random ones; guides that stop the filter more."""
    init, vary, run = compiled()
    params = init(jax.random.key(0), frame_at(frames, 0))
    # Not the scales of the regression, which stop nothing.
    sharpened = {name: value + sharper for name, value in params["guide"].items() if name != "regression"}
    params["guide"] = params["guide"] | sharpened
    if key is None:
        params["head_0"]["kernel"] = 0.0 * params["head_0"]["kernel"]
    else:
        params = vary(params, key)
    # Not of a weak type, as numbers without a type make them: else there are two programs.
    return np.asarray(run(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params), frames))


@functools.cache
def compiled():
    """A small denoiser's first params, those varied by a key, and its images.

    Each is compiled once for each number of frames and buffers.
    """
    denoiser = tiny()

    def vary(params, key):
        return jax.tree.map(lambda leaf: leaf + 0.3 * jax.random.normal(key, leaf.shape), params)

    return jax.jit(denoiser.init), jax.jit(vary), jax.jit(functools.partial(unroll, denoiser))


@pytest.mark.slow
def test_constant_light_comes_out_as_it_went_in(rng, key):
    frames = room(rng)
    flat = frames._replace(radiance=jnp.full_like(frames.radiance, 0.5), albedo=jnp.ones_like(frames.albedo))
    np.testing.assert_allclose(denoised(flat, key=key), flat.radiance, rtol=1e-4)


@pytest.mark.slow
def test_noise_falls_within_a_frame_and_with_every_further_one(rng):
    # Of a smaller image, a filter leaves one cloud of noise, which looks like a change of light.
    frames = room(rng, 8, size=(96, 160))
    error = denoised(frames) / frames.albedo - 1.0
    spread = np.sqrt(np.mean(np.square(error), axis=(1, 2, 3)))
    assert spread[0] < 0.1  # of 1 in the noisy frame
    assert spread[7] < 0.6 * spread[0]


@pytest.mark.parametrize("gain", [1 / 64, 64.0])
def test_brighter_light_gives_the_same_picture(gain, rng, key):
    frames = room(rng)
    plain, bright = denoised(frames, key=key), denoised(frames._replace(radiance=gain * frames.radiance), key=key)
    assert np.mean(np.abs(bright / gain - plain)) < 0.01 * np.mean(plain)


def test_textures_and_silhouettes_stay(rng):
    """Light that differs between two surfaces: neither takes from the other."""
    frames = room(rng)
    box = frames.ids == 1
    lit = frames._replace(radiance=jnp.where(box, 2.0, 0.5) * frames.albedo)
    error = np.abs(denoised(lit, sharper=3.0) / np.asarray(lit.radiance) - 1.0)
    assert error.max() < 0.01


def test_colours_of_a_texture_do_not_run(rng, key):
    """Even light on a checkerboard of purple, white and red: green does not flow from white to purple."""
    squares = np.float32([[0.26, 0.002, 0.36], [0.8, 0.8, 0.8], [0.5, 0.01, 0.02], [0.4, 0.6, 0.5]])
    albedo = jnp.asarray(np.broadcast_to(squares[np.indices(SIZE).sum(0) % 4], (3, *SIZE, 3)))
    frames = Frame(radiance=0.4 * albedo, albedo=albedo, reflectance=albedo + 1e-4)
    np.testing.assert_allclose(denoised(frames, key=key), frames.radiance, atol=0.01)


def test_the_sky_passes_through_and_gives_nothing(rng, key):
    frames = room(rng)
    sky = jnp.arange(SIZE[1])[None, None, :, None] < 12
    frames = frames._replace(
        radiance=jnp.where(sky, 1000.0, jnp.full_like(frames.radiance, 0.5)),
        depth=jnp.where(sky, FAR, frames.depth),
        albedo=jnp.ones_like(frames.albedo),
        ids=jnp.where(sky, -1, frames.ids),
    )
    np.testing.assert_allclose(denoised(frames, key=key), frames.radiance, rtol=1e-4)


@pytest.mark.slow
def test_a_firefly_leaves_no_speck_and_a_lamp_of_one_pixel_stays(rng):
    """On surfaces of their own, where nothing is alike to share their light with; the lamp shines in all frames."""
    frames = room(rng, 4)
    firefly, lamp = (2, 8), (20, 30)
    normal = frames.normal.at[:, *firefly].set(jnp.asarray([1.0, 0.0, 0.0])).at[:, *lamp].set(jnp.asarray([1.0, 0, 0]))
    light = jnp.ones_like(frames.radiance).at[2, *firefly].set(1000.0).at[:, *lamp].set(1000.0)
    frames = frames._replace(radiance=light, normal=normal, albedo=jnp.ones_like(frames.albedo))
    images = denoised(frames, sharper=6.0)
    assert np.all(images[2][firefly] < 1.2)
    assert np.all(images[0][lamp] < 1.2), "in a single frame nothing tells it from a firefly"
    assert np.all(images[1:, *lamp] > 400)


@pytest.mark.parametrize("gain", [0.5, 3.0])
def test_a_change_of_light_is_seen_in_the_frame_it_happens_in(gain, rng):
    """After seven frames the newest has an eighth of the weight; light that changes evenly does not wait for more."""
    frames = room(rng, 8, size=(96, 160))
    frames = frames._replace(radiance=frames.radiance.at[7].multiply(gain))
    before, after = (float(jnp.median(image / frames.albedo[0])) for image in denoised(frames)[6:])
    assert before == pytest.approx(1.0, rel=0.02)
    assert after == pytest.approx(gain, rel=0.2)


@pytest.mark.parametrize("invalid", [np.nan, np.inf])
@pytest.mark.parametrize("gain", [0.01, 1.0, 100.0])
def test_a_frame_without_a_valid_value_shows_what_was_known(gain, invalid, rng):
    """No light is no measurement: it is not taken for lamps that were switched off."""
    frames = room(rng, 8, size=(96, 160))
    frames = frames._replace(radiance=gain * frames.radiance)
    frames = frames._replace(radiance=frames.radiance.at[6].set(invalid))
    images = denoised(frames) / gain
    before, lost, after = (float(jnp.median(image / frames.albedo[0])) for image in images[5:])
    assert lost == pytest.approx(before, rel=0.02)
    assert after == pytest.approx(before, rel=0.05)


def test_a_part_of_a_frame_without_a_valid_value_shows_what_was_known(rng):
    """A tile that was not rendered; the rest of the frame hardly differs."""
    frames = room(rng, 8, size=(96, 160))
    tile = np.s_[32:64, 64:128]
    whole = denoised(frames)[7]
    lost = denoised(frames._replace(radiance=frames.radiance.at[7, *tile].set(jnp.nan)))[7]
    assert np.median(lost[tile] / whole[tile]) == pytest.approx(1.0, rel=0.05)
    assert np.mean(np.abs(lost / whole - 1.0)) < 0.05


def test_invalid_pixels_of_the_first_frame_are_filled_from_their_neighbours(rng, key):
    frames = room(rng)
    invalid = jnp.asarray(rng.random((*SIZE, 1)) < 0.1)
    flat = frames._replace(radiance=jnp.full_like(frames.radiance, 0.5), albedo=jnp.ones_like(frames.albedo))
    broken = flat._replace(radiance=flat.radiance.at[0].set(jnp.where(invalid, jnp.nan, flat.radiance[0])))
    np.testing.assert_allclose(denoised(broken, key=key), flat.radiance, rtol=1e-4)


def test_a_sample_in_every_fourth_frame_counts_as_much_as_one_in_every_frame(rng):
    """Frames between, in which a pixel has none, do not make its mean surer, and do not darken its image."""
    denoiser, frame = tiny(demodulate="none"), frame_at(room(rng, 1), 0)
    params, state = denoiser.init(jax.random.key(0), frame), denoiser.start({}, frame)
    params["head_0"]["kernel"] = 0.0 * params["head_0"]["kernel"]
    step, numbers = jax.jit(denoiser.step), []
    for index in range(16):
        counts = allot_evenly(0.25, *SIZE, index)
        state, image = step(params, state, frame._replace(radiance=frame.radiance * counts, sample_count=counts))
        numbers.append(np.asarray(state.core.history[..., 4]))
    assert numbers[-1].min() > 3.0
    assert numbers[-1].max() < 4.3
    none = np.asarray(counts)[..., 0] == 0
    np.testing.assert_array_equal(numbers[-1][none], numbers[-2][none])
    assert float(jnp.mean((image / frame.albedo)[none])) > 0.8


@pytest.mark.slow
def test_a_moving_history_is_followed(rng):
    """A camera that pans along a wall of boards, each lit in its own way: all stay in their place."""
    frames = room(rng, 6)
    board = (np.arange(SIZE[1]) + np.arange(6)[:, None])[:, None, :, None] // 8
    facing = np.stack([np.cos(board), np.sin(board), 0.0 * board], axis=-1)[..., 0, :]
    light = jnp.asarray(np.where(board % 2, 2.0, 0.5), jnp.float32)
    moving = Frame(
        radiance=light * jnp.ones_like(frames.radiance),
        normal=jnp.broadcast_to(jnp.asarray(facing, jnp.float32), frames.radiance.shape),
        motion=jnp.broadcast_to(jnp.asarray([1.0, 0.0]), frames.motion.shape),
    )
    np.testing.assert_allclose(denoised(moving, sharper=3.0), moving.radiance, rtol=0.01)


@pytest.mark.slow
def test_broken_state_heals(rng):
    denoiser, frames = tiny(), room(rng, 3)
    params = compiled()[0](jax.random.key(0), frame_at(frames, 0))
    step = jax.jit(denoiser.step)
    state, _ = step(params, jax.jit(denoiser.start)(params, frame_at(frames, 0)), frame_at(frames, 0))
    state = jax.tree.map(lambda x: np.full_like(x, np.nan) if x.dtype == jnp.float32 else x, state)
    _, image = step(params, state, frame_at(frames, 1))
    assert np.isfinite(image).all()


@pytest.mark.slow
@pytest.mark.parametrize("absent", [("albedo", "motion"), ("normal", "depth", "ids")])
def test_an_absent_buffer_equals_its_neutral_value(absent, rng, key):
    frames = room(rng)
    image = denoised(frames._replace(**dict.fromkeys(absent)), key=key)
    assert np.isfinite(image).all()
    neutral = {"albedo": 1.0, "motion": 0.0, "normal": 0.0, "depth": 0.0, "ids": 0}
    explicit = {name: jnp.full_like(getattr(frames, name), neutral[name]) for name in absent}
    np.testing.assert_allclose(image, denoised(frames._replace(**explicit), key=key), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_the_share_of_the_newest_frame_hardly_knows_of_its_own_noise(rng):
    """Else bright samples count for more than dark ones, and the mean becomes too bright."""
    noise = rng.standard_normal((32, 32, 4))
    where = 4 * (FEATURES + list(INITIAL).index("accumulation"))
    head = np.zeros((32, 32, 4 * (FEATURES + len(INITIAL)) + HALF_FEATURES + 1 + LEVELS + 1))
    head[..., where : where + 4] = 2.0 * noise
    share = np.asarray(
        space_to_depth(split_heads(jnp.asarray(head, jnp.float32), (32, 32))[1]["accumulation"][..., None])
    )
    alone = np.mean(noise / (1.0 + np.exp(-2.0 * noise)))
    assert share.std() > 0.05
    assert 0.0 < np.mean(noise * share) < 0.2 * alone


@pytest.mark.slow
def test_every_weight_learns_through_time(rng, x64, monkeypatch):
    """And along a random direction of all weights the slope is that of central differences."""
    denoiser = short_steady(monkeypatch)
    frames = room(rng, 2, size=(32, 32))
    frames = frames._replace(
        motion=frames.motion + 0.3,
        **{name: getattr(frames, name).astype(jnp.float64) for name in ("radiance", "albedo", "normal", "depth")},
    )
    frames = frames._replace(reflectance=jnp.where(frames.ids == 1, 0.9, frames.albedo))  # the box shines
    params = denoiser.init(jax.random.key(0), frame_at(frames, 0))
    params = jax.tree.map(lambda x: x.astype(jnp.float64), params)
    noise = jax.random.normal(jax.random.key(1), frames.radiance.shape, jnp.float64)

    def loss(params):
        return jnp.sum(noise * unroll(denoiser, params, frames))

    (slopes,) = check_gradients(loss, (params,), rtol=1e-4, eps=1e-6)
    still = [jax.tree_util.keystr(path) for path, leaf in jax.tree.leaves_with_path(slopes) if not np.any(leaf)]
    assert still == []
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_every_quality_takes_fewer_operations_than_the_next(rng):
    """At a size where the border does not count."""
    frame = frame_at(room(rng, 1, size=(96, 160)), 0)

    def operations(quality):
        denoiser = steady(quality=quality)
        params = jax.eval_shape(denoiser.init, jax.random.key(0), frame)
        state = jax.eval_shape(denoiser.start, params, frame)
        return jax.jit(denoiser.step).lower(params, state, frame).cost_analysis()["flops"]

    fast, balanced, high = map(operations, ("fast", "balanced", "high"))
    assert fast < 0.5 * balanced
    assert balanced < 0.7 * high
    assert steady(quality="fast").receptive_field < steady(quality="balanced").receptive_field


def test_new_parameters_and_loaded_ones_share_a_program(key):
    """None of them is weakly typed, which would compile a second program."""
    params = jax.eval_shape(lambda: steady().init(key, Frame(jnp.ones((32, 32, 3)))))
    assert not [leaf for leaf in jax.tree.leaves(params) if leaf.weak_type]
