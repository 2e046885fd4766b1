"""The recalled history against loops over pixels in float64, its gradient, and what is no history."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxdn.filters import recall as module
from jaxdn.filters.guides import guides_of
from jaxdn.filters.recall import recall
from jaxdn.frame import Frame
from jaxdn.ops.strips import by_strips

HEIGHT, WIDTH = 7, 9


def drawn(rng):
    """Two surfaces side by side, seen from a little further to the right in the frame before."""
    columns = np.broadcast_to(np.arange(WIDTH), (HEIGHT, WIDTH))
    near = columns < 4
    frame = Frame(
        radiance=np.zeros((HEIGHT, WIDTH, 3)),
        normal=np.where(near[..., None], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]),
        depth=np.where(near, 2.0, 5.0)[..., None],
        ids=near.astype(np.int32)[..., None],
        motion=rng.uniform(-1.5, 1.5, (HEIGHT, WIDTH, 2)),
    )
    return rng.uniform(0.1, 1, (HEIGHT, WIDTH, 2)), frame


def by_loops(history, frame):
    out, valid = np.zeros(history.shape), np.zeros((HEIGHT, WIDTH, 1), bool)
    for row, column in np.ndindex(HEIGHT, WIDTH):
        x, y = np.array([column, row]) + frame.motion[row, column]
        if not (0 <= x <= WIDTH - 1 and 0 <= y <= HEIGHT - 1):
            continue
        left, top = min(int(x), WIDTH - 2), min(int(y), HEIGHT - 2)
        total, weight = np.zeros(history.shape[2]), 0.0
        for b, a in np.ndindex(2, 2):
            share = abs(1 - b - (y - top)) * abs(1 - a - (x - left))
            if frame.ids[top + b, left + a] == frame.ids[row, column]:
                total, weight = total + share * history[top + b, left + a], weight + share
        if weight >= 0.01:
            out[row, column], valid[row, column] = total / weight, True
    return out, valid


def recalled(history, frame, *, first=False, before=None):
    frame = jax.tree.map(jnp.asarray, frame)
    before = guides_of(frame) if before is None else before
    return recall(jnp.asarray(history), before, frame, jnp.asarray(first))


@pytest.mark.parametrize("strip", [5_000, 20])
@pytest.mark.parametrize("guide", ["ids", "normal", "depth"])
def test_it_is_the_mean_of_the_taps_of_the_same_surface(guide, strip, rng, x64, monkeypatch):
    monkeypatch.setattr(module, "_STRIP", strip)
    history, frame = drawn(rng)
    one = Frame(radiance=frame.radiance, motion=frame.motion, **{guide: getattr(frame, guide)})
    found = recalled(history, one)
    wanted, valid = by_loops(history, frame)
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_allclose(found.history, wanted, rtol=1e-12)
    assert 0 < valid.sum() < valid.size


def test_its_gradient(rng, x64):
    history, frame = drawn(rng)
    check_grads(lambda x: recalled(x, frame).history, (jnp.asarray(history),), order=1, modes=["rev"])


def test_without_motion_it_is_the_pixel_itself(rng, x64):
    history, frame = drawn(rng)
    still = recalled(history, frame._replace(motion=None))
    zero = recalled(history, frame._replace(motion=np.zeros((HEIGHT, WIDTH, 2))))
    np.testing.assert_array_equal(still.history, history)
    np.testing.assert_array_equal(zero.history, history)


def test_a_broken_pixel_is_no_tap(rng, x64):
    history, frame = drawn(rng)
    history[3, 2], history[2, 6] = np.nan, -1.0
    found = recalled(history, frame._replace(motion=np.full((HEIGHT, WIDTH, 2), 0.25)))
    assert int(found.broken) == 2
    assert np.isfinite(found.history).all()
    assert found.valid[3, 2]  # from the taps beside it
    still = recalled(history, frame._replace(motion=None))
    assert int(still.broken) == 2
    assert not still.valid[3, 2]
    assert not still.valid[2, 6]


def test_the_first_frame_has_none(rng):
    history, frame = drawn(rng)
    for motion in (None, frame.motion):
        found = recalled(np.full_like(history, np.nan), frame._replace(motion=motion), first=True)
        assert not found.valid.any()
        assert int(found.broken) == 0
        np.testing.assert_array_equal(found.history, 0)


def test_motion_that_is_no_number_means_no_history(rng):
    history, frame = drawn(rng)
    motion = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    motion[1, 1], motion[2, 2] = np.nan, 1e30
    found = recalled(history, frame._replace(motion=motion))
    assert np.argwhere(~found.valid[..., 0]).tolist() == [[1, 1], [2, 2]]
    assert np.isfinite(found.history).all()


@pytest.mark.parametrize("pixels", [1, 12, 63, 1000])
def test_strips_join_to_the_whole(pixels, rng):
    arrays = {"a": rng.random((HEIGHT, WIDTH)), "b": rng.random((HEIGHT, WIDTH, 2))}
    found = by_strips(lambda each: (each["a"] + 1, each["b"].sum(-1)), jax.tree.map(jnp.asarray, arrays), pixels=pixels)
    np.testing.assert_allclose(found[0], arrays["a"] + 1, rtol=1e-6)
    np.testing.assert_allclose(found[1], arrays["b"].sum(-1), rtol=1e-6)
