"""The presets of the papers on filters: what each does that the defaults do not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.denoisers import asvgf, reblur, relax, svgf, taa, trmv
from jaxdn.filters import gradients
from jaxdn.filters.edge_stopping import TapOffset, plane_weight
from jaxdn.methods.registry import methods
from jaxdn.methods.taa import invert_tone_map, tone_map
from tests.methods.lobe_scenes import run
from tests.methods.test_svgf import HEIGHT, LUMINANCE, WIDTH, moving_frames, reference_step

PLAIN = {"apart": False, "antialiasing": False}
"""The filter alone."""
EVERY = sorted(name for name, row in methods().items() if "paper" in row.presets)


@pytest.mark.parametrize("name", EVERY)
def test_every_paper_has_a_preset_of_one_name_that_differs_from_the_defaults(name):
    row = methods()[name]
    assert row.parse_options({"preset": "paper"}) != row.options()
    assert "parity" not in {*row.presets, *row.recipes}


# svgf


def test_svgf_as_published_matches_the_reference(rng):
    """Alpha 0.2 from the second frame on, the variance alone from neighbours, division by the albedo."""
    frames = moving_frames(rng, 5)
    denoiser = svgf(preset="paper", levels=1, **PLAIN)
    step, state, past = jax.jit(denoiser.step), jax.jit(denoiser.start)({}, frames[0]), None
    for frame in frames:
        state, image = step({}, state, frame)
        past, expected, hit = reference_step(past, frame, 1, published=True)
        np.testing.assert_allclose(image, expected, rtol=2e-3, atol=2e-4)
        np.testing.assert_allclose(state.core.history[hit], past[0][hit], rtol=2e-3, atol=2e-4)
    lengths = np.asarray(state.core.history[..., 5])[hit]
    assert (lengths < 4).any()
    assert (lengths > 4).any()


def with_direct(rng, frame):
    """A frame that has direct light, too."""
    lit = (rng.gamma(2.0, 0.3, frame.radiance.shape) * rng.integers(0, 2, (HEIGHT, WIDTH, 1))).astype(np.float32)
    return frame._replace(radiance=frame.radiance + lit, shadowed=lit)


@pytest.mark.slow
def test_direct_and_indirect_light_are_two_signals(rng):
    frames = [with_direct(rng, frame) for frame in moving_frames(rng)]
    options = {"preset": "paper", "levels": 1, "antialiasing": False}
    both = run(svgf(**options), frames)[1]
    rest = [frame._replace(radiance=frame.radiance - frame.shadowed) for frame in frames]
    direct = [frame._replace(radiance=frame.shadowed) for frame in frames]
    alone = svgf(**options, apart=False)
    parts = [run(alone, each)[1] for each in (rest, direct, frames)]
    for image, one, two, mixed in zip(both, *parts, strict=True):
        np.testing.assert_allclose(image, one + two, rtol=1e-4, atol=1e-5)
        assert np.abs(image - mixed).max() > 0.01  # one signal has one variance
    assert "shadowed" in svgf(**options).reads


def test_direct_light_that_comes_within_the_clip_begins_then(rng):
    first, second = moving_frames(rng, 2)
    second = with_direct(rng, second)
    denoiser = svgf(preset="paper", levels=0, feedback_level=0, antialiasing=False)
    step = jax.jit(denoiser.step)
    state, _ = step({}, jax.jit(denoiser.start)({}, first), first)
    assert state.core.direct is None
    after, image = step({}, state, second)
    hit = second.ids[..., 0] >= 0
    assert (np.asarray(after.core.direct.history)[hit, 5] == 1).all()
    whole = second._replace(radiance=second.radiance - second.shadowed, shadowed=None)
    np.testing.assert_allclose(image, step({}, state, whole)[1] + second.shadowed, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_the_last_stage_is_antialiasing_of_tone_mapped_light(rng):
    frames = moving_frames(rng)
    options = {"preset": "paper", "levels": 1, "apart": False}
    found = run(svgf(**options), frames)[1]
    expected = run(taa(preset="paper", after=svgf(**options, antialiasing=False)), frames)[1]
    for image, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(image, other, rtol=1e-6)


# taa


def test_tone_mapping_is_inverted(rng):
    light = np.concatenate([rng.exponential(size=(4, 5, 3)), 10.0 ** rng.uniform(-4, 3, (4, 5, 3))])
    mapped = tone_map(jnp.asarray(light, jnp.float32))
    assert (np.asarray(mapped) @ [0.25, 0.5, 0.25] < 1).all()
    np.testing.assert_allclose(invert_tone_map(mapped), light, rtol=1e-3)
    assert np.isfinite(invert_tone_map(tone_map(jnp.full((1, 1, 3), 65504.0)))).all()


def test_the_mean_of_taa_as_published_is_constant_and_weighs_bright_pixels_less():
    """A history of 0.1 that lies in the box of a flash of 10."""
    grey = np.full((7, 7, 3), 0.1, np.float32)
    flash = grey.copy()
    flash[2:5, 2:5] = 10.0
    flash[3, 3] = 0.1  # within the box of its bright neighbours
    frames = [Frame(grey), Frame(flash)]
    _, found = run(taa(preset="paper"), frames)
    np.testing.assert_allclose(found[0], grey, rtol=1e-5)
    # At a bright pixel beside the border of the flash the history, 0.1, lies in the box: x / (1 + x) is averaged.
    mapped = 0.04 * 10 / 11 + 0.96 * 0.1 / 1.1
    np.testing.assert_allclose(found[1][2, 2], mapped / (1 - mapped), rtol=1e-3)
    assert found[1][2, 2, 0] < 0.04 * 10 + 0.96 * 0.1  # which the linear mean would be


# asvgf


def test_gradients_of_the_released_code_match_a_loop(rng):
    """Taps 2^i apart, exp(-(dl / 3 s)^2) with the blurred variance of the centre, which is filtered along."""
    shape = (9, 11)
    size = rng.exponential(size=shape)
    delta, mean, variance = rng.uniform(-1, 1, shape) * size, rng.exponential(size=shape), rng.exponential(size=shape)
    found = gradients.reconstruct(
        gradients.Change(*map(jnp.asarray, (delta, size))),
        None,
        [],
        levels=3,
        significance=0.0,
        spacing=2,
        light=gradients.StratumLight(jnp.asarray(mean), jnp.asarray(0.01 * variance)),
    )
    fields, spread = np.stack([delta, size, mean], -1), 0.01 * variance
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    for level in range(3):
        wide = np.pad(spread, 1, mode="edge")
        after, narrower = fields.copy(), spread.copy()
        for y, x in np.ndindex(shape):
            deviation = np.sqrt((kernel * wide[y : y + 3, x : x + 3]).sum())
            total, weights, squares = 0.0, 0.0, 0.0
            for dy, dx in np.ndindex(3, 3):
                v, u = y + (dy - 1) * 2**level, x + (dx - 1) * 2**level
                if 0 <= v < shape[0] and 0 <= u < shape[1]:
                    w = np.exp(-(((fields[v, u, 2] - fields[y, x, 2]) / (3 * deviation)) ** 2))
                    total, weights, squares = total + w * fields[v, u], weights + w, squares + w * w * spread[v, u]
            after[y, x], narrower[y, x] = total / weights, squares / weights**2
        fields, spread = after, narrower
    expected = np.minimum(np.abs(fields[..., 0]) / fields[..., 1], 1.0)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-5)


def test_the_light_of_strata_is_that_of_what_their_middle_shows(rng):
    light, ids = rng.exponential(size=(7, 8)), rng.integers(0, 2, (7, 8, 1))
    found = gradients.measure_light(jnp.asarray(light), jnp.asarray(ids))
    for row, column in np.ndindex(3, 3):
        rows, columns = slice(3 * row, 3 * row + 3), slice(3 * column, 3 * column + 3)
        own, shown = light[rows, columns], ids[rows, columns, 0]
        middle = shown[min(1, shown.shape[0] - 1), min(1, shown.shape[1] - 1)]
        np.testing.assert_allclose(found.mean[row, column], own[shown == middle].mean(), rtol=1e-5)
        np.testing.assert_allclose(found.variance[row, column], own[shown == middle].var(), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_gradients_stop_at_the_edge_of_a_shadow(rng):
    """Where a light goes out on one side only, the other keeps its history; by default they are averaged together."""
    height = width = 45
    left = np.arange(width)[None, :, None] < 22
    before = rng.uniform(0.95, 1.05, (height, width, 1)) * np.ones(3)
    after = np.where(left, 0.05, 1.0) * before
    gradient = np.stack([(after - before) @ LUMINANCE, np.maximum(before, after) @ LUMINANCE], -1)
    frames = [
        Frame(before.astype(np.float32), luminance_gradient=np.zeros((height, width, 2), np.float32)),
        Frame(after.astype(np.float32), luminance_gradient=gradient.astype(np.float32)),
    ]

    def lengths(**options):
        state, _ = run(asvgf(levels=0, feedback_level=0, **options), [frames[0]] * 8 + [frames[1]])
        return np.asarray(state.core.history)[..., 5]

    published = {"significance": 0.0, "antilag": 1.0, "gradient_levels": 5, "gradient_spacing": 2}
    stopped = lengths(**published, gradient_stops="light", gradient_enlarging="nearest")
    averaged = lengths(**published)
    assert (stopped[:, 30:] > 8).all()
    assert (averaged[:, 30:] < 5).all()
    assert (stopped[:, :18] < 1.2).all()  # and what is in the dark begins anew


def test_nearest_strata_keep_their_value(rng):
    share = rng.random((3, 4))
    found = np.asarray(gradients.to_pixels(jnp.asarray(share), 8, 11, enlarging="nearest"))
    for y, x in np.ndindex(8, 11):
        r, c = y // 3, x // 3
        np.testing.assert_allclose(found[y, x], share[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].max(), rtol=1e-6)


def test_asvgf_as_published_leaves_half_of_the_history_of_light_that_doubles():
    light = np.ones((24, 30, 3), np.float32)
    changed = np.stack([np.ones((24, 30)), np.full((24, 30), 2.0)], -1).astype(np.float32)
    frames = [Frame(light, luminance_gradient=0 * changed)] * 20 + [Frame(2 * light, luminance_gradient=changed)]
    _, images = run(asvgf(preset="paper", levels=1, antialiasing=False), frames)
    # lambda = 1/2, so the new frame weighs (1 - lambda) 0.1 + lambda, and the image is 1 + 0.55.
    np.testing.assert_allclose(images[-1], 1.55, rtol=0.01)


@pytest.mark.slow
def test_both_signals_of_asvgf_have_the_gradient_of_all_light():
    """A quarter of the light is direct and goes out; of the indirect light's history as large a share goes with it."""
    light, indirect = np.ones((24, 30, 3), np.float32), np.full((24, 30, 3), 0.75, np.float32)
    rest = np.zeros((24, 30, 2), np.float32)
    changed = rest + np.array([-0.25, 1.0], np.float32)
    lit = Frame(light, shadowed=light - indirect, luminance_gradient=rest)
    frames = [lit] * 20 + [Frame(indirect, shadowed=0 * light, luminance_gradient=changed)]
    state, images = run(asvgf(preset="paper", levels=1, antialiasing=False), frames)
    # lambda = 1/4, so the new frame weighs (1 - lambda) 0.1 + lambda = 0.325 in both.
    np.testing.assert_allclose(images[-1], 0.75 + 0.675 * 0.25, rtol=0.01)
    lengths = [np.asarray(part.history[..., 5]) for part in state.core]
    np.testing.assert_array_equal(*lengths)
    assert (lengths[0] < 4).all()  # of the light that stays as well, after 20 frames


