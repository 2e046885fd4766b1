"""``reblur``: what must hold for any filter of its kind, discs that shrink, reflections that are followed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.frame import FAR, Frame
from jaxdn.methods.reblur import reblur
from tests.methods.test_relax import HEIGHT, WIDTH, compiled, mirror_frames, neutral, run, scene

pytestmark = pytest.mark.usefixtures("plain_programs")

DENOISER = reblur(pre_radius=3.0, radius=3.0, anti_firefly=True)
PLAIN = {
    "pre_radius": 0.0,
    "radius": 0.0,
    "stable_max": 1,
    "fix_frames": 0,
    "clamp_sigma": 1e6,
    "lag_sigma": 1e6,
    "demodulate": "none",
}
"""Nothing but running means."""
MEANS = reblur(**PLAIN)


def stepped(state, frame):
    return compiled(DENOISER)({}, state, frame)


def test_a_constant_image_stays_with_all_of_its_border(rng):
    frames = [
        frame._replace(
            radiance=np.full_like(frame.radiance, 0.37),
            specular=np.full_like(frame.specular, 0.12),
            **{name: np.full_like(getattr(frame, name), 0.4) for name in ("reflectance", "albedo")},
            specular_reflectance=np.full_like(frame.specular_reflectance, 0.1),
        )
        for frame in scene(rng, 4)
    ]
    for image in run(DENOISER, frames)[1]:
        np.testing.assert_allclose(image, 0.37, rtol=2e-5)


def test_static_histories_are_the_means_until_their_caps(rng):
    denoiser = reblur(**PLAIN, history_max=10, fast_max=3)
    noise = rng.gamma(0.5, 1.0, (14, 60, 60, 3)).astype(np.float32)
    share = rng.random((14, 60, 60, 1)).astype(np.float32)
    step, state = jax.jit(denoiser.step), denoiser.start({}, Frame(noise[0], specular=noise[0] * share[0]))
    spread = []
    for index, (radiance, part) in enumerate(zip(noise, share, strict=True)):
        state, image = step({}, state, Frame(radiance, specular=radiance * part))
        seen, shares = noise[: index + 1].astype(np.float64), share[: index + 1]
        history = np.asarray(state.core.light.diffuse), np.asarray(state.core.light.specular)
        for found, lights in zip(history, (seen * (1 - shares), seen * shares), strict=True):
            np.testing.assert_array_equal(found[..., 3], min(index + 1, 10))
            if index < 10:
                np.testing.assert_allclose(found[..., :3], lights.mean(0), rtol=2e-4, atol=1e-6)
            if index < 3:
                np.testing.assert_allclose(found[..., 4:7], lights.mean(0), rtol=2e-4, atol=1e-6)
        spread.append(np.var(image))
    single = np.var(noise)
    np.testing.assert_allclose(np.array(spread[:10]) * np.arange(1, 11), single, rtol=0.1)
    # From the cap on, a mean with the weight 1/N tends to a variance of 1 / (2 N - 1).
    assert single / 19 * 0.9 < spread[-1] < single / 10 * 1.1


def test_by_default_the_error_of_a_static_scene_falls(rng):
    noise = rng.gamma(0.5, 2.0, (24, 24, 24, 3)).astype(np.float32)
    _, images = run(reblur(), [Frame(each) for each in noise])
    errors = [np.mean((image - 1.0) ** 2) for image in images]
    assert np.mean(errors[20:]) < np.mean(errors[6:10]) < np.mean(errors[:3]) < np.var(noise) / 20


def test_light_that_doubles_arrives_within_the_slow_historys_length(rng):
    """Within 5 %; a running mean of 30 frames alone takes 89."""
    light = rng.gamma(4.0, 0.25, (60, 24, 24, 3)).astype(np.float32)
    light[30:] *= 2.0
    means = [image.mean() for image in run(reblur(), [Frame(each) for each in light])[1]]
    assert abs(means[29] - 1.0) < 0.05
    assert abs(means[55] - 2.0) < 0.1


def test_the_first_frame_is_blurred_most_and_near_light_least(rng):
    """The sharpness of an edge of light: it is blurred less with a longer history and with a nearer occluder."""
    light = np.where(np.arange(40) < 20, 1.0, 2.0)[None, :, None] * np.ones((40, 1, 3))
    depth = np.full((40, 40, 1), 5.0, np.float32)

    def slope(hit_distance, count):
        frames = [
            Frame(light.astype(np.float32), depth=depth, hit_distance=np.full_like(depth, hit_distance))
            for _ in range(count)
        ]
        image = run(reblur(pre_radius=0.0, radius=8.0, fix_frames=0, stable_max=1), frames)[1][-1]
        return np.mean(image[8:-8, 20] - image[8:-8, 19])

    assert slope(5.0, 1) < 0.5 * slope(0.05, 1)
    np.testing.assert_allclose(slope(5.0, 1), slope(0.0, 1), rtol=1e-4)  # unknown counts as far


@pytest.mark.parametrize("missing", [(), ("far_motion",), ("specular_hit_distance",), ("roughness",)])
def test_a_reflection_is_fetched_where_it_was(rng, missing):
    sky, frames = mirror_frames(rng)
    frames = [frame._replace(**dict.fromkeys(missing)) for frame in frames]
    state, _ = run(MEANS, frames)
    inner = np.asarray(state.core.light.specular)[4:-4, 4:-8]
    error = np.mean((inner[..., :3] - sky[4:-4, 4:-8]) ** 2) / np.mean(sky**2)
    if missing:
        assert error > 0.1
    else:
        np.testing.assert_allclose(inner[..., 3], len(frames), rtol=1e-3)
        assert error < 0.06  # a single frame has 0.5, a mean of twelve 0.042


def test_a_mirror_is_not_blurred(rng):
    _, frames = mirror_frames(rng, 1)
    _, images = run(reblur(), frames)
    np.testing.assert_allclose(images[0], frames[0].radiance, rtol=2e-5)


def test_the_first_frame_reads_no_history_and_no_motion(rng):
    frame = scene(rng, 1)[0]
    clean = DENOISER.start({}, frame)
    light = jax.tree.map(lambda leaf: leaf * np.nan, clean.core.light)
    poisoned = clean._replace(core=clean.core._replace(light=light, frame=clean.core.frame + 5))
    elsewhere = frame._replace(motion=np.full_like(frame.motion, 3.3))
    expected_state, expected = stepped(clean, frame)
    for state, given in ((poisoned, frame), (clean, elsewhere)):
        after, image = stepped(state, given)
        np.testing.assert_array_equal(image, expected)
        np.testing.assert_array_equal(after.core.light.specular, expected_state.core.light.specular)


@pytest.mark.parametrize("which", ["diffuse", "specular"])
def test_broken_history_is_dropped_where_it_is_broken(rng, which):
    frames = scene(rng, 2)
    state, _ = stepped(DENOISER.start({}, frames[0]), frames[0])
    light = state.core.light._replace(**{which: getattr(state.core.light, which).at[6, 4, 1].set(np.nan)})
    after, image = stepped(state._replace(core=state.core._replace(light=light)), frames[1])
    assert np.isfinite(image).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.core))
    assert int(after.repaired) > int(stepped(state, frames[1])[0].repaired)


@pytest.mark.parametrize(
    "names",
    [
        ("specular",),
        ("specular_hit_distance", "hit_distance"),
        ("far_motion",),
        ("roughness",),
        ("motion", "far_motion", "previous_depth"),
        ("ray_length", "reflectance", "albedo", "specular_reflectance"),
    ],
    ids="-".join,
)
def test_none_is_the_neutral_value_written_out(rng, names):
    frames = scene(rng, 3)
    absent = [frame._replace(**dict.fromkeys(names)) for frame in frames]
    written = [neutral(frame, names) for frame in frames]
    for first, second in zip(run(DENOISER, absent)[1], run(DENOISER, written)[1], strict=True):
        np.testing.assert_allclose(first, second, rtol=2e-5, atol=1e-6)


def test_specular_light_may_come_and_go_within_a_clip(rng):
    frames = scene(rng, 4)
    frames[0] = frames[0]._replace(specular=None)
    frames[2] = frames[2]._replace(specular=None)
    state, images = run(DENOISER, frames)
    assert all(np.isfinite(image).all() for image in images)
    assert np.isfinite(state.core.light.specular).all()


def test_pixels_without_a_surface_pass_through(rng):
    frame = scene(rng, 1)[0]
    np.testing.assert_array_equal(run(DENOISER, [frame])[1][0][0], frame.radiance[0])
    sky = frame._replace(depth=np.full_like(frame.depth, FAR), ids=np.full_like(frame.ids, -1))
    np.testing.assert_array_equal(run(DENOISER, [sky])[1][0], frame.radiance)


def test_gradients_reach_both_kinds_of_light(x64, rng):
    frames = scene(rng, 2, np.float64)
    weights = np.cos(np.arange(HEIGHT * WIDTH * 3)).reshape(HEIGHT, WIDTH, 3)

    def loss(radiance, part):
        state = DENOISER.start({}, frames[0])
        for frame in frames:
            lit = frame._replace(radiance=frame.radiance + radiance, specular=(frame.radiance + radiance) * part)
            state, image = DENOISER.step({}, state, lit)
        return jnp.mean(image * weights)

    both = jax.jit(jax.value_and_grad(loss, (0, 1)))
    zero, half = np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH, 1), 0.4)
    found = both(zero, half)[1]
    for each in found:
        assert each.dtype == np.float64
        assert np.isfinite(each).all()
        assert np.abs(each).max() > 1e-6
    direction = rng.normal(size=zero.shape) * 1e-6
    slope = (both(direction, half)[0] - both(-direction, half)[0]) / 2
    np.testing.assert_allclose(np.sum(found[0] * direction), slope, rtol=2e-2)


@pytest.mark.parametrize(
    ("options", "word"),
    [({"radius": -1.0}, "radius"), ({"stable_max": 0}, "stable_max"), ({"fast_max": 0}, "fast_max")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        reblur(**options)
