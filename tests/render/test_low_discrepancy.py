"""Points that spread over the unit square: their rectangles, their independence, and both kinds of arrays."""

import numpy as np
import pytest

from jaxdn.render.mitsuba.variant import choose_variant, use_variant
from jaxdn.render.tracing.low_discrepancy import scatter_points
from jaxdn.render.tracing.seeds import SampleStream

FAST = choose_variant().variant
KEY = SampleStream(3, 4, 0).key()


def points_of(index: np.ndarray, seed: int) -> np.ndarray:
    """[n, 2] in [0, 1), by seeds of one number."""
    seeds = np.random.default_rng(seed).integers(0, 2**32, (3, 1), dtype=np.uint32)
    found = scatter_points(index.astype(np.uint32), (seeds[0], seeds[1], seeds[2]))
    return np.stack(found, axis=-1) * 2.0**-32


@pytest.mark.parametrize("power", [0, 1, 2, 4, 7])
@pytest.mark.parametrize("block", [1, 5])
def test_every_rectangle_of_equal_area_has_one_point(power, block):
    count = 1 << power
    for seed in range(8):
        points = points_of(np.arange(block * count, (block + 1) * count), seed)
        for across in range(power + 1):
            cells = np.floor(points * (1 << across, 1 << (power - across))).astype(int)
            assert len(np.unique(cells, axis=0)) == count, (seed, across)


def test_points_are_uniform_and_two_sets_are_independent():
    index = np.full(1, 6)
    points = np.array([points_of(index, seed)[0] for seed in range(1000)])
    assert np.all(np.abs(points.mean(axis=0) - 0.5) < 4.5 * np.sqrt(1 / 12 / 1000))
    np.testing.assert_allclose(points.var(axis=0), 1 / 12, rtol=0.15)
    assert abs(np.corrcoef(points.T)[0, 1]) < 4.5 / np.sqrt(1000)
    layer = np.arange(16, 32)
    pairs = [np.concatenate([points_of(layer, 2 * n), points_of(layer, 2 * n + 1)], axis=-1) for n in range(100)]
    moments = np.corrcoef(np.concatenate(pairs).T)
    assert np.all(np.abs(moments - np.eye(4)) < 4.5 / np.sqrt(16 * 100))


@pytest.mark.needs("llvm")
def test_both_kinds_of_variants_have_the_same_points():
    use_variant(FAST)
    import mitsuba as mi

    from jaxdn.render.tracing.camera_rays import _spread, draw_lens_points

    pixel, sample = (np.ravel(each) for each in np.indices((50, 21)))
    lanes = [mi.UInt32(each.astype(np.uint32)) for each in (pixel, sample)]
    found = np.stack([np.array(each) for each in _spread(*lanes, KEY, 1)], axis=-1)
    np.testing.assert_array_equal(found, draw_lens_points(pixel, sample, KEY))