# relax, reblur


def test_the_plane_test_knows_slanted_surfaces():
    """A plane that recedes by 5 % a pixel is one surface; a step of 1 % of the depth is another."""
    x = np.arange(9.0)
    slanted = np.broadcast_to((5 + 0.25 * x)[None, :, None], (7, 9, 1))
    step = np.where(x < 5, 5.0, 5.05)[None, :, None] * np.ones((7, 1, 1))
    for depth, expected in ((slanted, 1.0), (step, 0.0)):
        weight = plane_weight(jnp.asarray(depth), None, tolerance=0.003)
        here, there = ([plane[3, at] for plane in planes] for planes, at in ((weight.here, 3), (weight.there, 6)))
        offset = jnp.asarray(3.0), jnp.asarray(0.0), jnp.asarray(3.0)
        assert float(weight.factor(there, here, TapOffset(*offset))) == expected


@pytest.mark.slow
def test_relax_as_published_filters_within_planes(rng):
    """Across a step of 1 % of the depth noisy light does not run, however alike the two sides are."""
    near = (np.arange(24) < 12)[None, :, None]
    depth = (np.where(near, 5.0, 5.05) * np.ones((24, 1, 1))).astype(np.float32)
    light = np.where(near, 1.0, 1.5) * rng.gamma(1.0, 1.0, (24, 24, 1)) * np.ones(3)
    sides = slice(0, 12), slice(12, 24)
    means = [light[:, side, 0].mean() for side in sides]
    options = {"preset": "paper", "fix_frames": 0, "levels": 3, "sigma_diffuse": 1e6}

    def image_of(denoiser):
        return run(denoiser, [Frame(light.astype(np.float32), depth=depth)])[1][0][..., 0]

    split, mixed = image_of(relax(**options)), image_of(relax(**options, plane_tolerance=0.02))
    assert split[:, sides[1]].mean() - split[:, sides[0]].mean() == pytest.approx(means[1] - means[0], rel=0.1)
    beside = [image[:, 12].mean() - image[:, 11].mean() for image in (split, mixed)]
    assert beside[1] < 0.4 * beside[0]


