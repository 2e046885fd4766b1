"""Dual motion vectors on scenes whose disocclusions are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn.ops.motion
import jaxdn.ops.warp

# One program each, and not one for each of their operations.
dual_motion = jax.jit(jaxdn.ops.motion.dual_motion)
occlusion_mask = jax.jit(jaxdn.ops.motion.occlusion_mask)
warp = jax.jit(jaxdn.ops.warp.warp)

SIZE = 24


def _square(position, speed, side=8, snap=True):
    """A square that has just moved by ``speed`` (x, y) px to ``position`` in front of a fixed plane.

    Returns motion, forward motion, visible, and bool [H, W]: where the plane was uncovered.
    """
    rows, columns = np.mgrid[:SIZE, :SIZE]

    def covered(x, y):
        return (columns >= x) & (columns < x + side) & (rows >= y) & (rows < y + side)

    now = covered(*position)
    before = covered(position[0] - speed[0], position[1] - speed[1])
    motion = np.where(now[..., None], -np.array(speed, np.float32), 0.0).astype(np.float32)
    forward = np.where(before[..., None], np.array(speed, np.float32), 0.0).astype(np.float32)
    uncovered = before & ~now
    return motion, forward, (~uncovered[..., None] if snap else None), uncovered


@pytest.mark.parametrize("snap", [True, False])
@pytest.mark.parametrize("speed", [(3, 0), (-2, 0), (0, 4), (3, -2)])
def test_square_in_front_of_a_plane(speed, snap):
    """Uncovered pixels take over exactly the square's motion; the mask is exactly the trailing strip."""
    motion, forward, visible, uncovered = _square((8, 8), speed, snap=snap)
    dual = np.asarray(dual_motion(motion, forward, visible=visible))
    np.testing.assert_array_equal(dual[uncovered], np.broadcast_to(-np.float32(speed), (uncovered.sum(), 2)))
    np.testing.assert_array_equal(dual[~uncovered], motion[~uncovered])
    np.testing.assert_array_equal(np.asarray(occlusion_mask(motion, dual))[..., 0], uncovered)
    # What the dual vector fetches is the plane, what the traditional one fetches is the square.
    before = (np.abs(forward).sum(-1, keepdims=True) > 0).astype(np.float32)
    assert np.all(np.asarray(warp(before, motion))[uncovered] == 1)
    assert np.all(np.asarray(warp(before, dual))[uncovered] == 0)


def test_visible_may_lack_its_channel_axis():
    motion, forward, visible, _ = _square((8, 8), (3, 0))
    np.testing.assert_array_equal(
        dual_motion(motion, forward, visible=visible), dual_motion(motion, forward, visible=visible[..., 0])
    )


def test_a_point_that_was_seen_keeps_its_own_vector():
    motion, forward, visible, _ = _square((8, 8), (3, 0))
    np.testing.assert_array_equal(dual_motion(motion, forward, visible=np.ones_like(visible)), motion)


def test_target_beyond_the_border_falls_back():
    """A square entering from the left border: what it leaves uncovered would be fetched from off-screen."""
    motion, forward, visible, uncovered = _square((3, 8), (3, 0))
    assert uncovered.any()
    dual = dual_motion(motion, forward, visible=visible)
    np.testing.assert_array_equal(dual, motion)
    assert not np.any(occlusion_mask(motion, dual))


def test_traditional_target_beyond_the_border_falls_back():
    motion = np.full((4, 6, 2), 100.0, np.float32)
    forward = np.full((4, 6, 2), 0.25, np.float32)
    np.testing.assert_array_equal(dual_motion(motion, forward), motion)


@pytest.mark.parametrize(("offset", "inside"), [(-0.5, True), (-0.51, False), (0.5, True), (0.51, False)])
def test_the_screen_ends_half_a_pixel_beyond_the_last_centres(offset, inside):
    motion, forward = np.zeros((1, 1, 2), np.float32), np.zeros((1, 1, 2), np.float32)
    motion[0, 0, 0] = offset
    assert np.all(dual_motion(motion, forward) == (0 if inside else motion))
    assert np.all(dual_motion(motion[:, :, ::-1], forward) == (0 if inside else motion[:, :, ::-1]))


