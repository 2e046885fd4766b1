"""Motion measured from two frames' guides: against the motion that made them, and against none."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxdn.core.frame import FAR, Frame
from jaxdn.filters.camera_search import fit_camera, move_by_camera
from jaxdn.filters.image_steps import differentiate, halve, mean_around
from jaxdn.filters.motion_search import SIDE, measure_motion, measure_nearness, reduce_size, see, something_moves

HEIGHT, WIDTH = 48, 64
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
_WAVES = np.random.default_rng(5)
_TURNS, _PHASES = _WAVES.uniform(0.15, 0.5, (2, 3, 4)), _WAVES.uniform(0, 6.28, (3, 4))


def paint(x, y):
    """[H, W, 3] features of about 0 to 1 at places between pixels, too."""
    waves = np.sin(_TURNS[0] * x[..., None, None] + _TURNS[1] * y[..., None, None] + _PHASES)
    return 0.5 + 0.25 * waves.sum(axis=-1)


def noise(scale, seed):
    return np.random.default_rng(seed).normal(scale=scale, size=(HEIGHT, WIDTH, 3))


def measure(before, now, nearness=None):
    found = measure_motion(before.astype(np.float32), now.astype(np.float32), nearness)
    return np.asarray(found.motion), np.asarray(found.certain)


@given(x=st.floats(-7, 7), y=st.floats(-7, 7), seed=st.integers(0, 99))
@settings(max_examples=12, deadline=None)
def test_a_frame_that_shifts_is_followed_between_pixels_in_spite_of_noise(x, y, seed):
    """With one program for all."""
    before = paint(COLUMNS - x, ROWS - y) + noise(0.02, seed)
    now = paint(COLUMNS, ROWS) + noise(0.02, seed + 100)
    motion, certain = measure(before, now)
    inside = np.s_[8:-8, 8:-8]
    assert np.quantile(np.linalg.norm(motion[inside] - [x, y], axis=-1), 0.9) < 0.2
    assert certain.mean() > 0.3


def room(step):
    """Features and depth of a wall, most of it plain, with a textured board in front, seen by a camera that travels."""
    near = np.abs(COLUMNS - 18 - 4 * step) < 12
    x = np.where(near, COLUMNS - 4 * step, COLUMNS - step)
    features = paint(x, ROWS)
    features[~near & (ROWS < 36)] = 0.3
    return features, np.where(near, 2.0, 8.0)


def test_a_plain_wall_moves_with_what_stands_before_it():
    """Depth tells: blocks of the wall alone look the same wherever they are."""
    (before, _), (now, depth) = room(0), room(1)
    before, now = before + noise(0.02, 1), now + noise(0.02, 2)
    nearness = measure_nearness(jnp.asarray(depth, jnp.float32))
    motion, certain = measure(before, now, nearness)
    true = np.stack([np.where(depth < 4, -4.0, -1.0), 0 * depth], axis=-1)
    seen = np.ones(depth.shape, bool)
    seen[:, 30:40] = seen[:, :10] = False  # beside the board's edges, which hide a part of the wall
    error = np.linalg.norm(motion - true, axis=-1)[seen]
    assert np.quantile(error, 0.95) < 0.3
    assert not certain[8:28, 46:-8].any()


def square(step):
    """A square that moves by (3, -2) over a wall that stands still."""
    features, hidden = (
        paint(COLUMNS, ROWS),
        (np.abs(COLUMNS - 24 - 3 * step) < 14) & (np.abs(ROWS - 26 + 2 * step) < 14),
    )
    inside = paint(0.5 * (COLUMNS - 3 * step) + 40, 0.5 * (ROWS + 2 * step))
    return np.where(hidden[..., None], inside, features), hidden


def test_what_stands_still_beside_something_that_moves_has_no_motion_at_all():
    (before, _), (now, inside) = square(0), square(1)
    motion, _ = measure(before + noise(0.02, 1), now + noise(0.02, 2))
    moves = np.any(motion != 0, axis=-1)
    assert np.mean(moves[inside]) > 0.3  # near its edges it is not told from the wall
    assert np.mean(np.abs(motion[inside & moves] - [-3, 2]).max(axis=-1) < 0.3) > 0.8
    around = mean_around(jnp.asarray(inside, jnp.float32), 8) > 0
    assert np.mean(np.any(motion[~np.asarray(around)] != 0, axis=-1)) < 0.02


@given(scale=st.sampled_from([0.0, 1e-3, 0.03, 0.3, 3.0]), spots=st.booleans(), seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_noise_alone_is_no_motion(scale, spots, seed):
    """However strong, and also where it is that of a few pixels, such as those of edges."""
    still = paint(COLUMNS, ROWS)
    where = (np.random.default_rng(seed).random((HEIGHT, WIDTH, 1)) < 0.05) if spots else 1.0
    one, two = ((still + where * noise(scale, seed + k)).astype(np.float32) for k in (1, 2))
    assert not something_moves(one, two)
    assert not something_moves(one, one)


@pytest.mark.parametrize("x", [0.2, 1.0, 9.0])
def test_motion_is_more_than_noise(x):
    moved = paint(COLUMNS - x, ROWS)
    assert something_moves(
        *((each + noise(0.03, k)).astype(np.float32) for k, each in enumerate((moved, paint(COLUMNS, ROWS))))
    )
    before, now = (square(step)[0] + noise(0.03, step) for step in (0, 1))
    assert something_moves(before.astype(np.float32), now.astype(np.float32))


def test_windows_that_change_alike_are_counted_as_plain_loops_count_them():
    """A hundredth of the windows: with as many as that nothing moves, with one more it does."""

    def share(difference):
        counts = []
        for row, column in itertools.product(range(HEIGHT), range(WIDTH)):
            rows, columns = (np.clip(np.arange(c - 2, c + 3), 0, n - 1) for c, n in ((row, HEIGHT), (column, WIDTH)))
            window = difference[np.ix_(rows, columns)].reshape(25, 3)
            counts.append(25 * np.sum(window.mean(axis=0) ** 2) / max(np.sum(window**2) / 25, 1e-8))
        return np.mean(np.array(counts) > 8)

    still, found = np.zeros((HEIGHT, WIDTH, 3), np.float32), set()
    for length in (3, 4, 5, 6, 9):
        changed = still.copy()
        changed[20 : 20 + length, 30:33] = 0.1
        expected = share(changed) > 0.01
        assert bool(something_moves(still, changed)) == expected
        found.add(expected)
    assert found == {False, True}


def test_a_camera_is_found_by_its_numbers():
    """From vectors of which a quarter are wrong, and no texture to look at."""
    rng = np.random.default_rng(3)
    nearness = jnp.asarray(rng.uniform(0.3, 2.5, (HEIGHT, WIDTH)), jnp.float32)
    theta = jnp.asarray(rng.normal(scale=1.5, size=14), jnp.float32)
    motion = np.array(move_by_camera(theta, (HEIGHT, WIDTH), nearness))
    x, y, q = (2 * COLUMNS + 1) / WIDTH - 1, ((2 * ROWS + 1) - HEIGHT) / WIDTH, np.asarray(nearness, np.float64)
    turned = np.einsum("nk,nhw->hwk", np.asarray(theta, np.float64)[:6].reshape(3, 2), np.stack([0 * x + 1, x, y]))
    turned += (theta[6] * x + theta[7] * y)[..., None] * np.stack([x, y], axis=-1)
    there = np.stack([0 * x + 1, 0 * x, x]), np.stack([0 * x, 0 * x + 1, y])
    for power, numbers in ((1, theta[8:11]), (2, theta[11:])):
        turned += (q**power)[..., None] * np.stack(
            [np.tensordot(np.asarray(numbers), one, 1) for one in there], axis=-1
        )
    np.testing.assert_allclose(motion, turned, atol=1e-5)
    wrong = motion.copy()
    wrong[:12] += [9.0, -7.0]
    blank = np.zeros((HEIGHT, WIDTH, 1), np.float32)
    found = fit_camera(blank, blank, nearness, wrong, np.ones((HEIGHT, WIDTH), np.float32))
    np.testing.assert_allclose(move_by_camera(found, (HEIGHT, WIDTH), nearness), motion, atol=0.05)


def test_small_steps_are_those_of_numpy(rng):
    image = rng.random((7, 9, 2)).astype(np.float32)
    padded = np.pad(image.astype(np.float64), ((0, 1), (0, 1), (0, 0)), mode="edge")
    np.testing.assert_allclose(halve(image), padded.reshape(4, 2, 5, 2, 2).mean(axis=(1, 3)), rtol=1e-6)
    wide = np.pad(image.astype(np.float64), ((2, 2), (2, 2), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(wide, (5, 5), axis=(0, 1))
    np.testing.assert_allclose(mean_around(image, 2), windows.mean(axis=(-2, -1)), rtol=1e-6)
    near = wide[1:-1, 1:-1]
    across, down = differentiate(image)
    np.testing.assert_allclose(across, 0.5 * (near[1:-1, 2:] - near[1:-1, :-2]), atol=1e-6)
    np.testing.assert_allclose(down, 0.5 * (near[2:, 1:-1] - near[:-2, 1:-1]), atol=1e-6)


def test_large_frames_are_searched_at_a_part_of_their_size():
    """And the vectors are in pixels of the frame; depth keeps its edges."""
    assert reduce_size(jnp.zeros((SIDE + 2, 8, 3))).shape == (SIDE // 2 + 1, 4, 3)
    before, now = paint(COLUMNS - 2, ROWS), paint(COLUMNS, ROWS)
    found = measure_motion(before.astype(np.float32), now.astype(np.float32), size=(2 * HEIGHT - 1, 2 * WIDTH))
    assert found.motion.shape == (2 * HEIGHT - 1, 2 * WIDTH, 2)
    assert np.quantile(np.abs(np.asarray(found.motion)[16:-16, 16:-16] - [4, 0]).max(axis=-1), 0.9) < 0.3


def test_guides_that_are_no_numbers_do_no_harm(rng):
    albedo = paint(COLUMNS, ROWS).astype(np.float32)
    albedo[3, 5], albedo[7, 7, 1] = np.nan, np.inf
    depth = np.full((HEIGHT, WIDTH, 1), 3.0, np.float32)
    depth[:4] = FAR
    frame = Frame(albedo, albedo=albedo, normal=albedo * np.float32(np.nan), depth=depth)
    look = see(frame)
    assert np.isfinite(look.features).all()
    np.testing.assert_allclose(look.nearness, np.where(depth[..., 0] < FAR, 1.0, 0.0), rtol=1e-5)
    assert np.isfinite(measure_motion(look.features, look.features, look.nearness).motion).all()
    assert see(Frame(albedo, depth=depth)) is None


@pytest.mark.parametrize("size", [(1, 1), (5, 3)])
def test_an_image_smaller_than_a_window_has_motion_too(size):
    features = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    found = measure_motion(features, features)
    assert not np.any(found.motion)
    assert not something_moves(features, features)
