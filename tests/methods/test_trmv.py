"""``trmv``: svgf where it has nothing of its own to follow, and shadows and reflections that are followed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Frame, only, written_out
from jaxdn.denoiser.rollout import unroll
from jaxdn.methods.svgf import svgf
from jaxdn.methods.trmv import trmv
from tests.methods.lobe_scenes import check_light_and_options, compiled, run, starting
from tests.methods.test_svgf import HEIGHT, WIDTH, moving_frames

DENOISER = trmv(levels=2)
MEANS = {"levels": 0, "feedback_level": 0, "short_history": 0, "demodulate": "none"}
"""Nothing but running means."""
UNHELD = {**MEANS, "clamp_sigma": 1e6}
"""Nor is the share of shadows clamped."""
FETCHED, HELD = trmv(**UNHELD), trmv(**MEANS)
FILTERED = trmv(**(MEANS | {"levels": 2}))


def all_light(rng, count=3, dtype=np.float32):
    """The frames of svgf's tests with light in three parts and a vector for each."""
    frames = []
    for frame in moving_frames(rng, count, dtype):
        shape = (HEIGHT, WIDTH, 1)
        free = rng.gamma(2.0, 0.3, (HEIGHT, WIDTH, 3))
        lit = free * rng.integers(0, 2, shape)
        specular = rng.gamma(0.5, 0.4, (HEIGHT, WIDTH, 3)) * rng.integers(0, 2, shape)
        part = rng.uniform(0.05, 0.2, (HEIGHT, WIDTH, 3))
        vectors = {
            name: frame.motion + rng.choice([0.0, 1.3, -2.0], (HEIGHT, WIDTH, 2)) * rng.integers(0, 2, shape)
            for name in ("dual_motion", "shadow_motion", "glossy_motion")
        }
        more = vectors | {
            "radiance": frame.radiance + lit + specular,
            "specular": specular,
            "shadowed": lit,
            "unshadowed": free,
            "specular_reflectance": part,
            "reflectance": np.minimum(frame.albedo + part, 1.0),
            "roughness": rng.uniform(0, 1, shape),
        }
        frames.append(frame._replace(**{name: np.asarray(value, dtype) for name, value in more.items()}))
    return frames


# What it is without its own buffers.


@pytest.mark.slow
@pytest.mark.parametrize("by", ["brdf", "albedo", "none"])
def test_without_buffers_of_its_own_it_is_svgf(rng, by):
    frames = moving_frames(rng, 3)
    _, mine = run(trmv(levels=2, demodulate=by), frames)
    _, theirs = run(svgf(levels=2, demodulate=by), frames)
    for image, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(image, other, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        # Two at once where each is read by a part of light of its own: a step takes ten seconds to compile.
        ("shadowed", "unshadowed"),
        *(
            pytest.param(names, marks=pytest.mark.slow)
            for names in (
                ("specular", "specular_reflectance", "dual_motion"),
                ("unshadowed", "glossy_motion"),
                ("specular",),
                ("shadow_motion", "roughness"),
                ("motion", "dual_motion", "shadow_motion", "glossy_motion", "previous_depth"),
                ("albedo", "reflectance", "specular_reflectance"),
            )
        ),
    ],
    ids="-".join,
)
def test_none_is_the_neutral_value_written_out(rng, names):
    absent = [frame._replace(**dict.fromkeys(names)) for frame in all_light(rng)]
    written = [written_out(frame, names) for frame in absent]
    for first, second in zip(run(DENOISER, absent)[1], run(DENOISER, written)[1], strict=True):
        # Where specular light is 0 everywhere its lobe's weights differ; where no light is shadowed nothing does.
        np.testing.assert_allclose(first, second, rtol=5e-5, atol=2e-6)


@pytest.mark.slow
def test_no_buffer_has_to_be_there(rng):
    frames = all_light(rng)

    def shape_of(frame):
        return jax.eval_shape(lambda frame: DENOISER.step({}, DENOISER.start({}, frame), frame)[1], frame).shape

    # Two at once that have little to do with each other: a step takes half a second to trace.
    names = sorted(DENOISER.reads)
    for absent in (names[start::8] for start in range(8)):
        assert shape_of(frames[0]._replace(**dict.fromkeys(absent))) == (HEIGHT, WIDTH, 3), absent
    bare = [Frame(frame.radiance, shadowed=frame.shadowed, specular=frame.specular) for frame in frames]
    assert all(np.isfinite(image).all() for image in run(DENOISER, bare)[1])


# What must hold for any filter of its kind.


