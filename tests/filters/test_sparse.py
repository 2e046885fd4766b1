"""Averages of few pixels are those of all pixels, at these pixels; what is needed alone is worked on alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.filters import sparse
from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.edge_stopping import depth_weight, luminance_weight, normal_weight
from jaxdn.filters.history_fix import fix_history
from jaxdn.filters.variance import estimate_variance
from jaxdn.ops.dispatch.row_tiles import evaluate_sparsely

HEIGHT, WIDTH = 23, 17


def drawn(rng):
    """Planes, which pixels show a surface, and the normals and depths of surfaces."""
    planes = rng.random((5, HEIGHT, WIDTH))
    normal = rng.normal(size=(HEIGHT, WIDTH, 3)) * 0.2 + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = rng.uniform(2, 3, (HEIGHT, WIDTH, 1))
    return planes, rng.random((HEIGHT, WIDTH)) < 0.8, (normal, depth)


def weights_of(planes, normal, depth):
    return [
        depth_weight(depth, None, sigma=1.0, height=depth.shape[0]),
        normal_weight(normal, sigma=16.0),
        luminance_weight(planes[0], planes[1], sigma=2.0),
    ]


@partial(jax.jit, static_argnames="step")
def averages(planes, hit, surfaces, needed, *, step):
    """Of all pixels, and of those that are needed."""
    weights = weights_of(planes, *surfaces)
    every, _ = edge_average(planes, hit, weights, stencil(2), step=step, step_max=step, with_total=True)
    return every, sparse.sparse_edge_average(planes, hit, weights, stencil(2), needed, step=step)


@jax.jit
def work(needed, array):
    return evaluate_sparsely(lambda part: (part + 1, part[:, 0] > 0.5), needed, array)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("step", [1, 3])
def test_few_pixels_get_what_all_get(share, step, rng, x64):
    needed = rng.random((HEIGHT, WIDTH)) < share
    every, found = averages(*drawn(rng), needed, step=step)
    np.testing.assert_allclose(found, np.where(needed, every, 0.0), rtol=1e-12, atol=1e-14)


def test_every_pixel_may_have_a_step_of_its_own(rng, x64):
    step = rng.integers(1, 4, (HEIGHT, WIDTH))

    @jax.jit
    def own_and_fixed(planes, hit, surfaces, step):
        weights, needed = weights_of(planes, *surfaces), np.ones((HEIGHT, WIDTH), bool)
        own = sparse.sparse_edge_average(planes, hit, weights, stencil(1), needed, step=step)[:-1]
        return own, [edge_average(planes, hit, weights, stencil(1), step=each, step_max=3)[0] for each in (1, 2, 3)]

    found, fixed = jax.tree.map(np.asarray, own_and_fixed(*drawn(rng), step))
    for each, every in enumerate(fixed, start=1):
        own = step == each
        np.testing.assert_allclose(found[:, own], every[:, own], rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_large_images_get_what_small_ones_get(rng, x64, monkeypatch):
    """Variance and history fix, with few short histories and with many; the gradient too."""
    planes, hit, surfaces = drawn(rng)
    weights = weights_of(planes, *surfaces)
    number = jnp.asarray(rng.random((HEIGHT, WIDTH)))
    lengths = [jnp.where(number < share, 1.0, 9.0) for share in (0.05, 1.05)]
    texture = jnp.asarray(rng.uniform(0.5, 1, (3, HEIGHT, WIDTH)))

    def both(planes, length):
        history = jnp.concatenate([planes, length[None]])
        color, variance = estimate_variance(history, hit, weights, short_history=4, texture=texture)
        fixed = fix_history(planes[:3], length, hit, weights, frames=4, widest=14, texture=texture)
        return color, variance, fixed

    def loss(planes, length):
        images = both(planes, length)
        return sum(jnp.sum(each**2) for each in images), images

    def found():
        # One program for images and gradient, of few and of many: they are large.
        run = jax.jit(lambda *given: jax.grad(loss, has_aux=True)(*given))
        return [run(planes, length) for length in lengths]

    small = found()
    monkeypatch.setattr(sparse, "_WORTH", 0)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12), small, found())


@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_work_is_done_where_it_is_needed(share, rng):
    array = rng.random((HEIGHT, WIDTH, 2)).astype(np.float32)
    needed = rng.random((HEIGHT, WIDTH)) < share
    found = work(needed, array)
    np.testing.assert_array_equal(found[0], np.where(needed[..., None], array + 1, 0))
    np.testing.assert_array_equal(found[1], needed & (array[..., 0] > 0.5))
