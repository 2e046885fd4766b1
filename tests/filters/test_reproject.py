"""The recalled history against loops over pixels in float64, its gradient, and what is no history."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.filters import reproject as module
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import Guides, guides_of
from jaxdn.ops.dispatch.row_tiles import map_row_tiles
from tests.gradients import check_gradients

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


def by_loops(history, frame, *, search_neighbours=False):
    """The definition, pixel by pixel."""
    out, valid = np.zeros(history.shape), np.zeros((HEIGHT, WIDTH, 1), bool)

    def accepted(y, x, pixel):
        return 0 <= y < HEIGHT and 0 <= x < WIDTH and frame.ids[y, x] == frame.ids[pixel]

    for row, column in np.ndindex(HEIGHT, WIDTH):
        x, y = np.array([column, row]) + frame.motion[row, column]
        if not (-1 < x < WIDTH and -1 < y < HEIGHT):
            continue
        x, y = np.clip(x, 0, WIDTH - 1), np.clip(y, 0, HEIGHT - 1)
        left, top = int(x), int(y)
        taps = {(top + b, left + a): abs(1 - b - (y - top)) * abs(1 - a - (x - left)) for b, a in np.ndindex(2, 2)}
        taps = {at: share for at, share in taps.items() if share > 0 and accepted(*at, (row, column))}
        if search_neighbours and sum(taps.values()) < 0.01:
            middle = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
            near = [(middle[0] + b - 1, middle[1] + a - 1) for b, a in np.ndindex(3, 3)]
            taps = {at: 1.0 for at in near if accepted(*at, (row, column))}
        if sum(taps.values()) >= 0.01:
            out[row, column] = sum(share * history[at] for at, share in taps.items()) / sum(taps.values())
            valid[row, column] = True
    return out, valid


def recalled(history, frame, *, first=False, search_neighbours=False):
    return program(search_neighbours, module._TILE_PIXELS)(history, guides_of(frame), frame, first)


@functools.cache
def program(search_neighbours, tile):
    """``recall``, compiled once for each set of buffers while a tile has so many pixels."""
    return jax.jit(lambda *given: reproject(*given, search_neighbours=search_neighbours))


@pytest.mark.parametrize("search_neighbours", [False, True])
@pytest.mark.parametrize("tile", [5_000, 20])
@pytest.mark.parametrize("guide", ["ids", "normal", "depth"])
def test_it_is_the_mean_of_the_taps_of_the_same_surface(guide, tile, search_neighbours, rng, x64, monkeypatch):
    monkeypatch.setattr(module, "_TILE_PIXELS", tile)
    history, frame = drawn(rng)
    one = Frame(radiance=frame.radiance, motion=frame.motion, **{guide: getattr(frame, guide)})
    found = recalled(history, one, search_neighbours=search_neighbours)
    wanted, valid = by_loops(history, frame, search_neighbours=search_neighbours)
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_allclose(found.history, wanted, rtol=1e-12)
    assert 0 < valid.sum() < valid.size
    assert search_neighbours == (valid.sum() > by_loops(history, frame)[1].sum())


@pytest.mark.slow
@pytest.mark.parametrize("search_neighbours", [False, True])
def test_its_gradient(search_neighbours, rng, x64):
    history, frame = drawn(rng)
    function = jax.jit(lambda x: recalled(x, frame, search_neighbours=search_neighbours).history)
    check_gradients(function, (jnp.asarray(history),))
    gradient = jax.grad(lambda x: function(x).sum())(jnp.asarray(history))
    np.testing.assert_allclose(
        gradient.sum(), 2 * recalled(history, frame, search_neighbours=search_neighbours).valid.sum()
    )


def test_an_image_smaller_than_the_places_around(rng, x64):
    history, frame = drawn(rng)
    small = jax.tree.map(lambda one: one[:2, :2], frame)._replace(ids=np.array([[[0], [1]], [[1], [1]]]))

    @jax.jit
    @functools.partial(jax.grad, has_aux=True)
    def summed(history, *rest):
        found = reproject(history, *rest, search_neighbours=True)
        return found.history.sum(), found

    for vector in ([0.0, 0.0], [0.4, 0.0], [-0.6, 0.7]):
        moving = small._replace(motion=np.broadcast_to(np.array(vector), (2, 2, 2)), depth=None, normal=None)
        before = guides_of(moving)._replace(ids=np.array([[[1.0], [1]], [[1], [0]]]))
        slope, found = jax.tree.map(np.asarray, summed(history[:2, :2], before, moving, False))
        assert found.valid.all()  # every place is near
        np.testing.assert_array_equal(found.history[0, 0], history[1, 1])  # the only pixel of its kind
        np.testing.assert_allclose(slope.sum(), 8.0)


def test_around_a_pixel_that_shows_something_else(rng, x64):
    history, frame = drawn(rng)
    zero = frame._replace(motion=np.zeros((HEIGHT, WIDTH, 2)), depth=None, normal=None)
    before = frame.ids.astype(float)
    changed = zero._replace(ids=frame.ids.copy())
    changed.ids[3, 5] = 1  # appears where there was nothing of its kind near by

    def found(before, frame, search_neighbours=True):
        run = program(search_neighbours, module._TILE_PIXELS)
        return jax.tree.map(np.asarray, run(history, Guides(None, None, before), frame, False))

    assert not found(before, changed, search_neighbours=False).valid[3, 5]
    assert not found(before, changed).valid[3, 5]
    before[2, 4] = 1
    np.testing.assert_array_equal(found(before, changed).history[3, 5], history[2, 4])
    still, moving = (found(before, changed._replace(motion=m)) for m in (None, changed.motion))
    np.testing.assert_array_equal(still.valid, moving.valid)
    np.testing.assert_allclose(still.history, moving.history, rtol=1e-12)


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
    assert int(found.invalid) == 2
    assert np.isfinite(found.history).all()
    assert found.valid[3, 2]  # from the taps beside it
    still = recalled(history, frame._replace(motion=None))
    assert int(still.invalid) == 2
    assert not still.valid[3, 2]
    assert not still.valid[2, 6]


@pytest.mark.slow
def test_the_first_frame_has_none(rng):
    history, frame = drawn(rng)
    for motion in (None, frame.motion):
        found = recalled(np.full_like(history, np.nan), frame._replace(motion=motion), first=True)
        assert not found.valid.any()
        assert int(found.invalid) == 0
        np.testing.assert_array_equal(found.history, 0)


def test_motion_that_is_no_number_means_no_history(rng):
    history, frame = drawn(rng)
    motion = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    motion[1, 1], motion[2, 2] = np.nan, 1e30
    found = recalled(history, frame._replace(motion=motion))
    assert np.argwhere(~np.asarray(found.valid)[..., 0]).tolist() == [[1, 1], [2, 2]]
    assert np.isfinite(found.history).all()


@pytest.mark.parametrize("pixels", [1, 12, 63, 1000])
def test_tiles_join_to_the_whole(pixels, rng):
    arrays = {"a": rng.random((HEIGHT, WIDTH)), "b": rng.random((HEIGHT, WIDTH, 2))}
    found = map_row_tiles(
        lambda each: (each["a"] + 1, each["b"].sum(-1)), jax.tree.map(jnp.asarray, arrays), pixels=pixels
    )
    np.testing.assert_allclose(found[0], arrays["a"] + 1, rtol=1e-6)
    np.testing.assert_allclose(found[1], arrays["b"].sum(-1), rtol=1e-6)
