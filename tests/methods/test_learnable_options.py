"""Options that training moves: within their ranges, from their declared values, one number for each level."""

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxdn.core.frame import Clip, Frame, frame_at
from jaxdn.core.options import Range
from jaxdn.denoiser.rollout import denoise
from jaxdn.methods.learnable_options import LEARNABLE, LEARNABLE_PER_LEVEL, apply_offsets, at_level, zero_offsets
from jaxdn.methods.registry import methods


@dataclass(frozen=True)
class Toy:
    share: Annotated[float, Range(0, 1, without_low=True), LEARNABLE] = 0.2
    sigma: Annotated[float, Range(0, without_low=True), LEARNABLE_PER_LEVEL] = 4.0
    radius: Annotated[float, Range(1), LEARNABLE] = 3.0
    absent: Annotated[float | None, Range(0), LEARNABLE] = None
    levels: int = 3
    fixed: float = 5.0


def test_before_training_nothing_is_moved():
    params = zero_offsets(Toy())
    assert {name: array.shape for name, array in params.items()} == {"share": (), "sigma": (3,), "radius": ()}
    assert "sigma" not in zero_offsets(Toy(levels=0))
    found = apply_offsets(Toy(), params)
    np.testing.assert_allclose([found.share, found.radius, *found.sigma], [0.2, 3.0, 4.0, 4.0, 4.0], rtol=1e-6)
    assert apply_offsets(Toy(), {}) == Toy()
    assert apply_offsets(Toy(), {"radius": jnp.zeros(())}).share == 0.2


@given(st.floats(-60, 60), st.floats(0.001, 1.0))
def test_no_parameter_leaves_its_range(offset, share):
    found = apply_offsets(Toy(share=share), {"share": jnp.asarray(offset), "radius": jnp.asarray(offset)})
    assert 0.0 <= float(found.share) <= 1.0
    assert float(found.radius) >= 1.0
    odds = np.exp(np.float64(offset)) * np.float64(share) / max(1.0 - share, 1e-300)
    np.testing.assert_allclose(float(found.share), odds / (1.0 + odds), rtol=1e-4, atol=1e-30)
    np.testing.assert_allclose(float(found.radius), 1.0 + 2.0 * np.exp(np.float64(offset)), rtol=1e-5)


def test_an_option_at_the_end_of_its_range_stays_there_and_its_gradient_is_finite():
    value, slope = jax.value_and_grad(lambda x: apply_offsets(Toy(share=1.0), {"share": x}).share)(jnp.asarray(2.0))
    assert (float(value), float(slope)) == (1.0, 0.0)


def test_levels_have_values_of_their_own():
    found = apply_offsets(Toy(), {"sigma": jnp.log(jnp.asarray([0.5, 1.0, 2.0]))})
    np.testing.assert_allclose([at_level(found.sigma, level) for level in range(3)], [2.0, 4.0, 8.0], rtol=1e-6)
    assert at_level(Toy().sigma, 2) == 4.0


def test_an_option_that_is_not_learned_is_refused():
    with pytest.raises(ValueError, match="expected params out of share, sigma, radius, got 'fixed'"):
        apply_offsets(Toy(), {"fixed": jnp.zeros(())})


FILTERS = [name for name, row in methods().items() if row.filter and row.learns]
BESIDE_LIGHT = {"svgf", "relax", "reblur", "trmv"}
"""Their own tests have this gradient: of several kinds of light in one program with that by light."""


@pytest.mark.parametrize("name", FILTERS)
def test_filters_begin_at_their_options(name):
    options, frame = methods()[name].parse_options({}), Frame(np.ones((8, 9, 3), np.float32))
    params = methods()[name].factory().init(jax.random.key(0), frame)
    assert params
    jax.tree.map(np.testing.assert_array_equal, params, zero_offsets(options))
    found = apply_offsets(options, params)
    for option in params:
        np.testing.assert_allclose(getattr(found, option), getattr(options, option), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FILTERS if name not in BESIDE_LIGHT])
def test_filters_have_gradients(name, rng):
    denoiser = methods()[name].factory()
    noisy = rng.gamma(0.5, 1.0, (2, 8, 9, 3)).astype(np.float32)
    specular = 0.5 * noisy * (rng.random((2, 8, 9, 1)) < 0.5)
    depth = np.broadcast_to(2 + 0.1 * np.arange(9, dtype=np.float32)[:, None], (2, 8, 9, 1))
    clip = Clip(Frame(noisy, specular=specular.astype(np.float32), depth=depth))
    params = denoiser.init(jax.random.key(0), frame_at(clip.frames, 0))
    slopes = jax.jit(jax.grad(lambda params: jnp.mean(denoise(denoiser, params, clip))))(params)
    assert all(jnp.isfinite(slope).all() for slope in slopes.values())
    assert sum(float(jnp.abs(slope).max()) > 0 for slope in slopes.values()) >= 2