@pytest.mark.slow
def test_reblur_as_published_blurs_wider_at_first():
    """How much light arrives 14 to 20 pixels inside the dark half."""
    light = np.where(np.arange(48) < 24, 1.0, 2.0)[None, :, None] * np.ones((48, 1, 3))
    frames = [Frame(light.astype(np.float32))]
    ours, published = (run(reblur(fix_frames=0, **options), frames)[1][0] for options in ({}, {"preset": "paper"}))
    assert published[:, 4:10].mean() - 1 > 2 * (ours[:, 4:10].mean() - 1)


# trmv


@pytest.mark.slow
def test_trmv_as_published_follows_dual_vectors_to_any_surface(rng):
    """The history beside an occluder is of another shape: by default it is rejected there, in the paper it counts."""
    shape = (12, 16)
    ids = np.where(np.arange(16) < 8, 1, 2)[None, :, None] * np.ones((12, 1, 1), np.int32)
    still = np.zeros((*shape, 2), np.float32)
    dual = np.where(np.arange(16) >= 8, -8.0, 0.0)[None, :, None] * np.float32([1, 0]) * np.ones((12, 1, 1), np.float32)
    before = np.where(ids == 1, 1.0, 3.0) * np.ones(3)
    frames = [
        Frame(before.astype(np.float32), ids=ids, motion=still),
        Frame(np.full((*shape, 3), 2.0, np.float32), ids=ids, motion=still, dual_motion=dual),
    ]
    means = {"levels": 0, "feedback_level": 0, "short_history": 0}
    published = run(trmv(preset="paper", **means), frames)[1][-1]
    np.testing.assert_allclose(published[:, 8:], 0.2 * 2 + 0.8 * 1, rtol=1e-5)
    tested = run(trmv(preset="paper", **means, dual_tested=True), frames)[1][-1]
    # Column 15 finds its own shape one pixel beside the target.
    np.testing.assert_allclose(tested[:, 9:15], 2.0, rtol=1e-5)


