"""The sanitizing of a frame, by the kind of each buffer, and the count of what was replaced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxdn.core.frame import BUFFERS, FAR, RADIANCE_MAX, Frame
from jaxdn.denoiser.sanitize import sanitize

sanitized = jax.jit(sanitize)


def frame(size=4, **buffers):
    light = np.full((size, size, 3), 0.5, np.float32)
    return Frame(radiance=light, **buffers)


def test_normals_of_every_length_become_unit_and_keep_their_direction():
    lengths = np.float32([10.0**exponent for exponent in range(-5, 39)] + [1e38, 2e38, 3e38])
    directions = np.float32([[1, 0, 0], [1, 1, 1], [0.2, -0.9, 0.1]])
    normal = lengths[:, None, None] * directions
    light = np.zeros(normal.shape, np.float32)
    found, count = sanitized(Frame(radiance=light, normal=normal))
    exact = directions / np.linalg.norm(directions.astype(np.float64), axis=-1, keepdims=True)
    np.testing.assert_allclose(found.normal, np.broadcast_to(exact, normal.shape), atol=3e-7)
    assert count == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_normal_with_a_non_finite_component_becomes_zero(bad):
    normal = np.broadcast_to(np.float32([0, 0, 1]), (4, 4, 3)).copy()
    normal[1, 2, 0] = bad
    found, count = sanitized(frame(normal=normal))
    np.testing.assert_array_equal(found.normal[1, 2], 0)
    np.testing.assert_array_equal(found.normal[0, 0], [0, 0, 1])
    assert count == 1


def test_every_sanitized_buffer_is_counted():
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
    found, count = sanitized(Frame(**buffers))
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
    found, count = sanitized(frame(depth=np.full((4, 4, 1), np.nan)))
    assert found.depth.dtype == jnp.float64
    assert count.dtype == jnp.int32
    assert count == 16


SPECIAL = (np.nan, np.inf, -np.inf, -0.0, 0.0, 1e-37, -1e-37, 1.0, -1.0, 0.5, 1.5, 7e4, -7e4, 1e9, 2e9, 3e38, -3e38)
NEUTRAL_ONE = {"albedo", "roughness", "reflectance"}
"""Fractions whose neutral value is 1; the others have 0."""
BOUNDS = {
    "light": (0, RADIANCE_MAX),
    "signed": (-RADIANCE_MAX, RADIANCE_MAX),
    "fraction": (0, 1),
    "count": (0, np.inf),
    "direction": (-1, 1),
    "distance": (0, 1e9),
}


def numpy_sanitize(values, name):
    """In float64: the result, and how many values were replaced."""
    values, kind = np.asarray(values, np.float64), BUFFERS[name].kind
    finite = np.isfinite(values)
    if kind == "vector":
        known = finite.all(axis=-1, keepdims=True)
        return np.where(known, values, np.nan), np.sum(~known)
    if kind == "direction":
        length = np.linalg.norm(np.where(finite, values, 0), axis=-1, keepdims=True)
        usable = finite.all(axis=-1, keepdims=True) & (np.abs(values).max(axis=-1, keepdims=True) > 1e-6)
        return np.where(usable, values, 0) / np.where(usable, length, 1), np.sum(~finite)
    low, high = BOUNDS[kind]
    unknown = ~finite | ((values < 0) & (kind in ("light", "count", "distance")))
    # Only an infinite distance has a meaning: it is beyond all others.
    instead = np.where(values == np.inf, 1e9 if kind == "distance" else 0, 0) + (kind == "fraction") * (
        name in NEUTRAL_ONE
    )
    right = finite & (values >= low) & (values <= high)
    if kind == "distance":
        values = np.where((values >= 999_424) & (values < FAR), FAR, values)
    return np.clip(np.where(unknown, instead, values), low, high), np.sum(~right)


def partly_broken(seed, name, dtype=np.float32):
    """Values of all magnitudes with special ones in between."""
    rng = np.random.default_rng([seed, *name.encode()])
    shape = (6, 5, BUFFERS[name].channels)
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 6, shape)
    with np.errstate(over="ignore", under="ignore"):
        return np.where(rng.random(shape) < 0.4, rng.choice(SPECIAL, shape), values).astype(dtype)


def sanitized_buffer(name, values):
    """One buffer sanitized, and the count; radiance is valid unless it is that buffer."""
    given = frame(6) if name == "radiance" else Frame(np.full((6, 5, 3), 0.5, np.float32))
    found, count = sanitized(given._replace(**{name: values}))
    return np.asarray(getattr(found, name)), int(count)


NUMBERS = [name for name, buffer in BUFFERS.items() if buffer.kind not in ("flag", "id")]


def test_every_kind_is_tested():
    assert {BUFFERS[name].kind for name in NUMBERS} == {*BOUNDS, "vector"}
    assert {"luminance_gradient", "sample_count", "specular_reflectance"} <= set(NUMBERS)
    fractions = {name for name in NUMBERS if BUFFERS[name].kind == "fraction"}
    assert fractions - NEUTRAL_ONE == {"specular_reflectance"}


@pytest.mark.parametrize("name", NUMBERS)
@given(seed=st.integers(0, 2**16))
def test_sanitize_is_the_numpy_one(name, seed):
    values = partly_broken(seed, name)
    found, count = sanitized_buffer(name, values)
    expected, replaced = numpy_sanitize(values, name)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 if BUFFERS[name].kind == "direction" else 1e-37)
    assert count == replaced


@pytest.mark.parametrize("name", NUMBERS)
@given(seed=st.integers(0, 2**16))
def test_sanitized_values_are_in_bounds_and_stable(name, seed):
    """A second sanitizing counts nothing, except non-finite vectors: they stay and mean that there is no history."""
    kind = BUFFERS[name].kind
    found, count = sanitized_buffer(name, partly_broken(seed, name))
    again, recount = sanitized_buffer(name, found)
    if kind == "direction":
        np.testing.assert_allclose(again, found, atol=2e-7)
        length = np.linalg.norm(found.astype(np.float64), axis=-1)
        np.testing.assert_allclose(length[length > 0], 1, rtol=1e-6)
    else:
        np.testing.assert_array_equal(again, found)
    if kind == "vector":
        broken = np.isnan(found)
        assert (broken[..., 0] == broken[..., 1]).all()
        assert recount == count == broken[..., 0].sum()
        return
    low, high = BOUNDS[kind]
    assert np.isfinite(found).all()
    assert (found >= low - 1e-6 * (kind == "direction")).all()
    assert (found <= high + 1e-6 * (kind == "direction")).all()
    assert recount == 0


@pytest.mark.parametrize("name", NUMBERS)
def test_valid_values_stay_bit_for_bit_and_are_not_counted(name, rng):
    kind, shape = BUFFERS[name].kind, (6, 5, BUFFERS[name].channels)
    if kind == "direction":
        values = rng.choice([0.0, 1.0, -1.0], (6, 5, 1)) * np.array([[[0.0, 1.0, 0.0]]])
    else:
        low = {"signed": -5, "vector": -5}.get(kind, 0)
        values = rng.uniform(low, 1 if kind == "fraction" else 5, shape)
        values[0, 0] = BOUNDS.get(kind, (0, 0))[0]
    found, count = sanitized_buffer(name, values.astype(np.float32))
    np.testing.assert_array_equal(found, values.astype(np.float32))
    assert count == 0


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16, np.int32])
@pytest.mark.parametrize("name", ["radiance", "luminance_gradient", "sample_count", "albedo"])
def test_narrow_numbers_are_widened(name, dtype, rng):
    values = rng.integers(0, 2, (6, 5, BUFFERS[name].channels)).astype(dtype)
    found, count = sanitized_buffer(name, values)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, values.astype(np.float32))
    assert count == 0


@pytest.mark.parametrize("name", ["depth", "previous_depth"])
def test_no_surface_stays_none_in_half_precision(name):
    """bfloat16 holds 1e6 as 999,424, float16 as infinity."""
    for dtype in (jnp.bfloat16, np.float16, np.float32):
        with np.errstate(over="ignore"):
            found, _ = sanitized_buffer(name, np.full((6, 5, 1), FAR).astype(dtype))
        assert (found >= FAR).all(), dtype
    near, count = sanitized_buffer(name, np.full((6, 5, 1), 990_000, np.float32))
    assert (near == 990_000).all()
    assert count == 0


def test_flags_and_ids_stay_unchanged(rng):
    ids, visible = rng.integers(-5, 2**24, (4, 4, 1)).astype(np.int32), rng.random((4, 4, 1)) < 0.5
    found, count = sanitized(frame(ids=ids, visible=visible))
    np.testing.assert_array_equal(found.ids, ids)
    np.testing.assert_array_equal(found.visible, visible)
    assert (found.ids.dtype, found.visible.dtype, int(count)) == (jnp.int32, jnp.bool_, 0)


def test_gradients_through_the_sanitize_are_finite_and_zero_where_it_replaced():
    for name in NUMBERS:
        values = jnp.asarray(partly_broken(0, name))
        valid = Frame(jnp.full((6, 5, 3), 0.5))

        def total(values, name=name, valid=valid):
            return jnp.nansum(getattr(sanitize(valid._replace(**{name: values}))[0], name))

        slope = np.asarray(jax.jit(jax.grad(total))(values))
        assert np.isfinite(slope).all(), name
        assert not slope[~np.isfinite(values)].any(), name
