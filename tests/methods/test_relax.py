"""``relax``: what must hold for any filter of its kind, reflections that are followed, light that changes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.frame import FAR, Frame
from jaxdn.methods.lobes import apart
from jaxdn.methods.relax import relax

pytestmark = pytest.mark.usefixtures("plain_programs")

HEIGHT, WIDTH = 12, 14
DENOISER, DEFAULT = relax(levels=1, anti_firefly=True), relax()
PLAIN = {
    "fix_frames": 0,
    "clamp_sigma": 1e6,
    "lag_sigma": 1e6,
    "anti_firefly": False,
    "short_history": 0,
    "levels": 0,
    "demodulate": "none",
}
"""Nothing but running means."""
MEANS = relax(**PLAIN)


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


@functools.cache
def compiled(denoiser):
    """Its step: compiled once for each set of buffers."""
    return jax.jit(denoiser.step)


def stepped(params, state, frame):
    return compiled(DENOISER)(params, state, frame)


def run(denoiser, frames):
    step, state, images = compiled(denoiser), denoiser.start({}, frames[0]), []
    for frame in frames:
        state, image = step({}, state, frame)
        images.append(np.asarray(image))
    return state, images


def test_metal_darkens_no_diffuse_neighbour():
    """It has no diffuse light, and no diffuse texture either: all that is seen there is reflected by another lobe."""
    metal = np.zeros((1, 8, 1), bool)
    metal[:, 4:] = True
    light = np.full((1, 8, 3), 0.4, np.float32)
    frame = Frame(
        light,
        reflectance=np.full_like(light, 0.8),
        specular_reflectance=np.where(metal, light * 2, 0.0),
        specular=np.where(metal, light, 0.0),
    )
    diffuse, _ = apart(frame, "brdf")
    np.testing.assert_allclose(diffuse.texture[:, 0, 4:], 0.0, atol=1e-6)
    np.testing.assert_allclose(diffuse.texture[:, 0, :4], 1.0, rtol=1e-3)  # the divisor is a soft maximum
    # Giving back divides by one too, at each of eight averages.
    np.testing.assert_allclose(relax().step({}, relax().start({}, frame), frame)[1][0, :4], 0.4, rtol=0.01)


@pytest.mark.parametrize("by", ["brdf", "albedo", "none"])
def test_both_kinds_of_light_add_up(rng, by):
    frame = scene(rng, 1)[0]
    diffuse, specular = apart(frame, by)
    np.testing.assert_allclose(diffuse.whole(diffuse.light) + specular.whole(specular.light), frame.radiance, rtol=1e-6)
    np.testing.assert_allclose(specular.whole(specular.light), frame.specular, rtol=1e-6)


def test_specular_light_beyond_all_light_is_cut_off(rng):
    frame = scene(rng, 1)[0]
    diffuse, specular = apart(frame._replace(specular=2 * frame.radiance + 1), "none")
    assert not np.any(diffuse.light)
    np.testing.assert_array_equal(specular.light.transpose(1, 2, 0), frame.radiance)


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


@pytest.mark.parametrize("levels", [2, 0])
def test_colours_of_a_texture_do_not_run(rng, levels):
    """Even light of both kinds on surfaces that hardly reflect some colours, from the first frame on."""
    squares = np.float32([[0.26, 0.002, 0.36], [0.8, 0.8, 0.8], [0.5, 0.01, 0.02], [0.4, 0.6, 0.5]])
    number = np.indices((HEIGHT, WIDTH)).sum(0) % 4
    albedo, part = squares[number], 0.2 * squares[3 - number]
    light = {"radiance": 0.4 * albedo + 0.9 * part, "specular": 0.9 * part}
    frame = Frame(**light, albedo=albedo, reflectance=albedo + part, specular_reflectance=part)
    for image in run(relax(levels=levels), [frame] * 3)[1]:
        np.testing.assert_allclose(image, frame.radiance, atol=0.01)


def test_static_histories_are_the_means_until_their_caps(rng):
    denoiser = relax(**PLAIN, history_max=10, fast_max=3)
    noise = rng.gamma(0.5, 1.0, (14, 60, 60, 3)).astype(np.float32)
    share = rng.random((14, 60, 60, 1)).astype(np.float32)
    step, state = jax.jit(denoiser.step), denoiser.start({}, Frame(noise[0], specular=noise[0] * share[0]))
    spread = []
    for index, (radiance, part) in enumerate(zip(noise, share, strict=True)):
        state, image = step({}, state, Frame(radiance, specular=radiance * part))
        seen, shares = noise[: index + 1].astype(np.float64), share[: index + 1]
        history = np.asarray(state.core.diffuse), np.asarray(state.core.specular)
        for found, lights in zip(history, (seen * (1 - shares), seen * shares), strict=True):
            np.testing.assert_array_equal(found[..., 5], min(index + 1, 10))
            if index < 10:
                np.testing.assert_allclose(found[..., :3], lights.mean(0), rtol=2e-4, atol=1e-6)
            if index < 3:
                np.testing.assert_allclose(found[..., 6:9], lights.mean(0), rtol=2e-4, atol=1e-6)
        spread.append(np.var(image))
    single = np.var(noise)
    np.testing.assert_allclose(np.array(spread[:10]) * np.arange(1, 11), single, rtol=0.1)
    # From the cap on, a mean with the weight 1/N tends to a variance of 1 / (2 N - 1).
    assert single / 19 * 0.9 < spread[-1] < single / 10 * 1.1


def test_by_default_the_error_of_a_static_scene_falls(rng):
    noise = rng.gamma(0.5, 2.0, (24, 24, 24, 3)).astype(np.float32)
    _, images = run(DEFAULT, [Frame(each) for each in noise])
    errors = [np.mean((image - 1.0) ** 2) for image in images]
    assert np.mean(errors[20:]) < np.mean(errors[6:10]) < np.mean(errors[:3]) < np.var(noise) / 20


def test_light_that_doubles_arrives_within_the_slow_historys_length(rng):
    """Within 5 %. A running mean of 30 frames alone takes 89; the fast one of 6 frames 17."""
    light = rng.gamma(4.0, 0.25, (60, 24, 24, 3)).astype(np.float32)
    light[30:] *= 2.0

    def frames_late(denoiser):
        means = [image.mean() for image in run(denoiser, [Frame(each) for each in light])[1]]
        return next((index for index in range(30, 60) if abs(means[index] - 2.0) < 0.1), 60) - 30

    assert frames_late(DEFAULT) <= 25
    assert frames_late(MEANS) == 30


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


@pytest.mark.parametrize("missing", [(), ("far_motion",), ("specular_hit_distance",), ("roughness",)])
def test_a_reflection_is_fetched_where_it_was(rng, missing):
    sky, frames = mirror_frames(rng)
    frames = [frame._replace(**dict.fromkeys(missing)) for frame in frames]
    state, _ = run(MEANS, frames)
    inner = np.asarray(state.core.specular)[4:-4, 4:-8]
    error = np.mean((inner[..., :3] - sky[4:-4, 4:-8]) ** 2) / np.mean(sky**2)
    if missing:
        assert error > 0.1
    else:
        np.testing.assert_allclose(inner[..., 5], len(frames), rtol=1e-3)
        assert error < 0.06  # a single frame has 0.5, a mean of twelve 0.042


def test_a_reflection_that_is_another_has_no_history(rng):
    _, frames = mirror_frames(rng, 4)
    # Nearer: at a closeness of 0.3, its virtual image moves by 0.9 px and the surface by 3.
    frames[3] = frames[3]._replace(specular_hit_distance=np.full_like(frames[3].specular_hit_distance, 11.7))
    state, _ = run(MEANS, frames)
    assert np.asarray(state.core.specular)[..., 5].max() < 1.5


def test_the_first_frame_reads_no_history_and_no_motion(rng):
    frame = scene(rng, 1)[0]
    clean = DENOISER.start({}, frame)
    poisoned = clean._replace(core=jax.tree.map(lambda leaf: leaf * np.nan, clean.core))
    elsewhere = frame._replace(motion=np.full_like(frame.motion, 3.3))
    expected_state, expected = stepped({}, clean, frame)
    for state, given in ((poisoned, frame), (clean, elsewhere)):
        after, image = stepped({}, state, given)
        np.testing.assert_array_equal(image, expected)
        np.testing.assert_array_equal(after.core.specular, expected_state.core.specular)


@pytest.mark.parametrize("which", ["diffuse", "specular"])
def test_broken_history_is_dropped_where_it_is_broken(rng, which):
    frames = scene(rng, 2)
    state, _ = stepped({}, DENOISER.start({}, frames[0]), frames[0])
    broken = state._replace(core=state.core._replace(**{which: getattr(state.core, which).at[6, 4, 1].set(np.nan)}))
    after, image = stepped({}, broken, frames[1])
    assert np.isfinite(image).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.core))
    assert int(after.repaired) > int(stepped({}, state, frames[1])[0].repaired)


def neutral(frame, names):
    """The neutral values of absent buffers, written out, of those that a method reads."""
    from jaxdn.frame import written_out

    return written_out(frame._replace(**dict.fromkeys(names)), names)


@pytest.mark.parametrize(
    "names",
    [
        ("specular",),
        ("specular_hit_distance",),
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
    assert np.isfinite(state.core.specular).all()


def test_pixels_without_a_surface_pass_through(rng):
    frame = scene(rng, 1)[0]
    _, images = run(DENOISER, [frame])
    np.testing.assert_array_equal(images[0][0], frame.radiance[0])


def test_gradients_reach_both_kinds_of_light(x64, rng):
    frames = scene(rng, 2, np.float64)

    def loss(radiance, part):
        state = DENOISER.start({}, frames[0])
        for frame in frames:
            lit = frame._replace(radiance=frame.radiance + radiance, specular=(frame.radiance + radiance) * part)
            state, image = DENOISER.step({}, state, lit)
        return jnp.mean(image * jnp.asarray(rng_weights))

    rng_weights = np.cos(np.arange(HEIGHT * WIDTH * 3)).reshape(HEIGHT, WIDTH, 3)
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
    [({"fast_max": 0}, "fast_max"), ({"fix_frames": 9}, "fix_frames"), ({"demodulate": "colour"}, "demodulate")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        relax(**options)