@pytest.mark.slow
def test_trmv_as_published_tests_normals_where_the_vector_is_that_of_the_surface():
    """A fold of one shape has moved by four pixels: what it shows now is new, but where a dual vector leads."""
    columns, flat = np.arange(16)[None, :, None], np.ones((12, 1, 1), np.float32)
    first, second = (
        (np.where(columns < fold, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]) * flat).astype(np.float32) for fold in (4, 8)
    )
    still, ids = np.zeros((12, 16, 2), np.float32), np.ones((12, 16, 1), np.int32)
    dual = np.zeros((12, 16, 2), np.float32)
    dual[:, 5, 0], dual[:, 12, 0] = -5, -10  # to the same normal, and to another
    frames = [
        Frame(np.ones((12, 16, 3), np.float32), normal=first, ids=ids, motion=still),
        Frame(np.full((12, 16, 3), 2.0, np.float32), normal=second, ids=ids, motion=still, dual_motion=dual),
    ]
    plain = {"levels": 0, "feedback_level": 0, "short_history": 0}
    image = run(trmv(preset="paper", **plain), frames)[1][-1]
    kept = 0.2 * 2 + 0.8 * 1
    # Column 4 finds what it shows one pixel beside it.
    expected = np.where((columns < 6) | (columns >= 8), kept, 2.0)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=1e-5)