def test_nearest_pixel_rounds_half_up():
    motion = np.zeros((1, 4, 2), np.float32)
    motion[0, 1, 0] = 0.5
    forward = np.zeros((1, 4, 2), np.float32)
    forward[0, :, 0] = [0.1, 0.2, 0.3, 0.4]
    assert dual_motion(motion, forward)[0, 1, 0] == np.float32(-0.3)


def test_static_scene_is_exactly_zero():
    still = np.zeros((5, 7, 2), np.float32)
    dual = dual_motion(still, still)
    np.testing.assert_array_equal(dual, 0.0)
    np.testing.assert_array_equal(occlusion_mask(still, dual), 0.0)


def test_non_finite_vectors_give_no_mask_and_do_not_spread():
    motion, forward, _, _ = _square((8, 8), (3, 0))
    clean = np.asarray(occlusion_mask(motion, dual_motion(motion, forward)))
    motion[0, 0], motion[10, 6], motion[10, 10, 1] = np.nan, np.inf, -np.inf
    dual = dual_motion(motion, forward)
    mask = np.asarray(occlusion_mask(motion, dual))
    assert np.all(np.isfinite(mask))
    broken = ~np.all(np.isfinite(motion), axis=-1)
    assert not mask[broken].any()
    np.testing.assert_array_equal(mask[~broken], clean[~broken])
    # Non-finite vectors of the previous frame give no mask either.
    forward[10, 6] = np.nan
    assert occlusion_mask(motion, dual_motion(motion, forward))[10, 6, 0] == 0


@pytest.mark.parametrize("endless", [np.inf, -np.inf, np.nan])
def test_one_vector_that_is_not_finite_gives_no_mask(endless):
    there, still = np.full((2, 2, 2), endless, np.float32), np.zeros((2, 2, 2), np.float32)
    np.testing.assert_array_equal(occlusion_mask(still, there), 0)
    np.testing.assert_array_equal(occlusion_mask(there, still), 0)


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_positions_of_large_images_do_not_fit_into_half_precision(dtype, rng):
    """Steps of 4 pixels in bfloat16 from column 512 on, of 2 in float16 from 2,048 on."""
    motion, forward = (rng.choice([-2.0, 0.0, 1.0, 3.0], (2, 2100, 2)).astype(np.float32) for _ in range(2))
    half = dual_motion(jnp.asarray(motion, dtype), jnp.asarray(forward, dtype))
    assert half.dtype == dtype
    np.testing.assert_array_equal(np.float32(half), dual_motion(motion, forward))
    x, y = jaxdn.ops.motion.find_targets(jnp.asarray(motion, dtype))
    np.testing.assert_array_equal(x, np.arange(2100) + motion[..., 0])
    np.testing.assert_array_equal(y, np.arange(2)[:, None] + motion[..., 1])


def test_mask_threshold_is_a_length():
    motion = jnp.zeros((1, 1, 2))
    other = jnp.array([[[0.3, 0.41]]])  # 0.508 px long
    assert occlusion_mask(motion, other)[0, 0, 0] == 1
    assert occlusion_mask(motion, other, threshold=0.51)[0, 0, 0] == 0


def test_batches_and_compiles_as_it_is():
    cases = [_square((8, 8), speed) for speed in [(3, 0), (0, 4)]]
    motion, forward, visible = (jnp.stack([jnp.asarray(case[i]) for case in cases]) for i in range(3))
    dual = jax.jit(jax.vmap(lambda m, f, v: dual_motion(m, f, visible=v)))(motion, forward, visible)
    for index, case in enumerate(cases):
        np.testing.assert_array_equal(dual[index], dual_motion(case[0], case[1], visible=case[2]))


def test_errors_say_what_was_given():
    motion = jnp.zeros((4, 5, 2))
    with pytest.raises(ValueError, match="same size"):
        dual_motion(motion, motion[:-1])
    with pytest.raises(ValueError, match="2 channels"):
        occlusion_mask(motion, jnp.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="visible"):
        dual_motion(motion, motion, visible=jnp.ones((4, 4), bool))
