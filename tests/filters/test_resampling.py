"""What a fetch may err by: against float64 NumPy, against real fetches, and where surfaces meet."""

import jax
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.filters.catmull_rom import warp_cubic
from jaxdn.filters.resampling import find_whole, measure_fetch_error
from jaxdn.ops.warp import warp

measure = jax.jit(measure_fetch_error)

SIZE = (18, 22)


def four_weights(f, cubic):
    """Of the pixels -1, 0, 1, 2, each a piecewise polynomial of the distance (Keys 1981)."""
    x = np.abs(np.arange(-1, 3) - f)
    if not cubic:
        return np.maximum(1 - x, 0)
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x < 1, near, np.where(x < 2, far, 0))


def error_in_numpy(image, albedo, share, motion, cubic, whole):
    """Pixel by pixel: a fetch there, and one back, of a patch in which the motion is the middle pixel's."""
    _, height, width = image.shape
    planes = np.concatenate([image, albedo])
    wide = np.pad(planes, ((0, 0), (4, 4), (4, 4)), mode="edge")

    def square(pixel, y, x):
        change = (albedo[:, y, x] - pixel[3:]) / (np.maximum(pixel[3:], 0) + 0.02)
        return np.mean((image[:, y, x] - pixel[:3] * (1 + share[y, x] * change)) ** 2)

    blurred, mixed = np.zeros((2, height, width))
    for y, x in np.ndindex(height, width):
        down, across = (
            np.convolve(four, four[::-1])
            for four in (four_weights(motion[y, x, axis] % 1, cubic[y, x]) for axis in (1, 0))
        )
        patch = wide[:, y + 1 : y + 8, x + 1 : x + 8]
        blurred[y, x] = square(np.einsum("cyx,y,x->c", patch, down, across), y, x)
        near = [wide[:, y + 4 + dy, x + 4 + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        rows, columns = (np.clip(at + np.arange(-1, 2), 0, size - 1) for at, size in ((y, height), (x, width)))
        way = np.max(np.sum((motion[np.ix_(rows, columns)] - np.round(motion[y, x])) ** 2, axis=-1))
        target = np.array([x, y]) + motion[y, x]
        beyond = max(0, *-target, *(target - [width - 1, height - 1]))
        mixed[y, x] = 2 * min(max(way, beyond**2), 1) * sum(square(each, y, x) for each in near) / 8
        mixed[y, x] *= beyond > 0 or not whole[y, x]
    high = np.pad(blurred, 1, constant_values=-np.inf)
    most = np.max([high[dy : dy + height, dx : dx + width] for dy, dx in np.ndindex(3, 3)], axis=0)
    return np.maximum(most, mixed)


def test_it_is_what_its_equations_say(rng, x64):
    """With one motion for all, where two passes are exact, and with whole pixels of motion, in every pixel others."""
    image, albedo = rng.uniform(0, 2, (3, *SIZE)), rng.uniform(0, 1, (3, *SIZE))
    motion = np.broadcast_to([0.3, -1.6], (*SIZE, 2)).copy()
    for cubic in (np.zeros(SIZE, bool), np.ones(SIZE, bool)):
        arguments = image, albedo, rng.random(SIZE), motion, cubic, rng.random(SIZE) > 0.3
        found = measure(*arguments)
        np.testing.assert_allclose(found, error_in_numpy(*arguments), rtol=1e-9, atol=1e-12)
    arguments = image, albedo, rng.random(SIZE), rng.integers(-1, 2, (*SIZE, 2)) * 1.0, cubic, np.zeros(SIZE, bool)
    found = measure(*arguments)
    np.testing.assert_allclose(found, error_in_numpy(*arguments), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("cubic", [True, False])
@pytest.mark.parametrize("step", [0.1, 0.3, 0.5, 0.8])
def test_a_real_fetch_errs_by_no_more(cubic, step):
    """On waves of all lengths and phases: the mean square of what a fetch of the shifted wave misses.

    What is said of cubics leaves out that they shift the finest waves by too little: a third of the error is left.
    """
    columns = np.arange(64.0)
    for length in (2.0, 2.5, 3.0, 4.0, 6.0, 12.0):
        errors, bounds = [], []
        for phase in np.arange(8) / 8 * np.pi:
            rows = [np.cos(2 * np.pi * (columns + shift) / length + phase) + 1 for shift in (0.0, step)]
            before, now = (np.broadcast_to(row[None, :, None], (5, 64, 3)).astype(np.float32) for row in rows)
            motion = np.broadcast_to([step, 0.0], (5, 64, 2))
            fetched = np.asarray(jax.jit(warp_cubic if cubic else warp)(before, motion))
            errors.append(np.mean((fetched - now)[2, 8:-8] ** 2))
            flags = np.full((5, 64), cubic), np.ones((5, 64), bool)
            bound = measure(now.transpose(2, 0, 1), None, np.zeros((5, 64)), motion, *flags)
            bounds.append(np.mean(np.asarray(bound)[2, 8:-8]))
        assert np.mean(errors) < (9 if cubic else 1.1) * np.mean(bounds) + 1e-5, length


def test_what_moves_by_whole_pixels_is_not_blurred(rng):
    image = rng.uniform(0, 1, (3, *SIZE))
    motion = np.broadcast_to([2.0, -1.0], (*SIZE, 2))
    for whole in (True, False):
        flags = np.ones(SIZE, bool), np.full(SIZE, whole)
        found = np.asarray(measure(image, None, np.zeros(SIZE), motion, *flags))
        np.testing.assert_allclose(found[1:, :-2], 0, atol=1e-12)
        assert (found[0] > 0).all(), "what was beyond the border was not seen"


def test_pixels_at_silhouettes_and_creases_are_not_whole():
    ids = np.zeros((*SIZE, 1), np.int32)
    ids[5:9, 6:12] = 1
    normal = np.broadcast_to(np.float32([0, 0, 1]), (*SIZE, 3)).copy()
    normal[:, 16:] = [1, 0, 0]
    depth = np.full((*SIZE, 1), 3.0, np.float32)
    depth[14:] = 9.0
    expected = np.ones(SIZE, bool)
    expected[4:10, 5:13] = False
    expected[6:8, 7:11] = True
    expected[:, 15:17] = False
    expected[13:15] = False
    find = jax.jit(find_whole)
    found = find(Frame(np.zeros((*SIZE, 3), np.float32), normal=normal, depth=depth, ids=ids))
    np.testing.assert_array_equal(found, expected)
    assert np.asarray(find(Frame(np.zeros((*SIZE, 3), np.float32)))).all()