@pytest.mark.slow
def test_a_constant_image_stays_with_all_of_its_border(rng):
    frames = []
    for frame in all_light(rng, 4):
        level = {"radiance": 0.5, "shadowed": 0.1, "unshadowed": 0.2, "specular": 0.15, "reflectance": 0.4}
        level |= {"albedo": 0.3, "specular_reflectance": 0.1}
        frames.append(frame._replace(**{name: np.full_like(frame.radiance, value) for name, value in level.items()}))
    for image in run(DENOISER, frames)[1]:
        np.testing.assert_allclose(image, 0.5, rtol=2e-5)


@pytest.mark.slow
def test_the_variance_of_a_still_scene_falls_as_one_over_the_number_of_frames(rng):
    denoiser = trmv(**UNHELD, alpha=0.1)
    ones = np.ones((40, 40, 1), np.float32)
    frames, spread = [], []
    for _ in range(40):
        lit = (rng.random((40, 40, 1)) < 0.5) * ones * np.ones(3, np.float32)
        parts = [rng.gamma(0.5, 1.0, (40, 40, 3)).astype(np.float32) for _ in range(2)]
        light = {"shadowed": lit, "unshadowed": np.ones_like(lit), "specular": parts[0]}
        frames.append(Frame(lit + parts[0] + parts[1], depth=ones, roughness=0.5 * ones, **light))
    single = np.var(frames[0].radiance)
    state, images = run(denoiser, frames)
    spread = [np.var(image) / single for image in images]
    np.testing.assert_allclose(np.array(spread[:10]) * np.arange(1, 11), 1.0, rtol=0.12)
    # From then on the mean is exponential: alpha / (2 - alpha).
    assert spread[-1] == pytest.approx(0.1 / 1.9, rel=0.2)
    mean = np.mean([frame.radiance for frame in frames[:10]], axis=0)
    np.testing.assert_allclose(images[9], mean, rtol=1e-4)
    for history in (state.core.rest, state.core.shadows, state.core.specular):
        np.testing.assert_array_equal(history[..., 5], 32)


def test_the_first_frame_reads_no_history_and_no_motion(rng):
    frame = all_light(rng, 1)[0]
    clean = starting(DENOISER)({}, frame)
    poisoned = clean._replace(core=jax.tree.map(lambda leaf: leaf * np.nan, clean.core))
    elsewhere = frame._replace(shadow_motion=np.full_like(frame.motion, 3.3), glossy_motion=frame.motion * 2)
    expected = compiled(DENOISER)({}, clean, frame)[1]
    for state, given in ((poisoned, frame), (clean, elsewhere)):
        after, image = compiled(DENOISER)({}, state, given)
        np.testing.assert_array_equal(image, expected)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.core))


@pytest.mark.parametrize("which", ["rest", "shadows", "specular"])
def test_broken_history_is_dropped_where_it_is_broken(rng, which):
    frames = all_light(rng, 2)
    state, _ = compiled(DENOISER)({}, starting(DENOISER)({}, frames[0]), frames[0])
    broken = state._replace(core=state.core._replace(**{which: getattr(state.core, which).at[6, 6, 1].set(np.nan)}))
    after, image = compiled(DENOISER)({}, broken, frames[1])
    assert np.isfinite(image).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.core))


@pytest.mark.slow
def test_parts_of_light_may_come_and_go_within_a_clip(rng):
    frames = all_light(rng, 4)
    for index in (0, 2):
        frames[index] = frames[index]._replace(specular=None, shadowed=None, unshadowed=None)
    state, images = run(DENOISER, frames)
    assert all(np.isfinite(image).all() for image in images)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))


@pytest.mark.slow
def test_parts_beyond_all_light_are_cut_off(rng):
    frame = all_light(rng, 1)[0]
    too_much = dict.fromkeys(("shadowed", "unshadowed", "specular"), 10 * frame.radiance + 1)
    image = run(trmv(**MEANS), [frame._replace(**too_much)])[1][0]
    np.testing.assert_allclose(image, frame.radiance, rtol=1e-5)


def test_pixels_without_a_surface_pass_through(rng):
    frame = all_light(rng, 1)[0]
    np.testing.assert_array_equal(run(DENOISER, [frame])[1][0][0], frame.radiance[0])


PARTS = frozenset({"specular", "shadowed", "unshadowed"})
VECTORS = frozenset({"motion", "dual_motion", "shadow_motion", "glossy_motion"})


@pytest.mark.slow
def test_gradients_reach_every_part_of_light_and_the_options(x64, rng):
    """In one program, of few guides: more of them make it larger."""
    few = [only(frame, PARTS | VECTORS | {"depth"}) for frame in all_light(rng, 2, np.float64)]
    frames = jax.tree.map(lambda *buffers: np.stack(buffers), *few)
    params = jax.tree.map(np.float64, DENOISER.init(jax.random.key(0), few[0]))
    weights = np.cos(np.arange(HEIGHT * WIDTH * 3)).reshape(HEIGHT, WIDTH, 3)

    def loss(*given):
        *light, params = given
        shadowed, unshadowed, specular, rest = (part[None] for part in light)
        lit, free, shine = frames.shadowed + shadowed, frames.unshadowed + unshadowed, frames.specular + specular
        whole = frames.radiance + shadowed + specular + rest
        given = frames._replace(radiance=whole, shadowed=lit, unshadowed=free, specular=shine)
        return jnp.mean(unroll(DENOISER, params, given)[-1] * jnp.asarray(weights))

    level = np.full((HEIGHT, WIDTH, 3), 0.3)
    check_light_and_options(loss, (level, 2 * level, level, level), params, rng, by=range(4))


