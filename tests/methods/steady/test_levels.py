"""The levels of affinity filters: what is given back of what they took away."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.methods.steady.levels import LEVELS, PredictedParameters, Surfaces, filter_light
from jaxdn.methods.steady.method import PRECISIONS
from jaxdn.methods.steady.regression import SCALES

pytestmark = pytest.mark.usefixtures("optimised_programs")  # two programs are compared bit by bit
HEIGHT, WIDTH = 64, 96


@functools.partial(jax.jit, static_argnames="full_levels")
def through(light, regression_weight=None, *, residual=0.0, learned=0.0, edge=None, glossy=0.0, full_levels=1):
    """The light of a wall, or of two that meet at the column ``edge``, after all levels, with nothing decided.

    The second wall is turned, or ``glossy`` and not turned. ``learned`` is a feature at half resolution.
    """
    height, width = light.shape[:2]
    half = height // 2, width // 2
    nothing = jnp.zeros((height, width, 3))
    turned = jnp.zeros(width, bool) if edge is None else jnp.arange(width) >= edge
    normal = jnp.where(turned[None, :, None], jnp.asarray([1.0, 0.0, 0.0]), jnp.asarray([0.0, 0.0, 1.0]))
    hit = jnp.ones((height, width), bool)
    gloss = jnp.broadcast_to(glossy * turned[None, :, None], (height, width, 1))
    normal = jnp.broadcast_to(jnp.where(glossy, jnp.asarray([0.0, 0.0, 1.0]), normal), nothing.shape)
    surfaces = Surfaces(nothing, gloss, normal, nothing[..., :1], None, hit)
    whole, part = jnp.ones((height, width)), jnp.ones(half)
    decided = PredictedParameters(
        jnp.zeros((*half, 4)),
        whole,
        whole,
        jnp.broadcast_to(learned, (*half, 1)),
        part,
        [part] * LEVELS,
        None if regression_weight is None else regression_weight * part,
    )
    precisions = {name: jnp.full(1 + LEVELS, 4.0 * value) for name, value in PRECISIONS.items()}
    precisions["regression"] = {name: jnp.zeros(()) for name in SCALES}
    flat = jnp.zeros((3, height, width))
    residual = jnp.broadcast_to(residual, (3, *half))
    found = filter_light(
        precisions, light.transpose(2, 0, 1), residual, None, surfaces, flat, decided, full_levels, 1e-3
    )
    return jax.tree.map(lambda planes: planes.transpose(1, 2, 0), found)


def shading(edge=None):
    """Light that curves and rises, different on two walls."""
    x = (np.arange(WIDTH) / WIDTH)[None, :]
    y = (np.arange(HEIGHT) / HEIGHT)[:, None]
    light = 0.5 + x**2 + 0.5 * y
    if edge is not None:
        light = np.where(np.arange(WIDTH) >= edge, 2.0 - light, light)
    return jnp.asarray(np.repeat(light[..., None], 3, axis=-1), jnp.float32)


@pytest.mark.parametrize("edge", [None, 37])
def test_what_is_given_back_undoes_about_half_of_the_blur(edge):
    """Light that curves, and light that ends at a border or at the edge of a wall, where neighbours are on one side."""
    light = shading(edge)
    without, given = (np.abs(through(light, back, edge=edge).image - light).mean() for back in (None, 1.0))
    assert without > 0.01
    assert given < 0.6 * without


def test_a_share_of_it_is_that_share(rng):
    light = jnp.asarray(rng.uniform(0.5, 1.5, (HEIGHT, WIDTH, 3)), jnp.float32)
    none, some, all_ = (np.asarray(through(light, back).image) for back in (None, 0.3, 1.0))
    np.testing.assert_allclose(some, none + 0.3 * (all_ - none), atol=2e-6)
    np.testing.assert_array_equal(through(light, 0.0).image, none)


def test_light_beside_a_spike_does_not_become_negative():
    """What is given back is negative around it."""
    light = jnp.zeros((HEIGHT, WIDTH, 3)).at[30:34, 40:44].set(1e3)
    given = np.asarray(through(light, 1.0).image)
    assert given.min() >= 0.0
    assert np.isfinite(given).all()


def test_gloss_keeps_its_light():
    """Of a glossy frame on a wall, alike in all else, nothing runs over, as nothing does over the edge of two walls."""
    light = jnp.ones((HEIGHT, WIDTH, 3)).at[:, 37:].set(4.0)
    blurred, kept, turned = (
        np.abs(through(light, edge=edge, glossy=glossy).image - light).mean()
        for edge, glossy in ((None, 0.0), (37, 0.7), (37, 0.0))
    )
    assert blurred > 0.1
    assert kept < 0.01 * blurred
    assert turned < 0.01 * blurred


def test_what_is_learned_does_not_darken_a_change(rng):
    """A feature that knows which samples are bright makes them count for less in an image, and not in a change."""
    light = jnp.ones((HEIGHT, WIDTH, 3))
    bright = jnp.asarray(rng.uniform(size=(HEIGHT // 2, WIDTH // 2, 1)) < 0.1, jnp.float32)
    residual = 0.5 + 2.0 * (bright[None, ..., 0] - 0.1)
    plain, known = (through(light, residual=residual, learned=feature) for feature in (0.0, 3.0 * bright))
    assert plain.change.mean() == pytest.approx(0.5, rel=0.1)
    np.testing.assert_allclose(known.change.mean(), plain.change.mean(), rtol=0.03)
    np.testing.assert_allclose(plain.image, 1.0 + plain.change, rtol=1e-5)
