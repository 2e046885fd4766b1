"""The convolution and its hand-written gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxdn.backends.convolution import convolve


def _operands(inputs, outputs, size=(5, 6), count=2, dtype=jnp.float32):
    rng = np.random.default_rng(inputs * 10 + outputs)
    x = jnp.asarray(rng.standard_normal((count, *size, inputs)), dtype)
    return x, jnp.asarray(rng.standard_normal((3, 3, inputs, outputs)), dtype)


@pytest.mark.parametrize(("inputs", "outputs"), [(2, 3), (3, 2), (2, 2)])
@pytest.mark.parametrize("size", [(5, 6), (1, 4)])
def test_gradient_is_that_of_the_function(inputs, outputs, size):
    with jax.enable_x64(True):
        x, kernel = _operands(inputs, outputs, size, dtype=jnp.float64)
        check_grads(lambda x, k: convolve(x, k, implementation="blocked"), (x, kernel), order=1, modes=["rev"])


@pytest.mark.parametrize(("inputs", "outputs"), [(2, 3), (3, 2)])
def test_training_form_agrees_with_automatic_gradient(inputs, outputs):
    """grad(loss(scan(checkpoint(vmap(step))))) with one image per example, against jax's own convolution gradient."""
    with jax.enable_x64(True):
        frames, kernel = _operands(inputs, outputs, count=6, dtype=jnp.float64)
        frames = frames.reshape(3, 2, *frames.shape[1:])

        def gradient(implementation):
            def step(state, x):
                state = jnp.tanh(0.5 * state + convolve(x[None], kernel_, implementation=implementation)[0])
                return state, jnp.sum(state**2)

            def loss(k, frames):
                nonlocal kernel_
                kernel_ = k
                state = jnp.zeros((*frames.shape[1:4], outputs))
                return jnp.sum(jax.lax.scan(jax.checkpoint(jax.vmap(step)), state, frames)[1])

            kernel_ = kernel
            return jax.jit(jax.grad(loss, (0, 1)))(kernel, frames)

        for ours, theirs in zip(gradient("blocked"), gradient("reference"), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_bfloat16_kernel_gradient_is_summed_in_float32():
    x, kernel = jnp.ones((1, 40, 40, 1), jnp.bfloat16), jnp.zeros((3, 3, 1, 1), jnp.bfloat16)
    gradient = jax.grad(lambda k: jnp.sum(convolve(x, k, implementation="blocked").astype(jnp.float32)))(kernel)
    assert gradient.dtype == jnp.bfloat16
    assert float(gradient[1, 1, 0, 0]) == 1600.0  # a bfloat16 running sum of ones stops at 256