# What it is for.

SHADOW = 6


def passing_shadow(rng, count=14, *, speed=2):
    """A hard shadow of 12 x 12 pixels that passes over a wall under noisy light; frames, truth and its trail."""
    frames, truth, trails = [], [], []
    y, x = np.mgrid[:32, :64]
    one = np.ones((32, 64, 1), np.float32)
    for index in range(count):

        def inside(at):
            return (np.abs(y - 16) < SHADOW) & (np.abs(x - (14 + speed * at)) < SHADOW)

        under, before = inside(index), inside(index - 1)
        free = (0.6 + 0.01 * x)[..., None] * rng.gamma(16.0, 1 / 16, (32, 64, 1)) * np.ones(3)
        rest = 0.1 * rng.gamma(0.5, 2.0, (32, 64, 1)) * np.ones(3)
        lit = free * ~under[..., None]
        vectors = np.where((under | before)[..., None], [-float(speed), 0.0], 0.0)
        planes = {"radiance": lit + rest, "shadowed": lit, "unshadowed": free, "shadow_motion": vectors}
        normal = np.broadcast_to([0.0, 0.0, -1.0], (32, 64, 3))
        buffers = planes | {"depth": 5 * one, "normal": normal, "motion": 0 * vectors}
        frames.append(Frame(**{name: np.asarray(value, np.float32) for name, value in buffers.items()}))
        truth.append((0.6 + 0.01 * x) * ~under + 0.1)
        trails.append(np.any([inside(index - k) for k in range(1, 9)], axis=0) & ~under)
    return frames, truth, trails


def trail_error(denoiser, clip):
    """Mean absolute error where the shadow has been in the last eight frames, over the last four frames."""
    images = run(denoiser, clip[0])[1]
    found = [
        np.abs(image.mean(-1) - truth)[trail].mean() for image, truth, trail in zip(images, *clip[1:], strict=True)
    ]
    return np.mean(found[-4:])


@pytest.mark.slow
def test_a_shadow_that_moves_leaves_no_trail(rng):
    clip = passing_shadow(rng)
    mine, theirs = trail_error(trmv(), clip), trail_error(svgf(), clip)
    assert theirs > 0.1
    assert mine < 0.2 * theirs
    # With neither vectors nor clamp it is as late as svgf.
    blind = [frame._replace(shadow_motion=None) for frame in clip[0]], *clip[1:]
    assert trail_error(trmv(clamp_sigma=1e6), blind) > 0.7 * theirs


def light_with_vectors(lit, free, rest, *, shadow, dual):
    """A frame without noise of [H, W] light straight from lights, without its shadows, and of all other light."""
    planes = {"radiance": lit + rest, "shadowed": lit, "unshadowed": free}
    buffers = {name: each[..., None] * np.ones(3) for name, each in planes.items()}
    vectors = {"motion": [0.0, 0.0], "shadow_motion": shadow, "dual_motion": dual}
    buffers |= {name: np.broadcast_to(vector, (*lit.shape, 2)) for name, vector in vectors.items()}
    return Frame(**{name: np.asarray(each, np.float32) for name, each in buffers.items()})


@pytest.mark.slow
def test_a_shadow_brings_its_share_and_no_light_of_where_it_was():
    """It moves by 2 px a frame from dim to bright light; what it leaves is a share of the light that is there."""
    _, x = np.mgrid[:16, :48]
    free = np.where(x < 24, 0.2, 1.0)
    frames = [
        light_with_vectors(
            free * (0.55 + 0.4 * np.sin((x - 2 * index) / 3)), free, 0 * free, shadow=[-2.0, 0.0], dual=[0.0, 0.0]
        )
        for index in range(6)
    ]
    for frame, image in zip(frames, run(FETCHED, frames)[1], strict=True):
        np.testing.assert_allclose(image[:, 4:], frame.radiance[:, 4:], rtol=0.01)


@pytest.mark.slow
def test_the_share_of_a_shadow_is_held_to_what_the_frame_shows():
    """A shadow that is gone without a vector: where no pixel around is shadowed, none has been."""
    free = np.full((16, 48), 0.7)
    shadowed, lit = (
        light_with_vectors(light, free, 0 * free, shadow=[0.0, 0.0], dual=[0.0, 0.0]) for light in (0 * free, free)
    )
    np.testing.assert_allclose(run(HELD, [shadowed] * 4 + [lit])[1][-1], 0.7, rtol=1e-4)


