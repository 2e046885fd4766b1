"""The script that measures deviations from invariances: a filter that has them has none, one that does not has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.stability.invariances import INVARIANCES, measure_deviations
from jaxdn.core.frame import Clip, Frame
from jaxdn.denoiser import Core, recurrent


@pytest.fixture
def clip(rng):
    light = rng.uniform(0.1, 1.0, (2, 8, 12, 3)).astype(np.float32)
    normal = rng.standard_normal((2, 8, 12, 3)).astype(np.float32)
    return Clip(Frame(light, albedo=0.5 * light, normal=normal, motion=light[..., :2]), light)


def filter_of(change, *reads):
    def step(params, state, frame, first, statistics):
        return state, change(frame), 0

    return recurrent(Core(lambda params, frame: jnp.zeros(()), step, reads))


def test_every_change_is_changed_back(clip):
    found = measure_deviations(filter_of(lambda frame: frame.radiance), {}, clip)
    assert set(found) == {*INVARIANCES, "error"}
    assert max(found.values()) < 1e-6


@pytest.mark.parametrize("name", [name for name in INVARIANCES if name.startswith("mirrored")])
def test_mirroring_twice_is_the_identity(clip, name):
    change = INVARIANCES[name].change
    jax.tree.map(np.testing.assert_array_equal, change(change(clip)), clip)


@pytest.mark.parametrize(
    ("broken", "change", "reads"),
    [
        ("mirrored left to right", lambda frame: jnp.roll(frame.radiance, 1, axis=1), ()),
        ("mirrored top to bottom", lambda frame: jnp.roll(frame.radiance, 1, axis=0), ()),
        ("red, green and blue exchanged", lambda frame: frame.radiance * jnp.array([1.0, 1.0, 0.5])[None, None], ()),
        ("red, green and blue exchanged", lambda frame: frame.radiance * frame.albedo[..., :1], ("albedo",)),
        ("the world's axes exchanged", lambda frame: jnp.abs(frame.normal), ("normal",)),
        ("four times the light", lambda frame: jnp.sqrt(frame.radiance), ()),
        ("mirrored left to right", lambda frame: jnp.exp(frame.motion[..., :1]) * frame.radiance, ("motion",)),
    ],
)
def test_a_filter_that_breaks_a_law_is_found(clip, broken, change, reads):
    with jax.numpy_rank_promotion("allow"):
        found = measure_deviations(filter_of(change, *reads), {}, clip)
    assert found[broken] > 0.05
