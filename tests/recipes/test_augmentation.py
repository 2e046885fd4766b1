"""Variations of clips: each leaves light transport true, and nothing else changes."""

import jax
import numpy as np
import pytest

from jaxdn.core.frame import Clip, Frame
from jaxdn.recipes.augmentation import (
    GROUPS,
    NO_AUGMENTATION,
    Augmentation,
    augment_clip,
    draw_variation,
    vary_clip,
)

SHAPE = (2, 4, 5)


@pytest.fixture
def clip(rng: np.random.Generator) -> Clip:
    normal = rng.standard_normal((*SHAPE, 3)).astype(np.float32)
    frames = Frame(
        radiance=rng.exponential(size=(*SHAPE, 3)).astype(np.float32),
        albedo=rng.random((*SHAPE, 3), np.float32),
        reflectance=rng.random((*SHAPE, 3), np.float32),
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        depth=rng.uniform(1, 9, (*SHAPE, 1)).astype(np.float32),
        roughness=rng.random((*SHAPE, 1), np.float32),
        motion=rng.standard_normal((*SHAPE, 2)).astype(np.float32),
        dual_motion=rng.standard_normal((*SHAPE, 2)).astype(np.float32),
        visible=rng.random((*SHAPE, 1)) > 0.2,
        direct=rng.exponential(size=(*SHAPE, 3)).astype(np.float32),
    )
    reference = rng.exponential(size=(*SHAPE, 3)).astype(np.float32)
    return Clip(frames, reference, {1: frames.radiance, 2: reference})


def one(variation: Augmentation, clip: Clip, seed: int = 0) -> Clip:
    return augment_clip(clip, variation, np.random.default_rng(seed))


def unchanged(found: Clip, clip: Clip, *names: str) -> None:
    for name in names:
        np.testing.assert_array_equal(getattr(found.frames, name), getattr(clip.frames, name), err_msg=name)


def test_exposure_and_tint_scale_all_light_by_the_same_factors_within_their_ranges(clip: Clip) -> None:
    factors = []
    for seed in range(40):
        found = one(NO_AUGMENTATION._replace(exposure=64.0, tint=1.5), clip, seed)
        gain = found.reference[0, 0, 0] / clip.reference[0, 0, 0]
        for image, before in (
            (found.reference, clip.reference),
            (found.frames.radiance, clip.frames.radiance),
            (found.frames.direct, clip.frames.direct),
            (found.layers[2], clip.layers[2]),
        ):
            np.testing.assert_allclose(image, before * gain, rtol=1e-5)
        unchanged(found, clip, "albedo", "normal", "depth", "motion", "visible", "roughness")
        factors.append(gain)
    factors = np.log2(factors)
    assert np.abs(factors).max() <= 6 + np.log2(1.5) + 1e-4
    assert np.abs(factors).max() > 5  # the range is used
    assert 0.1 < np.ptp(factors, axis=1).max() <= 2 * np.log2(1.5) + 1e-4


def test_channels_are_exchanged_in_light_and_reflectance_alike(clip: Clip) -> None:
    orders = set()
    for seed in range(40):
        found = one(NO_AUGMENTATION._replace(channels=True), clip, seed)
        order = [int(np.argmin(np.abs(clip.reference[0, 0, 0] - value))) for value in found.reference[0, 0, 0]]
        orders.add(tuple(order))
        np.testing.assert_array_equal(found.reference, clip.reference[..., order])
        for name in ("radiance", "albedo", "reflectance", "direct"):
            np.testing.assert_array_equal(getattr(found.frames, name), getattr(clip.frames, name)[..., order])
        unchanged(found, clip, "normal", "depth", "motion")
    assert len(orders) == 6


def test_normals_turn_rigidly_and_nothing_else_does(clip: Clip) -> None:
    found = one(NO_AUGMENTATION._replace(rotation=True), clip)
    before, after = (frames.normal.reshape(-1, 3) for frames in (clip.frames, found.frames))
    np.testing.assert_allclose(after @ after.T, before @ before.T, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(after[:3]), np.linalg.det(before[:3]), atol=1e-5)  # no mirror image
    assert np.abs(after - before).max() > 0.5
    unchanged(found, clip, "radiance", "albedo", "depth", "motion", "dual_motion")


