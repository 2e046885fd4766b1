"""The table of buffers: it has the Frame's fields, and None equals the documented neutral value."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import BUFFERS, GUIDES, Frame, frame_at, only, present, written_out
from jaxdn.filters.surface_test import surface_mask

SIZE = (4, 5)
NUMBERS = [np, jnp]
CHAINS = {
    "dual_motion": "motion",
    "previous_depth": "depth",
    "reflectance": "albedo",
    "ray_length": "depth",
    "far_motion": "motion",
    "unshadowed": "shadowed",
    "shadow_motion": "motion",
    "glossy_motion": "motion",
}
ENDS = {"albedo": 1, "roughness": 1, "visible": 1, "sample_count": 1, "reflectance": 1, "ids": 2**31 - 1}
"""The neutral values that are not 0, from the docstrings of the fields."""


def values_of(name, rng, shape=SIZE):
    buffer = BUFFERS[name]
    return rng.uniform(2, 3, (*shape, buffer.channels)).astype(buffer.dtype)


def light(numbers, dtype=np.float32, shape=SIZE):
    return numbers.ones((*shape, 3), dtype)


def test_the_table_is_the_frames_fields():
    assert tuple(BUFFERS) == Frame._fields
    assert next(iter(BUFFERS)) == "radiance"
    assert Frame._fields[1:] == GUIDES
    assert "radiance" not in Frame._field_defaults
    assert all(default is None for default in Frame._field_defaults.values())
    assert set(Frame._field_defaults) == set(GUIDES)


@pytest.mark.parametrize("name", BUFFERS)
def test_a_row_can_be_stored_and_read(name):
    buffer = BUFFERS[name]
    assert len(buffer.letters) == len(set(buffer.letters)) == buffer.channels
    bytes_each = {"half": 2, "single": 4, "flag": 2, "id": 4}[buffer.stored]
    assert buffer.bytes == bytes_each * buffer.channels
    expected = {"flag": np.bool_, "id": np.int32}.get(buffer.kind, np.float32)
    assert buffer.dtype == np.dtype(expected)
    assert buffer.channels == {"light": 3, "direction": 3, "distance": 1, "flag": 1, "id": 1}.get(
        buffer.kind, buffer.channels
    )


def test_a_neutral_value_is_taken_from_a_buffer_declared_before_of_the_same_kind():
    names = list(BUFFERS)
    for name, buffer in BUFFERS.items():
        if isinstance(buffer.neutral, str):
            source = BUFFERS[buffer.neutral]
            assert names.index(buffer.neutral) < names.index(name)
            assert (source.kind, source.channels) == (buffer.kind, buffer.channels)
    assert {name: buffer.neutral for name, buffer in BUFFERS.items() if isinstance(buffer.neutral, str)} == CHAINS


@pytest.mark.parametrize("numbers", NUMBERS)
@pytest.mark.parametrize("name", GUIDES)
def test_none_written_out_is_its_neutral_value(name, numbers):
    frame = written_out(Frame(light(numbers)), [name])
    assert present(frame) == (name,)
    found, buffer = getattr(frame, name), BUFFERS[name]
    assert isinstance(found, np.ndarray if numbers is np else jax.Array)
    assert found.shape == (*SIZE, buffer.channels)
    assert found.dtype == buffer.dtype
    np.testing.assert_array_equal(found, ENDS.get(name, 0))


def test_written_out_ids_are_a_surface():
    """As no ids are: filters leave out pixels without one."""
    assert surface_mask(None, written_out(Frame(light(np)), ["ids"]).ids).all()


@pytest.mark.parametrize("numbers", NUMBERS)
@pytest.mark.parametrize(("name", "source"), CHAINS.items())
def test_a_neutral_value_follows_its_chain(name, source, numbers, rng):
    there = numbers.asarray(values_of(source, rng))
    frame = written_out(Frame(light(numbers), **{source: there}), [name])
    np.testing.assert_array_equal(getattr(frame, name), there)
    assert set(present(frame)) == {name, source}
    # Where the source is absent too, both are the source's neutral value.
    both = written_out(Frame(light(numbers)), [name, source])
    np.testing.assert_array_equal(getattr(both, name), ENDS.get(source, 0))
    np.testing.assert_array_equal(getattr(both, name), getattr(both, source))


@pytest.mark.parametrize("numbers", NUMBERS)
def test_all_absent_buffers_are_written_out_and_present_ones_stay(numbers, rng):
    there = {name: numbers.asarray(values_of(name, rng)) for name in ("motion", "ids", "normal")}
    frame = written_out(Frame(light(numbers), **there), GUIDES)
    assert present(frame) == GUIDES
    for name, values in there.items():
        assert getattr(frame, name) is values
    for name in ("dual_motion", "shadow_motion", "glossy_motion"):
        np.testing.assert_array_equal(getattr(frame, name), there["motion"])


@pytest.mark.parametrize("numbers", NUMBERS)
def test_a_clips_frames_are_written_out_with_their_time_axis(numbers):
    frames = written_out(Frame(light(numbers, shape=(3, *SIZE))), ["albedo", "ids", "motion"])
    assert frames.albedo.shape == (3, *SIZE, 3)
    assert frames.ids.shape == (3, *SIZE, 1)
    assert frame_at(frames, 1).motion.shape == (*SIZE, 2)


def test_written_out_buffers_have_the_radiances_precision_except_flags_and_ids():
    frame = written_out(Frame(light(np, np.float16)), GUIDES)
    for name in GUIDES:
        kind = BUFFERS[name].kind
        assert getattr(frame, name).dtype == (BUFFERS[name].dtype if kind in ("flag", "id") else np.float16), name


def test_written_out_under_jit_is_the_same(rng):
    frame = Frame(light(jnp), motion=jnp.asarray(values_of("motion", rng)))
    plain, compiled = written_out(frame, GUIDES), jax.jit(lambda frame: written_out(frame, GUIDES))(frame)
    jax.tree.map(np.testing.assert_array_equal, plain, compiled)


def test_only_keeps_the_radiance_and_what_is_named(rng):
    frame = written_out(Frame(light(np)), GUIDES)
    left = only(frame, frozenset({"ids", "albedo"}))
    assert present(left) == ("albedo", "ids")  # in the order of the table
    assert left.radiance is frame.radiance
    assert left.albedo is frame.albedo
    assert present(only(frame, frozenset())) == ()
    assert present(only(frame, frozenset(GUIDES))) == GUIDES
    assert present(only(left, frozenset({"motion"}))) == ()
