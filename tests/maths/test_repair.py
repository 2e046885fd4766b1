"""The repair of a frame: normals of any length, and the count of what was replaced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.frame import FAR, RADIANCE_MAX, Frame
from jaxdn.repair import repair

repaired = jax.jit(repair)


def frame(size=4, **buffers):
    light = np.full((size, size, 3), 0.5, np.float32)
    return Frame(radiance=light, **buffers)


def test_normals_of_every_length_become_unit_and_keep_their_direction():
    lengths = np.float32([10.0**exponent for exponent in range(-5, 39)] + [1e38, 2e38, 3e38])
    directions = np.float32([[1, 0, 0], [1, 1, 1], [0.2, -0.9, 0.1]])
    normal = lengths[:, None, None] * directions
    light = np.zeros(normal.shape, np.float32)
    found, count = repaired(Frame(radiance=light, normal=normal))
    exact = directions / np.linalg.norm(directions.astype(np.float64), axis=-1, keepdims=True)
    np.testing.assert_allclose(found.normal, np.broadcast_to(exact, normal.shape), atol=3e-7)
    assert count == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_normal_with_something_that_is_no_number_is_no_normal(bad):
    normal = np.broadcast_to(np.float32([0, 0, 1]), (4, 4, 3)).copy()
    normal[1, 2, 0] = bad
    found, count = repaired(frame(normal=normal))
    np.testing.assert_array_equal(found.normal[1, 2], 0)
    np.testing.assert_array_equal(found.normal[0, 0], [0, 0, 1])
    assert count == 1


def test_every_buffer_that_had_to_be_changed_is_counted():
    rng = np.random.default_rng(0)
    shape = (6, 5)
    buffers = {
        "radiance": rng.choice(np.float32([0.5, np.nan, -1, 1e30]), (*shape, 3)),
        "direct": rng.choice(np.float32([0.5, np.inf]), (*shape, 3)),
        "albedo": rng.choice(np.float32([0.5, 1.5, np.nan]), (*shape, 3)),
        "depth": rng.choice(np.float32([0.5, FAR, 1e20, np.nan, -1]), (*shape, 1)),
        "roughness": rng.choice(np.float32([0.5, -0.5]), (*shape, 1)),
        "motion": rng.choice(np.float32([0.5, np.nan]), (*shape, 2)),
    }
    found, count = repaired(Frame(**buffers))
    light = sum(
        int(np.sum(~((buffers[name] >= 0) & (buffers[name] <= RADIANCE_MAX)))) for name in ("radiance", "direct")
    )
    fractions = sum(int(np.sum(~((buffers[name] >= 0) & (buffers[name] <= 1)))) for name in ("albedo", "roughness"))
    depths = int(np.sum(~((buffers["depth"] >= 0) & (buffers["depth"] <= 1e9))))
    vectors = int(np.sum(~np.isfinite(buffers["motion"]).all(axis=-1)))
    assert count == light + fractions + depths + vectors
    assert count.dtype == jnp.int32
    for name in ("radiance", "direct", "albedo", "depth", "roughness"):
        assert np.isfinite(getattr(found, name)).all(), name


def test_the_count_is_of_one_type_in_double_precision_too(x64):
    found, count = repaired(frame(depth=np.full((4, 4, 1), np.nan)))
    assert found.depth.dtype == jnp.float64
    assert count.dtype == jnp.int32
    assert count == 16