def test_a_shadow_crosses_all_light_alike_and_leaves_the_surfaces(rng: np.random.Generator) -> None:
    wide = rng.exponential(size=(6, 24, 40, 3)).astype(np.float32) + 0.1
    clip = Clip(Frame(radiance=wide, albedo=wide, depth=wide[..., :1]), 2 * wide, {1: wide})
    changes, darkest = [], []
    for seed in range(60):
        found = one(NO_AUGMENTATION._replace(shadow=1.0), clip, seed)
        left = found.reference / clip.reference
        assert left.max() <= 1 + 1e-5
        assert left.min() >= 1e-3 * (1 - 1e-3)
        for image in (found.frames.radiance, found.layers[1]):
            np.testing.assert_allclose(image, wide * left, rtol=1e-5)
        np.testing.assert_allclose(left, left[..., :1].repeat(3, -1), rtol=1e-5)
        unchanged(found, clip, "albedo", "depth")
        # A straight edge: along any line the light only rises or only falls, in every frame and from frame to frame.
        for axis in range(3):
            steps = np.diff(left[..., 0], axis=axis)
            assert (steps <= 1e-5).all() or (steps >= -1e-5).all()
        changes.append(np.abs(np.diff(np.log(left[..., 0].mean((1, 2))))).max())
        darkest.append(left.min())
    assert max(changes) > 2.0, "lamps are switched"
    assert 0.01 < np.median(changes) < 1.0, "and shadows creep"
    assert np.min(darkest) < 0.01


def test_of_few_elements_some_have_a_shadow(clip: Clip) -> None:
    same = [
        np.array_equal(one(NO_AUGMENTATION._replace(shadow=0.3), clip, s).reference, clip.reference) for s in range(100)
    ]
    assert 0.55 < np.mean(same) < 0.85


def test_absent_buffers_have_their_neutral_values_in_whole_groups(clip: Clip) -> None:
    found = one(NO_AUGMENTATION._replace(missing=1.0), clip)
    np.testing.assert_array_equal(found.frames.albedo, 1.0)
    np.testing.assert_array_equal(found.frames.reflectance, 1.0)
    np.testing.assert_array_equal(found.frames.roughness, 1.0)
    for name in ("normal", "depth", "motion", "dual_motion"):
        np.testing.assert_array_equal(getattr(found.frames, name), 0.0)
    assert found.frames.previous_depth is None  # what was not there does not appear
    unchanged(found, clip, "radiance", "visible", "direct")
    half = [one(NO_AUGMENTATION._replace(missing=0.5), clip, seed).frames for seed in range(40)]
    gone = np.array([[np.array_equal(f.albedo, np.ones_like(f.albedo)), not f.normal.any()] for f in half])
    assert {(bool(a), bool(n)) for a, n in gone} == {(False, False), (False, True), (True, False), (True, True)}


def test_without_variation_nothing_changes(clip: Clip) -> None:
    found = one(NO_AUGMENTATION, clip)
    np.testing.assert_array_equal(found.reference, clip.reference)
    unchanged(found, clip, *(name for name in Frame._fields if getattr(clip.frames, name) is not None))


def test_on_a_device_and_in_a_batch_clips_are_varied_as_by_numpy(clip: Clip) -> None:
    variation = Augmentation(missing=0.5, shadow=0.5, exposure=16.0)
    draws = [draw_variation(variation, SHAPE, np.random.default_rng(seed)) for seed in range(12)]
    assert len({tuple(draw.absent) for draw in draws}) > 3
    assert {bool(draw.shadow.any()) for draw in draws} == {True, False}
    batch, stacked = (jax.tree.map(lambda *one: np.stack(one), *some) for some in ([clip] * 12, draws))
    found = jax.jit(jax.vmap(lambda clip, draw: vary_clip(clip, draw, variation)))(batch, stacked)
    wanted = jax.tree.map(lambda *one: np.stack(one), *(one(variation, clip, seed) for seed in range(12)))
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6), found, wanted)
    assert all(leaf.dtype in (np.float32, bool) for leaf in jax.tree.leaves(found))


def test_values_out_of_range_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"variation exposure: expected a number >= 1, got 0\.5"):
        Augmentation(exposure=0.5).check()
    Augmentation().check()
    assert {name for group in GROUPS for name in group} <= set(Frame._fields)


def test_every_clip_gets_the_same_brightness(clip: Clip, rng: np.random.Generator) -> None:
    wide = rng.exponential(size=(2, 32, 48, 3)).astype(np.float32)
    wide[:, :16, :16] = 0  # black blocks have no say
    for factor in (1e-2, 1.0, 30.0):
        given = Clip(Frame(radiance=factor * wide), factor * wide)
        found = one(NO_AUGMENTATION._replace(level=True), given)
        means = found.reference.mean((0, 3)).reshape(2, 16, 3, 16).mean((1, 3)).ravel()[1:]
        np.testing.assert_allclose(np.exp(np.mean(np.log(means))), 0.18, rtol=1e-4)
        np.testing.assert_allclose(found.frames.radiance, found.reference, rtol=1e-6)
    black = Clip(Frame(radiance=0 * wide), 0 * wide)
    assert not one(NO_AUGMENTATION._replace(level=True), black).reference.any()