def glossy(light):
    """A frame of specular light [H, W, 3] on a rough surface."""
    light = np.asarray(light, np.float32)
    return Frame(light, specular=light, roughness=np.ones_like(light[..., :1]))


@pytest.mark.slow
def test_nothing_that_was_filtered_in_space_comes_back(rng):
    frames = [glossy(rng.gamma(2.0, 0.5, (16, 24, 3))) for _ in range(2)]
    plain, filtered = (run(denoiser, frames) for denoiser in (HELD, FILTERED))
    assert np.abs(plain[1][-1] - filtered[1][-1]).max() > 0.1
    np.testing.assert_allclose(plain[0].core.specular, filtered[0].core.specular, rtol=1e-5, atol=1e-6)


def test_reflections_of_another_colour_are_not_mixed():
    """Red beside blue of the same luminance and without noise: no buffer tells them apart."""
    red, blue = np.array([0.5, 0.1, 0.1]), np.array([0.1, 0.1, 0.1 + 0.4 * 0.2126 / 0.0722])
    light = np.where((np.arange(24) < 12)[None, :, None], red, blue) * np.ones((16, 1, 1))
    np.testing.assert_allclose(run(FILTERED, [glossy(light)] * 2)[1][-1], light, rtol=0.01)


def test_other_light_is_fetched_along_the_dual_vectors(rng):
    lights = rng.uniform(0.5, 1.5, (2, 16, 48)).astype(np.float32)
    dark = np.zeros((16, 48))
    frames = [light_with_vectors(dark, dark, light, shadow=[0.0, 0.0], dual=[3.0, -1.0]) for light in lights]
    image = run(FETCHED, frames)[1][-1]
    expected = 0.5 * (lights[1, 1:, :-3] + lights[0, :-1, 3:])
    np.testing.assert_allclose(image[1:, :-3, 0], expected, rtol=1e-5)


@pytest.mark.slow
def test_a_shadow_is_not_fetched_from_another_surface(rng):
    frames = passing_shadow(rng, 3)[0]
    history = []
    for tilt in (False, True):
        normal = np.array(frames[0].normal)
        if tilt:
            normal[:, :12] = [1.0, 0.0, 0.0]
        turned = [frame._replace(normal=normal) for frame in frames]
        state, _ = run(trmv(**MEANS), turned)
        history.append(np.asarray(state.core.shadows)[12:20, 12:13, 5])
    assert np.all(history[0] == 3)
    assert np.all(history[1] == 1)


def mirror_frames(rng, count=12):
    """A mirror whose surface passes at 3 px a frame, and in it something that passes at 1 px the other way."""
    y, x = np.mgrid[:24, :32]
    one = np.ones((24, 32, 1), np.float32)
    frames, truth = [], []
    for index in range(count):
        seen = (1.0 + np.sin((x - index) / 1.5) * np.cos(y / 2.0))[..., None] * np.ones(3)
        light = (seen * rng.gamma(2.0, 0.5, (24, 32, 1))).astype(np.float32)
        normal = np.broadcast_to(np.array([0, 0, -1], np.float32), light.shape)
        vectors = [np.full((24, 32, 2), [at, 0.0], np.float32) for at in (3.0, -1.0)]
        buffers = {"depth": 5 * one, "normal": normal, "roughness": 0 * one, "motion": vectors[0]}
        frames.append(Frame(light, specular=light, glossy_motion=vectors[1], **buffers))
        truth.append(seen)
    return truth, frames


@pytest.mark.slow
def test_a_reflection_is_fetched_where_it_was(rng):
    truth, frames = mirror_frames(rng)
    errors = {}
    for name, denoiser, given in (
        ("mine", trmv(**MEANS, alpha=0.05), frames),
        ("blind", trmv(**MEANS, alpha=0.05), [frame._replace(glossy_motion=None) for frame in frames]),
        ("svgf", svgf(**MEANS, alpha=0.05), frames),
    ):
        image = run(denoiser, given)[1][-1]
        errors[name] = np.mean((image - truth[-1])[4:-4, 14:-4] ** 2) / np.mean(truth[-1] ** 2)
    assert errors["mine"] < 0.06  # a single frame has 0.5, a mean of twelve 0.042
    assert errors["mine"] < errors["blind"] / 4
    np.testing.assert_allclose(errors["blind"], errors["svgf"], rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "word"),
    [({"sigma_specular": 0.0}, "sigma_specular"), ({"demodulate": "colour"}, "demodulate"), ({"alpha": 0.0}, "alpha")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        trmv(**options)
