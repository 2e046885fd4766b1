"""Warping: analytic results, borders, non-finite vectors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxdn.ops.motion
import jaxdn.ops.warp
from tests.gradients import check_gradients

# One program each, and not one for each of their operations.
on_screen = jax.jit(jaxdn.ops.motion.on_screen)
warp = jax.jit(jaxdn.ops.warp.warp, static_argnames=("border", "implementation"))


def _constant_motion(height, width, x, y):
    return np.broadcast_to(np.float32([x, y]), (height, width, 2))


@given(x=st.integers(-9, 9), y=st.integers(-7, 7), border=st.sampled_from(["clamp", "zeros"]))
def test_integer_shift_is_an_array_shift(x, y, border):
    image = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)
    padding = {"clamp": {"mode": "edge"}, "zeros": {"mode": "constant"}}[border]
    padded = np.pad(image, ((10, 10), (10, 10), (0, 0)), **padding)
    out = warp(image, _constant_motion(6, 8, x, y), border=border)
    np.testing.assert_array_equal(out, padded[10 + y : 16 + y, 10 + x : 18 + x])


def test_half_a_pixel_on_a_ramp():
    ramp = jnp.broadcast_to(jnp.arange(8.0)[None, :, None], (6, 8, 1))
    out = warp(ramp, _constant_motion(6, 8, 0.5, 0.5))
    np.testing.assert_array_equal(out[:, :-1], ramp[:, :-1] + 0.5)
    np.testing.assert_array_equal(out[:, -1], ramp[:, -1])  # clamped to the outermost pixel centre
    zeros = warp(ramp, _constant_motion(6, 8, 0.5, 0.0), border="zeros")
    np.testing.assert_array_equal(zeros[:, -1], ramp[:, -1] / 2)  # half of it is outside


@given(seed=st.integers(0, 2**16), size=st.sampled_from([(6, 8), (1, 1), (1, 9), (9, 1)]))
def test_a_constant_image_is_unchanged(seed, size):
    motion = np.random.default_rng(seed).uniform(-20, 20, (*size, 2)).astype(np.float32)
    np.testing.assert_allclose(warp(np.full((*size, 3), 0.7, np.float32), motion), 0.7, rtol=1e-6)


def test_no_motion_returns_the_image_itself(rng):
    image = rng.random((6, 8, 3)).astype(np.float32)
    np.testing.assert_array_equal(warp(image, jnp.zeros((6, 8, 2))), image)


@pytest.mark.parametrize("border", ["clamp", "zeros"])
def test_vectors_that_are_not_finite_fetch_nothing(border):
    """Neither a value nor a gradient, and the neighbours are not affected."""
    motion = np.zeros((3, 4, 2), np.float32)
    motion[0, 0, 0], motion[1, 1, 1], motion[2, 2] = np.nan, np.inf, -np.inf
    motion[2, 3] = 1e30
    image = jnp.ones((3, 4, 2))
    out, gradient = jax.jit(jax.value_and_grad(lambda image: jnp.sum(warp(image, motion, border=border))))(image)
    fetched = 12 - 3 - (border == "zeros")
    assert out == 2 * fetched
    assert jnp.sum(gradient) == 2 * fetched
    assert np.all(warp(image, motion, border=border)[[0, 1, 2], [0, 1, 2]] == 0)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("border", ["clamp", "zeros"])
def test_gradients(border, rng):
    image, motion = jnp.asarray(rng.random((4, 5, 2))), jnp.asarray(rng.uniform(-2, 2, (4, 5, 2)))
    check_gradients(lambda image: jnp.sin(warp(image, motion, border=border)), (image,))
    for implementation in ("reference", "pairs"):
        by_motion = jax.jit(
            jax.grad(lambda m, i=implementation: jnp.sum(warp(image, m, border=border, implementation=i) ** 2))
        )
        np.testing.assert_array_equal(by_motion(motion), 0.0)


def test_large_images_in_bfloat16_keep_their_pixel_indices():
    image = jnp.arange(600, dtype=jnp.float32)[None, :, None].astype(jnp.bfloat16)
    np.testing.assert_array_equal(warp(image, jnp.zeros((1, 600, 2), jnp.bfloat16)), image)


def test_on_screen_is_half_a_pixel_beyond_the_outermost_centres():
    motion = jnp.zeros((3, 4, 2)).at[0, 0].set(jnp.array([-0.5, -0.5])).at[2, 3].set(jnp.array([0.5, 0.5]))
    assert np.all(on_screen(motion))
    outside = [(0, 0, (-0.51, 0)), (0, 0, (0, -0.51)), (2, 3, (0.51, 0)), (2, 3, (0, 0.51)), (1, 1, (np.nan, 0))]
    for row, column, vector in [*outside, (1, 2, (0, np.inf)), (1, 2, (-np.inf, 0))]:
        seen = on_screen(motion.at[row, column].set(jnp.array(vector)))
        assert seen.shape == (3, 4, 1)
        assert np.sum(~seen) == 1
        assert not seen[row, column, 0]


def test_errors_say_what_was_given():
    image, motion = jnp.zeros((4, 5, 3)), jnp.zeros((4, 5, 2))
    with pytest.raises(ValueError, match=r"motion.*2 channels"):
        warp(image, image)
    with pytest.raises(ValueError, match="same size"):
        warp(image, motion[:-1])
    with pytest.raises(ValueError, match="'clamp', 'zeros', got 'wrap'"):
        warp(image, motion, border="wrap")
    with pytest.raises(ValueError, match=r"jax\.vmap"):
        warp(image[None], motion)
